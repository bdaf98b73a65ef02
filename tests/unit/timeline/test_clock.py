"""Alignment of every kind of stamp: Unix, boot, pairs, none; duplicates, drift, order."""

from __future__ import annotations

import os
import pickle
import random
from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.config.schema import Can, Config, Gnss, Imu, Wheel
from fusiond.events import (
    ClockPair,
    Invalid,
    Measurement,
    Payload,
    Received,
    WheelSpeed,
)
from fusiond.timeline.aligner import FUTURE_TOLERANCE
from fusiond.timeline.clock import Clock
from tests.helpers.clocks import (
    BOOT,
    FIX,
    HOUR,
    IMU,
    MS,
    SECOND,
    T0,
    TRACES,
    VELOCITY,
    YEAR,
    feed_imu,
    feed_with_pairs,
    fix,
    imu,
    measured,
    reason,
    system_time,
    valid,
)

# ---------------------------------------------------------------------------- stamps of each kind


DELAYS = Config(
    imu={"imu0": Imu(link="autopilot", delay_ms=1.5)},
    gnss={"gps0": Gnss(link="autopilot", delay_ms=78.0, velocity_delay_ms=55.0)},
    can={"can0": Can(delay_ms=2.0)},
    wheel={"rear_left": Wheel(bus="can0", message="WHEELS", signal="RL", delay_ms=4.25)},
)


@pytest.mark.parametrize(
    ("source", "payload", "delay"),
    [
        ("imu0", IMU, 1.5),
        ("gps0.position", FIX, 78.0),
        ("gps0.velocity", VELOCITY, 133.0),
        ("rear_left", WheelSpeed(3.0), 6.25),
        ("unheard_of", WheelSpeed(3.0), 0.0),
    ],
)
@pytest.mark.parametrize("stamp", [None, T0])
def test_delay_of_each_source_is_subtracted(source: str, payload: Payload, delay: float, stamp: int | None) -> None:
    clock = Clock(DELAYS)
    received = Received(source, 7, "unix" if stamp else "", stamp, T0, payload)
    assert clock.align(received) == Measurement(T0 - round(delay * MS), source, 7, T0, payload)


def test_no_stamp_is_placed_at_its_receipt() -> None:
    clock = Clock(Config())
    assert valid(clock, Received("rear_left", 0, "", None, T0, WheelSpeed(1.0))) == T0
    assert clock.report()["arrival"].samples == 1


def test_plausible_unix_stamps_are_trusted() -> None:
    clock = Clock(Config())
    latencies = [80 * MS, 3 * MS, -40 * MS, 1_900 * MS, 60 * MS]
    for i, latency in enumerate(latencies):
        stamp = T0 + i * SECOND
        assert valid(clock, fix(stamp, stamp + latency)) == stamp
    report = clock.report()["unix"]
    assert (report.method, report.offset_ns, report.resets) == ("unix", 0, 0)
    assert report.jitter_ns == sum(latencies) // len(latencies)


@pytest.mark.parametrize("off", [5 * SECOND, -5 * SECOND, -300 * MS, 40 * YEAR, -40 * YEAR])
def test_a_host_that_is_not_on_unix_time_falls_back_to_the_least_offset(off: int) -> None:
    clock = Clock(Config())
    rng = random.Random(1)
    for i in range(600):
        stamp = T0 + i * SECOND // 10
        t_ns = valid(clock, fix(stamp, stamp + off + round(rng.uniform(2, 30) * MS)))
        assert abs(t_ns - stamp - off) < (30 if i < 20 else 6) * MS
    report = clock.report()["unix"]
    assert (report.method, report.resets, report.strays) == ("least_offset", 0, 0)
    assert "Unix stamps differ" in report.note


def test_boot_clock_takes_the_least_offset_at_once() -> None:
    clock = Clock(Config())
    assert valid(clock, imu(SECOND, T0 + SECOND + 20 * MS)) == T0 + SECOND + 20 * MS
    errors = feed_imu(clock, SECOND + 10 * MS, 3 * SECOND)
    assert errors[-1] == 5 * MS
    assert clock.report()[BOOT].method == "least_offset"


@pytest.mark.parametrize(("drift_ppm", "seconds"), [(64, 3600), (200, 600), (-200, 600)])
def test_drift_under_exponential_jitter(drift_ppm: int, seconds: int) -> None:
    clock = Clock(Config())
    rng = random.Random(drift_ppm)
    errors = feed_imu(clock, SECOND, seconds * SECOND, period=40 * MS, drift_ppm=drift_ppm, jitter=rng)
    beyond = [error - 5 * MS for error in errors]  # the least latency
    assert max(map(abs, beyond[50:])) < 1 * MS  # 2 s after the start
    assert max(map(abs, beyond[1500:])) < MS // 5  # and a minute after it
    report = clock.report()[BOOT]
    assert report.drift_ppm == pytest.approx(drift_ppm, abs=1)
    assert report.jitter_ns == pytest.approx(5 * MS, rel=0.1)
    assert (report.resets, report.strays) == (0, 0)


def test_the_clock_does_not_grow() -> None:
    clock = Clock(Config())
    rng = random.Random(2)
    feed_imu(clock, SECOND, 1_000 * SECOND, period=50 * MS, jitter=rng)
    before = len(pickle.dumps(clock))
    feed_imu(clock, 1_000 * SECOND, 3_000 * SECOND, period=50 * MS, jitter=rng)
    assert len(pickle.dumps(clock)) < 1.1 * before


# ---------------------------------------------------------------------------- SYSTEM_TIME pairs


def test_system_time_gives_unix_time_within_its_resolution() -> None:
    clock = Clock(Config())
    errors = feed_with_pairs(clock, SECOND, 61 * SECOND)
    assert min(errors[:40]) >= 5 * MS  # before the first pair: least offset
    assert max(map(abs, errors[300:])) < 1.2 * MS
    assert max(map(abs, errors[2000:])) < MS // 2  # the least of 20 and more
    report = clock.report()[BOOT]
    assert (report.method, report.note, report.strays) == ("system_time", "", 0)
    assert report.jitter_ns == pytest.approx(15 * MS, rel=0.1)


@pytest.mark.parametrize("host", [5 * SECOND, -5 * SECOND, -40 * YEAR])
def test_system_time_is_not_used_where_the_host_is_off(host: int) -> None:
    clock = Clock(Config())
    errors = feed_with_pairs(clock, SECOND, 20 * SECOND, host)
    assert max(abs(error - host - 5 * MS) for error in errors[200:]) < 1 * MS
    report = clock.report()
    assert (report[BOOT].method, report[BOOT].note) == ("least_offset", "SYSTEM_TIME: Unix time is not trusted")
    assert report["unix"].method == "least_offset"


def test_system_time_that_contradicts_receipts_is_not_used() -> None:
    clock = Clock(Config())
    errors = feed_with_pairs(clock, SECOND, 20 * SECOND, stale=200 * MS)  # would put samples 180 ms after their receipt
    assert max(abs(error - 5 * MS) for error in errors[200:]) < 1 * MS
    report = clock.report()[BOOT]
    assert (report.method, report.note) == ("least_offset", "SYSTEM_TIME contradicts receipts")


def test_system_time_that_contradicts_other_unix_stamps_is_refused() -> None:
    clock = Clock(Config())
    for i in range(100):
        t = 10 * SECOND + i * 100 * MS
        assert valid(clock, fix(T0 + t, T0 + t + 60 * MS)) == T0 + t
        valid(clock, imu(t, T0 + t + 5 * MS))
        if i % 10 == 5:
            clock.align(system_time(T0 + t + HOUR, t, T0 + t + 5 * MS))
    report = clock.report()
    assert report["unix"].method == "unix"
    assert (report[BOOT].method, report[BOOT].note) == ("least_offset", "SYSTEM_TIME refused: stamped in the future")


def test_one_odd_pair_is_ignored() -> None:
    clock = Clock(Config())
    feed_with_pairs(clock, SECOND, 11 * SECOND)
    clock.align(system_time(T0 + 11 * SECOND, 10_900 * MS, T0 + 11 * SECOND + 5 * MS))
    assert max(map(abs, feed_with_pairs(clock, 11 * SECOND, 13 * SECOND))) < 1 * MS


def test_a_step_of_the_unix_clock_is_not_followed() -> None:
    clock = Clock(Config())
    for i in range(200):
        t = 10 * SECOND + i * 100 * MS
        step = 500 * MS if i >= 100 else 0  # the autopilot's Unix time is put back
        valid(clock, imu(t, T0 + t + 5 * MS))
        if i % 10 == 5:
            clock.align(system_time(T0 + t - step, t, T0 + t + 5 * MS))
    report = clock.report()[BOOT]
    assert (report.method, report.note, report.resets) == ("least_offset", "SYSTEM_TIME contradicts receipts", 0)
    assert report.offset_ns == T0 + 5 * MS


@pytest.mark.parametrize(("unix", "boot"), [(0, SECOND), (T0, 0), (-1, -1), (None, SECOND)])
def test_nothing_is_learnt_from_absurd_pairs(unix: int | None, boot: int) -> None:
    clock = Clock(Config())
    assert clock.align(Received("system_time", 0, "unix", unix, T0, ClockPair(BOOT, boot))) is None
    assert clock.report() == {}


# ---------------------------------------------------------------------------- order and sameness


def test_a_late_fix_lies_with_the_imu_samples_of_its_time() -> None:
    clock = Clock(Config())
    rng = random.Random(4)
    placed = {}
    for i in range(2_000):
        boot = SECOND + i * 10 * MS
        receive = T0 + boot + round(rng.expovariate(1 / (5 * MS)))
        placed[boot] = valid(clock, imu(boot, receive))
        if i > 12 and i % 20 == 0:
            assert valid(clock, fix(boot - 120 * MS, receive, BOOT)) == placed[boot - 120 * MS]


def test_a_duplicate_gets_the_same_stamp() -> None:
    clock = Clock(Config())
    rng = random.Random(5)
    placed: list[tuple[Received, int]] = []
    for i in range(1_000):
        received = imu(SECOND + i * 10 * MS, T0 + SECOND + i * 10 * MS + round(rng.expovariate(1 / (5 * MS))))
        placed.append((received, valid(clock, received)))
        again, t_ns = placed[max(0, i - rng.randrange(190))]
        late = Received(again.source, 1, again.clock, again.t_sensor_ns, received.t_receive_ns, IMU)
        assert valid(clock, late) == t_ns


@st.composite
def arrivals(draw: st.DrawFn) -> list[Received]:
    """Two sources of one clock with any latencies below 40 ms, in order of receipt."""
    received = []
    for source, period in (("imu0", 7 * MS), ("gps0.position", 50 * MS)):
        latencies = draw(st.lists(st.integers(0, 40 * MS), min_size=2, max_size=40))
        stamp = SECOND
        for latency in latencies:
            stamp += draw(st.integers(5, period))
            received.append(fix(stamp, T0 + stamp + latency, BOOT, source))
    return sorted(received, key=lambda r: r.t_receive_ns)


@settings(max_examples=150, deadline=None)
@given(arrivals())
def test_order_survives_any_jitter(received: list[Received]) -> None:
    clock = Clock(Config())
    placed = sorted({(r.t_sensor_ns or 0, valid(clock, r)) for r in received})
    assert len({stamp for stamp, _ in placed}) == len(placed)  # one stamp, one instant
    for (stamp, t_ns), (next_stamp, next_t_ns) in pairwise(placed):
        assert abs((next_t_ns - t_ns) - (next_stamp - stamp)) <= (next_stamp - stamp) // 2 + 2
        assert next_t_ns > t_ns or next_stamp - stamp < 5


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.integers(-3, 3 * 10**10), st.integers(0, 10**8), st.booleans()), max_size=40))
def test_nothing_lies_far_after_its_receipt(pairs: list[tuple[int, int, bool]]) -> None:
    """For any input: no error, no stamp far after its receipt, and the same result from the same input."""
    clock, twin = Clock(Config()), Clock(Config())
    receive = T0
    for stamp, elapsed, unix in pairs:
        receive += elapsed
        received = fix(stamp + T0, receive) if unix else imu(stamp, receive)
        measurement = measured(clock, received)
        assert measurement.t_ns <= receive + FUTURE_TOLERANCE
        assert measurement == twin.align(received)
        pair = Received("system_time", 0, "unix", stamp + T0, receive, ClockPair(BOOT, stamp))
        assert clock.align(pair) is twin.align(pair) is None
    assert clock.report() == twin.report()


# ---------------------------------------------------------------------------- bad input


@pytest.mark.parametrize("stamp", [0, -1, -YEAR])
def test_a_stamp_that_is_not_positive_is_invalid(stamp: int) -> None:
    clock = Clock(Config())
    assert reason(clock, imu(stamp, T0)) == "sensor stamp is not positive"
    assert measured(clock, imu(stamp, T0)).t_ns == T0


def test_an_invalid_payload_is_stamped_but_not_learnt_from() -> None:
    clock = Clock(Config())
    no_fix = Invalid("no fix")
    assert clock.align(Received("gps0.position", 3, "unix", T0 - YEAR, T0, no_fix)) == Measurement(
        T0, "gps0.position", 3, T0, no_fix
    )
    assert measured(clock, Received("gps0.position", 3, "unix", 0, T0, no_fix)).payload == no_fix
    assert valid(clock, fix(T0 + SECOND, T0 + SECOND + 60 * MS)) == T0 + SECOND
    assert measured(clock, Received("gps0.position", 4, "unix", T0 + 2 * SECOND, T0 + 3 * SECOND, no_fix)).t_ns == (
        T0 + 2 * SECOND
    )
    assert clock.report()["unix"].method == "unix"


# ---------------------------------------------------------------------------- captured drive


def traced(name: str, gps_clock: str) -> Iterable[Received]:
    path = TRACES / name
    if not path.is_file():
        pytest.skip(f"needs the captured drive {TRACES.name}/{name} in the shared data")
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil  # noqa: PLC0415  (reads MAVLINK20 when imported)

    log = mavutil.mavlink_connection(str(path), dialect="common")
    while (message := log.recv_match()) is not None:
        receive = round(message._timestamp * 1e6) * 1_000
        kind = message.get_type()
        if kind == "HIGHRES_IMU":
            yield imu(message.time_usec * 1_000, receive)
        elif kind == "GPS_RAW_INT":
            yield fix(message.time_usec * 1_000, receive, gps_clock)
        elif kind == "SYSTEM_TIME":
            yield system_time(message.time_unix_usec * 1_000, message.time_boot_ms * MS, receive)
    log.close()


@pytest.mark.parametrize(
    ("name", "gps_clock", "least", "most"),
    [("drive.tlog", "unix", 54, 116), ("drive-gps-boot-time.tlog", BOOT, -2, 2)],
)
def test_captured_drive(name: str, gps_clock: str, least: int, most: int) -> None:
    clock = Clock(Config())
    ages: dict[str, list[int]] = {"imu0": [], "gps0.position": []}
    for received in traced(name, gps_clock):
        measurement = clock.align(received)
        if measurement is not None:
            assert not isinstance(measurement.payload, Invalid)
            ages[received.source].append(received.t_receive_ns - measurement.t_ns)
    assert len(ages["imu0"]) > 3_000
    assert len(ages["gps0.position"]) > 200
    assert max(map(abs, ages["imu0"])) < 2 * MS
    assert least * MS < min(ages["gps0.position"])
    assert max(ages["gps0.position"]) < most * MS
    assert {report.method for name, report in clock.report().items() if name == BOOT} == {"system_time"}


# ---------------------------------------------------------------------------- receipts that step back


def test_a_forgotten_clock_aligns_like_a_new_one_and_keeps_its_counts() -> None:
    """The boot clock goes on over an hour's step back of the host."""
    clock, new = Clock(Config()), Clock(Config())
    feed_imu(clock, SECOND, 3 * SECOND)
    samples = clock.report()[BOOT].samples
    later = [imu(boot, T0 - HOUR + boot + 3 * MS) for boot in range(3 * SECOND, 5 * SECOND, 10 * MS)]
    assert clock.steps_back(later[0]) and not new.steps_back(later[0])
    clock.forget()
    assert [clock.align(event) for event in later] == [new.align(event) for event in later]
    report = clock.report()[BOOT]
    assert (report.samples, report.resets, report.strays) == (samples + len(later), 0, 0)
