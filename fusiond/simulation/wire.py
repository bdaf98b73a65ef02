"""Simulated messages as they were received, in the units of the wire, and the events that the log readers make of them.

Every stream is in the order of receipt; `t_receive_us` is microseconds on the receiving host's clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.events import (
    UNIX_CLOCK,
    ClockPair,
    GnssPosition,
    GnssVelocity,
    ImuSample,
    Invalid,
    Pressure,
    Received,
    WheelSpeed,
    boot_clock,
)
from fusiond.simulation.barometer import CENTI_CELSIUS
from fusiond.simulation.gnss import FIX_3D, Fixes
from fusiond.simulation.scenario import WHEELS
from fusiond.simulation.transport import Mask, Stamps
from fusiond.units import MICROSECOND, MILLISECOND

LINK, BUS, IMU, GNSS, BAROMETER, SYSTEM = "fcu", "car", "imu0", "gps0", "baro0", 1  # the names in the matching configuration
BOOT_CLOCK = boot_clock(LINK, SYSTEM)
UNIX_FROM_US = 10**15  # a `time_usec` beyond this is Unix time


@dataclass(frozen=True, slots=True)
class ImuMessages:
    """HIGHRES_IMU."""

    t_receive_us: Stamps
    counter: Stamps  # of the link's frames
    time_us: Stamps  # of the boot clock
    specific_force_b: NDArray[np.float32]  # (N, 3) m/s^2
    angular_rate_b: NDArray[np.float32]  # (N, 3) rad/s

    def events(self) -> Iterator[Received]:
        columns = (self.t_receive_us, self.time_us, self.specific_force_b, self.angular_rate_b)
        for sequence, (t_us, time_us, force, rate) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            payload = ImuSample(tuple(force), tuple(rate))
            yield Received(IMU, sequence, BOOT_CLOCK, time_us * MICROSECOND, t_us * MICROSECOND, payload)


@dataclass(frozen=True, slots=True)
class GnssMessages:
    """GPS_RAW_INT."""

    t_receive_us: Stamps
    counter: Stamps
    time_us: Stamps  # Unix, of the boot clock, or 0
    fixes: Fixes

    def events(self) -> Iterator[Received]:
        fixes = self.fixes
        places = (fixes.lat, fixes.lon, fixes.alt, fixes.alt_ellipsoid, fixes.h_acc, fixes.v_acc)
        columns = (fixes.fix_type, *places, fixes.vel, fixes.cog)
        velocities = 0
        for sequence, (t_us, time_us, fix_type, *fix) in enumerate(
            zip(*(c.tolist() for c in (self.t_receive_us, self.time_us, *columns)), strict=True)
        ):
            clock = (UNIX_CLOCK if time_us >= UNIX_FROM_US else BOOT_CLOCK) if time_us else ""
            stamp = (clock, time_us * MICROSECOND if time_us else None, t_us * MICROSECOND)
            if fix_type < FIX_3D:
                yield Received(f"{GNSS}.position", sequence, *stamp, Invalid("no fix"))
                continue
            yield Received(f"{GNSS}.position", sequence, *stamp, self._position(fix_type, *fix[:6]))
            yield Received(f"{GNSS}.velocity", velocities, *stamp, self._velocity(*fix[6:]))
            velocities += 1

    def _position(
        self, fix_type: int, lat: int, lon: int, alt: int, alt_ellipsoid: int, h_acc: int, v_acc: int
    ) -> GnssPosition:
        return GnssPosition(
            latitude=math.radians(lat / 1e7),
            longitude=math.radians(lon / 1e7),
            height=(alt_ellipsoid or alt) / 1e3,
            sigma_horizontal=h_acc / 1e3 or None,
            sigma_vertical=v_acc / 1e3 or None,
            fix_type=fix_type,
        )

    def _velocity(self, vel: int, cog: int) -> GnssVelocity:
        speed, course = vel / 1e2, math.radians(cog / 1e2)
        return GnssVelocity(speed * math.cos(course), speed * math.sin(course), None, self.fixes.vel_acc / 1e3 or None)


@dataclass(frozen=True, slots=True)
class PressureMessages:
    """SCALED_PRESSURE."""

    t_receive_us: Stamps
    counter: Stamps
    boot_ms: Stamps
    hectopascal: NDArray[np.float32]

    def events(self) -> Iterator[Received]:
        columns = (self.t_receive_us, self.boot_ms, self.hectopascal)
        for sequence, (t_us, boot_ms, hectopascal) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            payload = Pressure(hectopascal * 100.0, CENTI_CELSIUS / 100 + 273.15)
            yield Received(BAROMETER, sequence, BOOT_CLOCK, boot_ms * MILLISECOND, t_us * MICROSECOND, payload)


@dataclass(frozen=True, slots=True)
class TimeMessages:
    """SYSTEM_TIME."""

    t_receive_us: Stamps
    counter: Stamps
    unix_us: Stamps
    boot_ms: Stamps

    def events(self) -> Iterator[Received]:
        columns = (self.t_receive_us, self.unix_us, self.boot_ms)
        for sequence, (t_us, unix_us, boot_ms) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            pair = ClockPair(BOOT_CLOCK, boot_ms * MILLISECOND)
            yield Received(f"{LINK}.time", sequence, UNIX_CLOCK, unix_us * MICROSECOND, t_us * MICROSECOND, pair)


@dataclass(frozen=True, slots=True)
class Heartbeats:
    """HEARTBEAT; it gives no event."""

    t_receive_us: Stamps
    counter: Stamps


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Another message of the autopilot, which the filter does not use."""

    message: str
    t_receive_us: Stamps
    counter: Stamps
    boot_ms: Stamps
    instant: Stamps  # index of the truth that it reports


@dataclass(frozen=True, slots=True)
class WheelFrames:
    """The CAN frame of the wheels."""

    t_receive_us: Stamps
    raw: Stamps  # (N, 4) in the order of WHEELS
    fault: Mask  # (N,)
    counter: Stamps  # (N,)
    resolution_kmh: float

    def events(self) -> Iterator[Received]:
        columns = (self.t_receive_us, self.raw, self.fault, self.counter)
        last = None
        for sequence, (t_us, raw, fault, counter) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            complaint = Invalid("stale counter") if counter == last else Invalid("valid_signal") if fault else None
            last = counter
            for name, value in zip(WHEELS, raw, strict=True):
                payload = complaint or WheelSpeed(value * self.resolution_kmh * (1 / 3.6))
                yield Received(name, sequence, "", None, t_us * MICROSECOND, payload)


@dataclass(frozen=True, slots=True)
class CanFrames:
    """The frames of one CAN id."""

    identifier: int
    t_receive_us: Stamps
    data: NDArray[np.uint64]  # (N,) eight bytes, the first one the most significant
