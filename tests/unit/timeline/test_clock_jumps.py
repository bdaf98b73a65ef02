"""The time line when clocks jump, stray, stall and reboot."""

from __future__ import annotations

import random

import pytest

from fusiond.config.schema import Config
from fusiond.events import Invalid
from fusiond.timeline.clock import Clock
from tests.helpers.clocks import (
    BOOT,
    FIX,
    HOUR,
    IMU,
    MS,
    SECOND,
    T0,
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


def test_reboot_is_confirmed_by_a_second_stamp() -> None:
    clock = Clock(Config())
    feed_imu(clock, 500 * SECOND, 520 * SECOND)
    host = T0 + 530 * SECOND  # boots again after 10 s of silence
    first = imu(2 * SECOND, host + 2 * SECOND + 5 * MS)
    measurement = measured(clock, first)
    assert measurement.payload == Invalid("clock jump")
    assert measurement.t_ns == first.t_receive_ns
    assert feed_imu(clock, 2 * SECOND + 10 * MS, 5 * SECOND, host) == [5 * MS] * 299
    assert (clock.report()[BOOT].resets, clock.report()[BOOT].strays) == (1, 1)


def test_reboot_with_system_time_waits_for_a_new_pair() -> None:
    clock = Clock(Config())
    feed_with_pairs(clock, 500 * SECOND, 510 * SECOND)
    reboot = T0 + 512 * SECOND
    clock.align(system_time(reboot + SECOND, SECOND, reboot + SECOND + 5 * MS))
    assert reason(clock, imu(SECOND + 10 * MS, reboot + SECOND + 15 * MS)) == "clock jump"
    feed_imu(clock, SECOND + 20 * MS, 2 * SECOND, reboot)
    assert clock.report()[BOOT].method == "least_offset"
    clock.align(system_time(reboot + 2 * SECOND, 2 * SECOND, reboot + 2 * SECOND + 5 * MS))
    assert feed_imu(clock, 2 * SECOND + 10 * MS, 4 * SECOND, reboot)[-1] == 0
    assert clock.report()[BOOT].method == "system_time"
    assert clock.report()[BOOT].resets == 1


@pytest.mark.parametrize("stray", [1, 90 * SECOND, 110 * SECOND, YEAR])
def test_a_stray_stamp_changes_nothing(stray: int) -> None:
    """Even if it is repeated (position and velocity of one message), or strays keep coming."""
    clock = Clock(Config())
    feed_imu(clock, 100 * SECOND, 101 * SECOND)
    for start in range(101 * SECOND, 103 * SECOND, 200 * MS):
        for source in ("gps0.position", "gps0.velocity"):
            assert reason(clock, fix(stray, T0 + start, BOOT, source)) in ("clock jump", "stamped in the future")
        assert set(feed_imu(clock, start, start + 200 * MS)) == {5 * MS}
    assert (clock.report()[BOOT].resets, clock.report()[BOOT].strays) == (0, 20)


@pytest.mark.parametrize("stray", [1, T0 - YEAR, T0 + YEAR])
def test_a_stray_first_stamp_is_forgotten(stray: int) -> None:
    clock = Clock(Config())
    assert measured(clock, fix(stray, T0)).t_ns == T0  # nothing known yet
    results = [measured(clock, fix(T0 + i * SECOND, T0 + i * SECOND + 60 * MS)) for i in range(5)]
    assert [result.payload == FIX for result in results] == [False, True, True, True, True]
    assert [result.t_ns for result in results[1:]] == [T0 + i * SECOND for i in range(1, 5)]
    assert clock.report()["unix"].method == "unix"


def test_odd_unix_stamps_do_not_end_trust() -> None:
    clock = Clock(Config())
    for i in range(50):
        t = T0 + i * SECOND
        assert valid(clock, fix(t, t + 60 * MS)) == t
        for j in range(1, 9):  # a second receiver, 18 s wrong, faster than the first
            u = t + j * 100 * MS
            assert reason(clock, fix(u + 18 * SECOND, u + 60 * MS, source="gps1.position")) == "stamped in the future"
    assert clock.report()["unix"].method == "unix"


def test_forward_jump_of_the_sensor_clock() -> None:
    clock = Clock(Config())
    feed_imu(clock, 100 * SECOND, 101 * SECOND)
    host = T0 - 20 * SECOND
    assert reason(clock, imu(121 * SECOND, host + 121 * SECOND + 5 * MS)) == "stamped in the future"
    assert set(feed_imu(clock, 121 * SECOND + 10 * MS, 122 * SECOND, host)) == {5 * MS}
    assert clock.report()[BOOT].resets == 1


@pytest.mark.parametrize(
    ("step", "seconds"), [(-300 * MS, 0.02), (-30 * SECOND, 0.02), (300 * MS, 11), (30 * SECOND, 3)]
)
def test_step_of_the_host_clock_is_followed(step: int, seconds: float) -> None:
    clock = Clock(Config())
    feed_imu(clock, 100 * SECOND, 130 * SECOND)
    if step < 0:
        assert reason(clock, imu(130 * SECOND, T0 + step + 130 * SECOND + 5 * MS)) == "stamped in the future"
    start = 130 * SECOND + 10 * MS
    errors = feed_imu(clock, start, start + 20 * SECOND, T0 + step)
    known = round(seconds * SECOND / (10 * MS))
    assert set(errors[known:]) == {5 * MS}
    assert set(errors[:known]) <= {5 * MS, 5 * MS - step}  # until then: where they were before
    assert clock.report()[BOOT].resets == 1


@pytest.mark.parametrize("step", [-300 * MS, -30 * SECOND])
def test_step_of_a_host_that_was_on_unix_time_and_back(step: int) -> None:
    clock = Clock(Config())
    moves = [0] * 20 + [step] * 60 + [0] * 160
    results = []
    for i, move in enumerate(moves):
        t = T0 + i * 200 * MS
        results.append(measured(clock, fix(t, t + move + 60 * MS)).t_ns - t)
        if i == 79:
            assert clock.report()["unix"].method == "least_offset"
    assert results[:20] == [0] * 20
    assert set(results[30:80]) == {step + 60 * MS}
    assert set(results[-100:]) == {0}
    assert clock.report()["unix"].method == "unix"


def test_a_stalled_link_keeps_the_alignment() -> None:
    clock = Clock(Config())
    feed_imu(clock, 100 * SECOND, 110 * SECOND)
    release = T0 + 118 * SECOND  # 8 s of samples come at once
    for boot in range(110 * SECOND, 118 * SECOND, 10 * MS):
        assert valid(clock, imu(boot, release + (boot - 110 * SECOND) // 100)) == T0 + boot + 5 * MS
    assert set(feed_imu(clock, 118 * SECOND + 100 * MS, 120 * SECOND)) == {5 * MS}
    assert clock.report()[BOOT].resets == 0


def test_congestion_of_some_seconds_keeps_the_alignment() -> None:
    clock = Clock(Config())
    feed_imu(clock, 100 * SECOND, 110 * SECOND)
    errors = feed_imu(clock, 110 * SECOND, 118 * SECOND, latency=250 * MS) + feed_imu(clock, 118 * SECOND, 130 * SECOND)
    assert max(abs(error - 5 * MS) for error in errors) < 3 * MS  # as much as could be drift
    assert set(errors[-1000:]) == {5 * MS}
    assert clock.report()[BOOT].resets == 0


def test_a_source_that_is_always_late_does_not_hide_a_jump() -> None:
    clock = Clock(Config())
    for i in range(1_000):
        t = 100 * SECOND + i * 20 * MS
        host = T0 + (30 * SECOND if i >= 500 else 0)
        result = valid(clock, imu(t, host + t + 5 * MS))
        if i % 10 == 5:
            valid(clock, fix(t - 1_300 * MS, host + t + 5 * MS, BOOT))
    assert result == host + t + 5 * MS


@pytest.mark.parametrize(("drift_ppm", "seconds", "bound"), [(0, 1, 0), (64, 600, 5 * MS), (-64, 600, 5 * MS)])
def test_a_gap_of_two_hours_changes_nothing(drift_ppm: int, seconds: int, bound: int) -> None:
    clock = Clock(Config())
    stop = (100 + seconds) * SECOND
    rng = random.Random(3) if drift_ppm else None
    feed_imu(clock, 100 * SECOND, stop, period=20 * MS, drift_ppm=drift_ppm, jitter=rng)
    errors = feed_imu(clock, stop + 2 * HOUR, stop + 2 * HOUR + 60 * SECOND, drift_ppm=drift_ppm, jitter=rng)
    assert max(abs(error - 5 * MS) for error in errors) <= bound
    assert max(abs(error - 5 * MS) for error in errors[2000:]) <= bound // 5
    assert (clock.report()[BOOT].resets, clock.report()[BOOT].strays) == (0, 0)


@pytest.mark.parametrize("seed", range(20))
def test_a_clock_recovers_from_any_disorder(seed: int) -> None:
    """After any disorder, steady stamps of any offset are valid again, and near their receipt."""
    clock = Clock(Config())
    rng = random.Random(seed)
    receive = T0
    for _ in range(80):
        receive += rng.choice([0, MS, SECOND, rng.randrange(60 * SECOND), -rng.randrange(5 * SECOND)])
        stamp = T0 + rng.choice([0, rng.randrange(-2_000, 2_000) * MS, rng.randrange(-60, 60) * SECOND, YEAR])
        clock.align(imu(stamp - T0 + 1_000 * SECOND, receive))
        clock.align(fix(stamp, receive))
        clock.align(system_time(stamp, stamp - T0 + 1_000 * SECOND, receive))
    host = rng.choice([0, 5 * SECOND, -300 * MS, -40 * YEAR])
    for i in range(600):
        unix = receive + SECOND + i * 20 * MS
        placed = measured(clock, imu(SECOND + i * 20 * MS, unix + host + 5 * MS))
        if i % 5 == 0:
            fixed = measured(clock, fix(unix - 60 * MS, unix + host + 5 * MS))
    assert (placed.payload, fixed.payload) == (IMU, FIX)
    assert -50 * MS <= placed.t_receive_ns - placed.t_ns <= 100 * MS
    assert -50 * MS <= fixed.t_receive_ns - fixed.t_ns <= 165 * MS


@pytest.mark.parametrize(("quicker", "follows"), [(100 * MS, True), (400 * MS, True), (600 * MS, False)])
def test_a_quicker_source_shows_the_latency_of_another(quicker: int, follows: bool) -> None:
    """The host is an hour off, so Unix stamps have a least offset: first that of the fixes, then that of SYSTEM_TIME. One
    that is further ahead has the wrong time."""
    clock, latency = Clock(Config()), 5 * MS + quicker
    for second in range(1, 30):
        now = T0 + second * SECOND
        for fifth in range(5):
            stamp = now + fifth * 200 * MS
            found = valid(clock, fix(stamp + HOUR, stamp + latency))
            if second > 3:
                assert found == pytest.approx(stamp + (5 * MS if follows else latency), abs=MS)
        clock.align(system_time(now + SECOND + HOUR, (second + 1) * SECOND, now + SECOND + 5 * MS))
    assert (clock.report()["unix"].resets, clock.report()["unix"].method) == (int(follows), "least_offset")
