"""What the sensors of a configuration measured in logs, as arrays, and figures of it: noise, lags, speeds."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable

import numpy as np

from fusiond.app.inspection.facts import SourceFacts
from fusiond.app.mounting.rotation import Mounting, find
from fusiond.app.mounting.windows import Gathering
from fusiond.config.schema import Config
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Invalid, Measurement, Received, WheelSpeed
from fusiond.maths.typed import Array
from fusiond.timeline.clock import Clock
from fusiond.units import MILLISECOND, SECOND

LAGS_S = np.arange(-0.5, 1.01, 0.01)
LEAST_COMMON = 20  # speeds of both kinds from which a lag can be told
LATE_NS = 30 * MILLISECOND  # a fix that comes sooner is stamped on its arrival
LEAST_SPREAD = 0.5  # m/s, of the speeds


class Drive:
    """The measurements of a drive, by source."""

    def __init__(self, config: Config, events: Iterable[Received]) -> None:
        self.config = config
        self._clock, self._windows = Clock(config), Gathering(config)
        self._rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        self._late: dict[str, list[int]] = defaultdict(list)
        self._invalid: dict[str, Counter[str]] = defaultdict(Counter)
        self._fixes: dict[str, Counter[int]] = defaultdict(Counter)
        self._stamped_by: dict[str, str] = {}  # the clock of each source
        self._origin_ns: int | None = None
        for event in events:
            if self._clock.steps_back(event):
                self._clock.forget()
                self._windows.begin_session(event.t_receive_ns)
            measurement = self._clock.align(event)
            if measurement is not None:
                self._windows.add(measurement)
                self._add(measurement)
                self._stamped_by[measurement.source] = event.clock

    def _add(self, measurement: Measurement) -> None:
        source, payload = measurement.source, measurement.payload
        if self._origin_ns is None:
            self._origin_ns = measurement.t_ns
        t_s = (measurement.t_ns - self._origin_ns) / SECOND
        match payload:
            case Invalid(reason):
                self._invalid[source][reason] += 1
                return
            case ImuSample(force, rate):
                self._rows[source].append((t_s, *force, *rate))
            case GnssPosition():
                self._fixes[source][payload.fix_type] += 1
                self._rows[source].append((t_s, payload.latitude, payload.longitude, payload.height))
            case GnssVelocity():
                self._rows[source].append((t_s, payload.north, payload.east))
            case WheelSpeed():
                self._rows[source].append((t_s, payload.speed))
            case _:
                self._rows[source].append((t_s,))
        self._late[source].append(measurement.t_receive_ns - measurement.t_ns)

    def rows(self, source: str) -> Array:
        """The valid measurements of a source in the order of time: (n, 1 + k), the first column their time [s]."""
        rows = np.array(self._rows.get(source, []), float)
        return rows[np.argsort(rows[:, 0], kind="stable")] if len(rows) else np.zeros((0, 1))

    @property
    def origin_ns(self) -> int:
        """The instant that the times of `rows` count from."""
        return self._origin_ns or 0

    def knows_lateness(self, source: str) -> bool:
        """Whether the stamps of a source tell how late it is: they are aligned by more than their receipts, and are late."""
        report = self._clock.report().get(self._stamped_by.get(source, ""))
        anchored = report is not None and report.method in ("unix", "system_time", "timesync")
        return anchored and float(np.median(self._late[source] or [0])) >= LATE_NS

    def noise(self, source: str) -> tuple[float, float]:
        """The largest noise densities of an inertial sensor: accelerometer [m/s^2/sqrt(Hz)], gyro [rad/s/sqrt(Hz)]."""
        accel, gyro = imu_noise(self.rows(source))
        return float(accel.max()), float(gyro.max())

    def gnss_speed(self) -> Array:
        """Time [s] and speed over ground [m/s]: (n, 2), of the receiver that gives most."""
        found = [self.rows(name) for name, source in self.config.streams().items() if source.stream.payload is GnssVelocity]
        best = max(found, key=len, default=np.zeros((0, 3)))
        return np.stack([best[:, 0], np.hypot(best[:, 1], best[:, 2])], 1) if len(best) else np.zeros((0, 2))

    def wheel_speed(self) -> Array:
        """Time [s] and amount of the speed [m/s] of all wheels: (n, 2)."""
        found = [self.rows(name) for name, source in self.config.streams().items() if source.stream.payload is WheelSpeed]
        rows = np.concatenate([rows for rows in found if len(rows)] or [np.zeros((0, 2))])
        amounts: Array = np.abs(rows[np.argsort(rows[:, 0], kind="stable")])
        return amounts

    def mounting(self) -> Mounting:
        """The rotation of the inertial sensor. Raises MountingError."""
        ((_, imu),) = self.config.imu.items()
        return find(self._windows.windows(), imu.rotation_deg)

    def clocks(self) -> dict[str, str]:
        """How each clock is aligned, in words."""
        return {
            name: f"{report.method.replace('_', ' ')}, offset {report.offset_ns / SECOND:+.3f} s, "
            f"drift {report.drift_ppm:.0f} ppm, {report.resets} re-alignments" + (f"; {report.note}" if report.note else "")
            for name, report in self._clock.report().items()
        }

    def facts(self) -> list[SourceFacts]:
        """The figures of each source."""
        return [self._facts(name) for name in self.config.sources()]

    def _facts(self, name: str) -> SourceFacts:
        rows, source = self.rows(name), self.config.streams()[name]
        steps = np.diff(rows[:, 0]) if len(rows) > 1 else np.zeros(1)
        median = float(np.median(steps))
        about: dict[str, float] = {}
        if len(rows) > 1 and source.stream.payload is ImuSample:
            about["accel_noise"], about["gyro_noise"] = self.noise(name)
            about["mean_force_mps2"] = float(np.linalg.norm(rows[:, 1:4].mean(0)))
        elif len(rows) and source.stream.payload is GnssPosition:
            about = {f"fix type {kind}": float(count) for kind, count in sorted(self._fixes[name].items())}
        elif len(rows) and source.stream.payload in (GnssVelocity, WheelSpeed):
            speeds = np.abs(rows[:, 1]) if rows.shape[1] == 2 else np.hypot(rows[:, 1], rows[:, 2])
            about = {"slowest_mps": float(speeds.min()), "fastest_mps": float(speeds.max())}
        late = self._late.get(name)
        return SourceFacts(
            name=name,
            reads=source.section.origin(),
            count=len(rows),
            rate_hz=1 / median if median > 0 else 0.0,
            jitter_ms=1.4826e3 * float(np.median(np.abs(steps - median))),
            gap_s=float(steps.max()),
            late_ms=float(np.median(late)) / MILLISECOND if late else 0.0,
            invalid=dict(self._invalid.get(name, {})),
            about=about,
        )


def imu_noise(rows: Array) -> tuple[Array, Array]:
    """Noise densities of an inertial sensor, vibration included, from the differences of successive samples, in which slow
    changes such as driving cancel: of the accelerometer [m/s^2/sqrt(Hz)] and the gyro [rad/s/sqrt(Hz)], (3,) each.
    `rows`: (n, 7) time, specific force, angular rate."""
    interval_s = float(np.median(np.diff(rows[:, 0])))
    white = np.diff(rows[:, 1:], axis=0).std(axis=0) / np.sqrt(2) * np.sqrt(interval_s)
    return white[:3], white[3:]


def lag(gnss: Array, wheels: Array) -> tuple[float, float] | None:
    """How much the GNSS speed lags behind that of the wheels [s], and the misfit that is left [m/s]; None where there is too
    little of both. The scale of the wheels is free. Each is (n, 2): time [s], speed [m/s]."""
    if len(gnss) < LEAST_COMMON or len(wheels) < LEAST_COMMON:
        return None
    inside = (gnss[:, 0] > wheels[0, 0] + LAGS_S[-1]) & (gnss[:, 0] < wheels[-1, 0] + LAGS_S[0])
    t_s, speed = gnss[inside].T
    if len(t_s) < LEAST_COMMON or speed.std() < LEAST_SPREAD:
        return None

    def misfit(lag_s: float) -> float:
        wheel = np.interp(t_s - lag_s, wheels[:, 0], wheels[:, 1])
        return float(np.std(speed - wheel * (wheel @ speed) / max(float(wheel @ wheel), 1e-9)))

    best = min(LAGS_S.tolist(), key=misfit)
    return best, misfit(best)
