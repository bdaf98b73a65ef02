"""TIMESYNC: a boot clock measured by round trips, what disturbs them, and Unix time by way of it."""

from __future__ import annotations

from random import Random

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


def middle(trips: RoundTrips, receive: int) -> int:
    """The offset where receipts say nothing."""
    bounds = trips.bounds(receive, T0)
    assert bounds is not None
    return sum(bounds) // 2


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


@pytest.mark.parametrize("trip", [11, 40, 120])
def test_slow_round_trips_count_by_half_their_time(trip: int) -> None:
    """A trip bounds the offset from both sides: its middle is never wrong by more than half of it."""
    assert abs(drive(Clock(CONFIG), SECOND, 10, latency=trip * MS, trip=trip * MS)) < MS // 10
    clock = Clock(CONFIG)
    assert abs(drive(clock, SECOND, 5, latency=5 * MS, trip=trip * MS)) <= trip * MS / 2
    assert clock.report()[BOOT].method == "timesync"


def test_a_trip_that_says_less_than_receipts_is_not_used() -> None:
    clock = Clock(CONFIG)
    assert drive(clock, SECOND, 5, latency=30 * MS, trip=1200 * MS) == 30 * MS
    assert (clock.report()[BOOT].method, clock.report()[BOOT].resets) == ("least_offset", 0)
    assert clock.report()[BOOT].note.startswith("TIMESYNC is uncertain by 3")


def test_a_stock_rover_is_aligned_by_slow_trips() -> None:
    """Its loop of 50 Hz lets a request wait for up to 20 ms; the answer leaves at once. Few trips take less than 10 ms."""
    clock, random = Clock(CONFIG), Random(1)
    errors = []
    for k in range(60 * 40):
        boot = SECOND + k * 25 * MS
        if k % 40 == 0 or (k % 4 == 0 and k < 80):
            sent, there, back = T0 + boot, round(random.uniform(0.3, 20.3) * MS), round(random.uniform(0.3, 8) * MS)
            assert clock.align(answer(boot + there, sent, sent + there + back)) is None
        receive = T0 + boot + round(random.uniform(8, 30) * MS)
        errors.append(placed(clock, imu(boot, receive)) - (T0 + boot))
    assert clock.report()[BOOT].method == "timesync"
    assert clock.report()[BOOT].resets == 0
    assert max(map(abs, errors[40 * 5 :])) < 3 * MS


@pytest.mark.parametrize("off", [600 * MS, -600 * MS])
@pytest.mark.parametrize("trips", [True, False])
def test_a_wrong_system_time_never_steps_a_clock_in_use(off: int, trips: bool) -> None:
    """The autopilot's Unix time is wrong, and comes in mid-drive, with its first fix."""
    clock, errors = Clock(CONFIG), []
    for k in range(60 * 50):
        boot = SECOND + k * 20 * MS
        if trips and k % 50 == 0:
            clock.align(answer(boot + 16 * MS, T0 + boot, T0 + boot + 17 * MS))
        if k > 1000 and k % 50 == 25:
            clock.align(system_time(T0 + boot - off, boot, T0 + boot + 12 * MS))
        errors.append(placed(clock, imu(boot, T0 + boot + 10 * MS)) - (T0 + boot))
    assert max(map(abs, errors[100:])) <= 10 * MS
    assert (clock.report()[BOOT].resets, clock.report()[BOOT].strays) == (0, 0)


def test_the_fastest_request_and_the_fastest_reply_count() -> None:
    trips = RoundTrips()
    for k in range(100):  # only one way is delayed at a time
        sent, there, back = T0 + k * SECOND, (k % 7) * MS, (3 * k % 5) * MS
        trips.add(sent + 100_000 + there, sent, sent + 200_000 + there + back)
    assert middle(trips, T0 + 100 * SECOND) == pytest.approx(0, abs=1000)


def test_drift_is_followed() -> None:
    trips = RoundTrips()
    for k in range(600):
        sent = T0 + k * SECOND
        trips.add(sent - sent // 20_000 + MS, sent, sent + 2 * MS)  # 50 ppm
    assert middle(trips, T0 + 600 * SECOND) == pytest.approx((T0 + 600 * SECOND) // 20_000, abs=100_000)


def test_one_stray_answer_changes_nothing_but_consecutive_ones_do() -> None:
    trips = RoundTrips()

    def ask(k: int, offset: int) -> None:
        trips.add(k * SECOND + MS - offset, k * SECOND, k * SECOND + 2 * MS)

    for k in range(10):
        ask(k, 0)
    ask(10, SECOND)
    assert (middle(trips, 10 * SECOND), trips.deviating) == (0, 1)
    for k in range(11, 11 + DEVIATIONS):
        assert middle(trips, k * SECOND) == 0
        ask(k, SECOND)
        if k == 11:
            ask(k, 0)  # a good one in between resets the count
    assert middle(trips, 20 * SECOND) == 0
    ask(20, SECOND)
    assert middle(trips, 20 * SECOND) == SECOND


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


# --- Bounds (THEORY A6)


def test_the_bounds_of_a_clock_are_told_and_hold_the_truth() -> None:
    clock = Clock(CONFIG)
    drive(clock, SECOND, 5, latency=40 * MS, trip=16 * MS)
    report = clock.report()[BOOT]
    assert report.bounds_ns is not None
    least, most = report.bounds_ns
    assert least <= T0 <= most
    assert most - least == pytest.approx(16 * MS, abs=MS // 10)
    assert report.faults == 0


def test_an_event_of_another_clock_is_told_how_far_off_it_may_lie() -> None:
    """Bounds 16 ms apart: uniform within 8 ms either way, so a sigma of 8 / sqrt 3 ms."""
    clock = Clock(CONFIG)
    before = clock.align(Received("left", 0, "", None, T0, SAMPLE))
    drive(clock, SECOND, 5, latency=40 * MS, trip=16 * MS)
    now = T0 + 6 * SECOND
    wheel = clock.align(Received("left", 1, "", None, now, SAMPLE))
    same = clock.align(imu(6 * SECOND, now + 40 * MS))
    assert before is not None
    assert wheel is not None
    assert same is not None
    assert (before.stamp_sigma, same.stamp_sigma) == (0.0, 0.0)
    assert wheel.stamp_sigma == pytest.approx(8e-3 / 3**0.5, rel=0.02)


def test_unix_time_by_way_of_the_boot_clock_shares_its_error() -> None:
    clock = Clock(CONFIG)
    for k in range(250):
        boot = SECOND + k * 20 * MS
        if k % 50 == 0:
            clock.align(answer(boot + 8 * MS, T0 + boot, T0 + boot + 16 * MS))
            clock.align(system_time(T0 + boot, boot, T0 + boot + 12 * MS))
        clock.align(imu(boot, T0 + boot + 10 * MS))
    fix = clock.align(Received("gps0.position", 0, "unix", T0 + 6 * SECOND, T0 + 6 * SECOND + 90 * MS, SAMPLE))
    assert fix is not None
    assert clock.report()["unix"].method == "timesync"
    assert fix.stamp_sigma == 0.0


def test_bounds_that_contradict_each_other_are_a_fault() -> None:
    """The autopilot's clock steps by 12 ms: no trip deviates by so little, but nothing is left between the bounds."""
    clock = Clock(CONFIG)
    drive(clock, SECOND, 5, trip=2 * MS)
    assert clock.report()[BOOT].faults == 0
    error = drive(clock, 7 * SECOND, 20, zero=T0 - 12 * MS, trip=2 * MS)
    report = clock.report()[BOOT]
    assert (report.faults, report.method) == (1, "timesync")
    assert abs(error) < MS
    assert report.bounds_ns is not None
    assert report.bounds_ns[0] <= T0 - 12 * MS <= report.bounds_ns[1]
