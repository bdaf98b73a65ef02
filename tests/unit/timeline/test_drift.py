"""Drifts that no clock of real time has, and latencies that look like one."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest

from fusiond.config.schema import Config
from fusiond.events import HOST_CLOCK, ClockPair, Received
from fusiond.timeline.aligner import UNUSABLE
from fusiond.timeline.clock import Clock
from fusiond.timeline.drift import DriftWatch
from tests.helpers.clocks import BOOT, MS, SECOND, T0, imu, reason, valid


def watched(offset_at: Callable[[int], int], seconds: float, period: int = 20 * MS) -> tuple[list[float | None], DriftWatch]:
    """The drift [ppm] that is found, second by second. `offset_at` gives receipt less stamp at a receipt, less latency."""
    watch, random, found = DriftWatch(), Random(7), []
    for k in range(round(seconds * SECOND) // period):
        receive = k * period
        watch.add(T0 + receive, offset_at(receive) + round(random.expovariate(1 / (5 * MS))))
        if receive % SECOND == 0:
            found.append(None if watch.drift is None else watch.drift / 1000)
    return found, watch


@pytest.mark.parametrize(("ppm", "seconds"), [(-20_000, 12), (-500_000, 12), (-2_000, 120), (500_000, 120), (20_000, 120)])
def test_another_speed_is_found(ppm: int, seconds: int) -> None:
    found, _ = watched(lambda receive: receive * ppm // 10**6, seconds)
    assert found[-1] == pytest.approx(ppm, rel=0.1)


@pytest.mark.parametrize("ppm", [-600, -300, -50, 0, 50, 300, 600])
def test_crystals_and_slewed_hosts_are_usable(ppm: int) -> None:
    found, _ = watched(lambda receive: receive * ppm // 10**6, 600)
    assert set(found) == {None}


@pytest.mark.parametrize(
    "latency",
    [
        lambda t: min(t // 10, 900 * MS),  # a queue fills
        lambda t: min(t // 4, 10 * SECOND),  # a long one
        lambda t: max(900 * MS - t // 20, 0) if t > 3 * SECOND else 0,  # one that has filled empties
        lambda t: 3 * SECOND - t if t < 3 * SECOND else 0,  # what had been sent before comes first
        lambda t: 0 if t < 30 * SECOND else -5 * SECOND,  # the clock jumps
        lambda t: 200 * MS if t % (60 * SECOND) > 30 * SECOND else 0,
    ],
)
def test_latency_is_no_drift(latency: Callable[[int], int]) -> None:
    found, _ = watched(latency, 120)
    assert set(found) == {None}


def test_a_clock_that_is_steady_again_is_usable_again() -> None:
    found, _ = watched(lambda receive: -min(receive, 20 * SECOND) // 50, 60)
    assert found[15] is not None
    assert found[25:] == [None] * 35


def test_round_trips_show_a_slow_clock_soon() -> None:
    """A queue that fills looks like one by receipts, but it does not make answers earlier."""
    for speed, usable in ((0.98, False), (1.0, True)):
        clock, random = Clock(Config()), Random(3)
        for k in range(15 * 50):
            receive = k * 20 * MS
            if k % 50 == 0:
                wait = round(random.uniform(0, 20) * MS)
                read = SECOND + round((receive + wait) * speed)
                pair = ClockPair(HOST_CLOCK, T0 + receive)
                clock.align(Received("fc.timesync", k, BOOT, read, T0 + receive + wait + MS, pair))
            clock.align(imu(SECOND + round(receive * speed), T0 + receive + 5 * MS + receive // 20))
        assert clock.report()[BOOT].usable is usable


@pytest.mark.parametrize(("speed", "seconds"), [(2.0, 15), (1.02, 15), (0.5, 125), (0.98, 125)])
def test_the_stamps_of_such_a_clock_are_invalid_and_it_is_named(speed: float, seconds: int) -> None:
    clock = Clock(Config())
    for k in range(seconds * 50):
        receive = k * 20 * MS
        clock.align(imu(SECOND + round(receive * speed), T0 + receive + 5 * MS))
    assert reason(clock, imu(SECOND + round(seconds * SECOND * speed), T0 + seconds * SECOND + 5 * MS)) == UNUSABLE
    report = clock.report()[BOOT]
    assert not report.usable
    assert report.drift_ppm == pytest.approx(1e6 * (1 - speed), rel=0.1)
    assert report.note.startswith(f"unusable: it runs {1 - report.drift_ppm / 1e6:.4f} times as fast as the host's")
    clock.forget()
    assert valid(clock, imu(SECOND, T0)) == T0
