"""TIMESYNC: a boot clock measured by round trips, what disturbs them, and Unix time by way of it."""

from __future__ import annotations

import pytest

from fusiond.config.load import parse
from fusiond.events import HOST_CLOCK, ClockPair, ImuSample, Measurement, Received
from fusiond.timeline.clock import Clock
from fusiond.timeline.timesync import DEVIATIONS, RoundTrips
from fusiond.units import MILLISECOND as MS
from fusiond.units import SECOND

T0 = 1_700_000_000 * SECOND
BOOT = "fc/1/boot"
SAMPLE = ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0))
CONFIG = parse('[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[gnss.gps0]\nlink = "fc"')


def imu(boot: int, receive: int) -> Received:
    return Received("imu0", 0, BOOT, boot, receive, SAMPLE)


def answer(boot: int, sent: int, receive: int) -> Received:
    return Received("fc.timesync", 0, BOOT, boot, receive, ClockPair(HOST_CLOCK, sent))


def system_time(unix: int, boot: int, receive: int) -> Received:
    return Received("fc.time", 0, "unix", unix, receive, ClockPair(BOOT, boot // MS * MS))


def placed(clock: Clock, received: Received) -> int:
    measurement = clock.align(received)
    assert isinstance(measurement, Measurement)
    return measurement.t_ns


def drive(clock: Clock, start: int, seconds: float, *, zero: int = T0, latency: int = 40 * MS, trip: int = 4 * MS) -> int:
    """IMU samples at 50 Hz that come `latency` late, a round trip each second; the last one's error [ns]."""
    error = 0
    for k in range(int(seconds * 50)):
        boot = start + k * 20 * MS
        if k % 50 == 0:
            assert clock.align(answer(boot + trip // 2, zero + boot, zero + boot + trip)) is None
        error = placed(clock, imu(boot, zero + boot + latency)) - (zero + boot)
    return error


def test_round_trips_measure_the_latency_that_receipts_cannot() -> None:
    clock = Clock(CONFIG)
    assert abs(drive(clock, SECOND, 5)) < MS // 10
    report = clock.report()[BOOT]
    assert (report.method, report.note, report.resets) == ("timesync", "", 0)
    assert abs(drive(Clock(CONFIG), SECOND, 5, trip=11 * MS)) == 40 * MS  # round trips this slow are not used


def test_the_fastest_request_and_the_fastest_reply_count() -> None:
    trips = RoundTrips()
    for k in range(100):  # only one way is delayed at a time
        sent, there, back = T0 + k * SECOND, (k % 7) * MS, (3 * k % 5) * MS
        trips.add(sent + 100_000 + there, sent, sent + 200_000 + there + back)
    assert trips.at(T0 + 100 * SECOND) == pytest.approx(0, abs=1000)


def test_drift_is_followed() -> None:
    trips = RoundTrips()
    for k in range(600):
        sent = T0 + k * SECOND
        trips.add(sent - sent // 20_000 + MS, sent, sent + 2 * MS)  # 50 ppm
    assert trips.at(T0 + 600 * SECOND) == pytest.approx((T0 + 600 * SECOND) // 20_000, abs=100_000)


def test_one_stray_answer_changes_nothing_but_consecutive_ones_do() -> None:
    trips = RoundTrips()

    def ask(k: int, offset: int) -> None:
        trips.add(k * SECOND + MS - offset, k * SECOND, k * SECOND + 2 * MS)

    for k in range(10):
        ask(k, 0)
    ask(10, SECOND)
    assert (trips.at(10 * SECOND), trips.deviating) == (0, 1)
    for k in range(11, 11 + DEVIATIONS):
        assert trips.at(k * SECOND) == 0
        ask(k, SECOND)
        if k == 11:
            ask(k, 0)  # a good one in between resets the count
    assert trips.at(20 * SECOND) == 0
    ask(20, SECOND)
    assert trips.at(20 * SECOND) == SECOND


def test_a_reboot_is_followed() -> None:
    clock = Clock(CONFIG)
    drive(clock, 100 * SECOND, 3)
    assert abs(drive(clock, SECOND, 8, zero=T0 + 200 * SECOND)) < MS // 10
    assert clock.report()[BOOT].method == "timesync"


def test_answers_of_another_clock_are_refused() -> None:
    clock = Clock(CONFIG)
    for k in range(100):
        boot = SECOND + k * 20 * MS
        clock.align(answer(boot + 5000 * SECOND, T0 + boot, T0 + boot + MS))
        placed(clock, imu(boot, T0 + boot + 10 * MS))
    report = clock.report()[BOOT]
    assert (report.method, report.note) == ("least_offset", "TIMESYNC contradicts receipts")


@pytest.mark.parametrize("wrong", [0, 300 * MS, -400 * MS, 5000 * SECOND, -(10**6) * SECOND])
def test_unix_and_boot_stamps_are_right_if_the_host_clock_is_wrong(wrong: int) -> None:
    """The host's clock is ahead of Unix time by `wrong`: each stamp still gives the host's own instant."""
    clock = Clock(CONFIG)
    boot_error = unix_error = 0
    for k in range(1000):
        boot = SECOND + k * 20 * MS
        unix, host = T0 + boot, T0 + boot + wrong
        if k % 50 == 0:
            clock.align(answer(boot + MS, host, host + 2 * MS))
            clock.align(system_time(unix, boot, host + 15 * MS))
        boot_error = placed(clock, imu(boot, host + 30 * MS)) - host
        fix = Received("gps0.position", k, "unix", unix, host + 80 * MS, SAMPLE)
        unix_error = placed(clock, fix) - host
    assert abs(boot_error) < MS // 10
    assert abs(unix_error) < MS + MS // 10  # SYSTEM_TIME's boot time is cut off to a millisecond
    assert {name: report.method for name, report in clock.report().items()} == {BOOT: "timesync", "unix": "timesync"}
