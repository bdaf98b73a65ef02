"""The measurements of a log as arrays, on the time line of a replay."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace

from fusiond.config.schema import Config
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import ecef, mat_ne
from fusiond.timeline.clock import Clock
from fusiond_adapters.logs.merge import open_logs


@dataclass
class Readings:
    """The readings of one source: stamps [s], from the first measurement of all, rising; and numbers (N, k)."""

    t: Array
    values: Array


@dataclass
class LogSeries:
    """A log's measurements: as events in their order of receipt, and by source as numbers.

    The inertial sensor: specific force and angular rate (N, 6). Positions: north, east, down (N, 3) [m] from the first fix,
    and the receiver's own sigma [m] or 0, and the fix type (N, 5). Velocities (N, 3). Wheels (N, 1).
    """

    events: list[Measurement] = field(default_factory=list)
    readings: dict[str, Readings] = field(default_factory=dict)
    origin_ns: int = 0
    seconds: float = 0.0
    delays: dict[str, int] = field(default_factory=dict)  # by source [ns]: those that stamps were aligned with
    first: tuple[Array, Array] | None = None  # of the first fix: axes north-east-down (3, 3), and place, earth-fixed [m]

    def under(self, config: Config) -> Iterator[Measurement]:
        """The events, aligned with the delays of another configuration; sources that it does not have are left out."""
        by = {source: found.delay_ns - self.delays.get(source, 0) for source, found in config.streams().items()}
        for event in self.events:
            if (later := by.get(event.source)) is not None:
                yield event if later == 0 else replace(event, t_ns=event.t_ns - later)


def read_series(logs: Sequence[str], config: Config) -> LogSeries:
    """Read logs. Raises LogError."""
    clock, found = Clock(config), LogSeries(delays={name: one.delay_ns for name, one in config.streams().items()})
    rows: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    for event in open_logs(logs, config):
        measurement = clock.align(event)
        if measurement is None:
            continue
        found.events.append(measurement)
        payload = measurement.payload
        numbers: tuple[float, ...] = ()
        if isinstance(payload, ImuSample):
            numbers = payload.specific_force_b + payload.angular_rate_b
        elif isinstance(payload, GnssPosition):
            place = ecef(payload.latitude, payload.longitude, payload.height)
            first = found.first = found.first or (mat_ne(place), place)
            north, east, down = (first[0] @ (place - first[1])).tolist()
            numbers = (north, east, down, payload.sigma_horizontal or 0.0, float(payload.fix_type))
        elif isinstance(payload, GnssVelocity):
            numbers = (payload.north, payload.east, payload.down or 0.0)
        elif isinstance(payload, WheelSpeed):
            numbers = (payload.speed,)
        if numbers:
            rows.setdefault(measurement.source, []).append((measurement.t_ns, numbers))
    if found.events:
        found.origin_ns = min(measurement.t_ns for measurement in found.events)
        found.seconds = (max(measurement.t_ns for measurement in found.events) - found.origin_ns) * 1e-9
    for source, some in rows.items():
        some.sort(key=lambda row: row[0])
        stamps = np.array([row[0] for row in some], dtype=np.int64)
        rising = np.concatenate([[True], np.diff(stamps) > 0])
        found.readings[source] = Readings((stamps[rising] - found.origin_ns) * 1e-9, np.array([r[1] for r in some])[rising])
    return found


def until(readings: Readings | None, seconds: float) -> Readings | None:
    """The readings before an instant; None where there are none."""
    if readings is None:
        return None
    inside = readings.t < seconds
    return Readings(readings.t[inside], readings.values[inside]) if inside.any() else None
