"""Stamped events for the tests of the clock."""

from __future__ import annotations

import random

from fusiond.events import (
    ClockPair,
    GnssPosition,
    GnssVelocity,
    ImuSample,
    Invalid,
    Measurement,
    Received,
    boot_clock,
)
from fusiond.timeline.clock import Clock
from fusiond.units import MILLISECOND as MS
from fusiond.units import SECOND
from tests.helpers.paths import CAPTURED

HOUR = 3_600 * SECOND
YEAR = 8_766 * HOUR
T0 = 1_700_000_000 * SECOND  # Unix time at which the autopilot booted
BOOT = boot_clock("autopilot")
TRACES = CAPTURED / "comma2k19-rav4"

IMU = ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0))
FIX = GnssPosition(0.6, -2.1, 33.0)
VELOCITY = GnssVelocity(1.0, 2.0)


def imu(stamp: int, receive: int) -> Received:
    return Received("imu0", 0, BOOT, stamp, receive, IMU)


def fix(stamp: int, receive: int, clock: str = "unix", source: str = "gps0.position") -> Received:
    return Received(source, 0, clock, stamp, receive, FIX)


def system_time(unix: int, boot: int, receive: int) -> Received:
    """SYSTEM_TIME, whose boot time is cut off to a millisecond."""
    return Received("system_time", 0, "unix", unix, receive, ClockPair(BOOT, boot // MS * MS))


def measured(clock: Clock, received: Received) -> Measurement:
    measurement = clock.align(received)
    assert measurement is not None
    return measurement


def valid(clock: Clock, received: Received) -> int:
    measurement = measured(clock, received)
    assert measurement.payload == received.payload
    return measurement.t_ns


def reason(clock: Clock, received: Received) -> str:
    payload = measured(clock, received).payload
    assert isinstance(payload, Invalid)
    return payload.reason


def feed_imu(
    clock: Clock,
    start: int,
    stop: int,
    host: int = T0,
    *,
    latency: int = 5 * MS,
    period: int = 10 * MS,
    drift_ppm: int = 0,
    jitter: random.Random | None = None,
) -> list[int]:
    """Valid IMU samples of boot time [start, stop); the error of each aligned stamp against boot + host + drift."""
    errors = []
    for boot in range(start, stop, period):
        truth = host + boot + boot * drift_ppm // 10**6
        extra = round(jitter.expovariate(1 / (5 * MS))) if jitter else 0
        errors.append(valid(clock, imu(boot, truth + latency + extra)) - truth)
    return errors


def feed_with_pairs(clock: Clock, start: int, stop: int, host: int = 0, stale: int = 0) -> list[int]:
    """IMU of 5 to 25 ms latency, with a pair a second; errors against Unix time. The host is ahead by `host`."""
    rng = random.Random(start)
    errors = []
    for boot in range(start, stop, 10 * MS):
        receive = T0 + boot + host + round(rng.uniform(5, 25) * MS)
        errors.append(measured(clock, imu(boot, receive)).t_ns - T0 - boot)
        if (boot - start) % SECOND == 400 * MS:
            pair_boot = boot + rng.randrange(10 * MS)
            assert clock.align(system_time(T0 + pair_boot, pair_boot - stale, T0 + pair_boot + host + 5 * MS)) is None
    return errors
