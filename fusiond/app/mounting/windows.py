"""A drive cut into windows of a second: specific force, angular rate, speed and turn rate in each."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.config.schema import Config
from fusiond.errors import UnusableError
from fusiond.events import GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.maths.typed import Array
from fusiond.units import MILLISECOND, SECOND

BIN_NS = 100 * MILLISECOND  # readings are averaged over this time
BIN = BIN_NS * 1e-9  # s
WINDOW_BINS = 10  # of a window: its change of speed is that between its ends
WINDOW = WINDOW_BINS * BIN  # s
MIN_WINDOWS = 10
APART_NS = 10 * SECOND  # between two sessions: more than any latency
MAX_GAP = 1.5  # s: between two speeds further apart none is known
MIN_COURSE_SPEED = 3.0  # m/s: at a lower speed the course is not used


class MountingError(UnusableError):
    """The drive does not determine the rotation; the message says what is missing or wrong."""


class Windows(NamedTuple):
    """The drive in K windows of length `WINDOW`, in the order of time."""

    number: NDArray[np.int64]  # (K,) index on the time line: neighbours differ by 1
    force: Array  # (K, WINDOW_BINS, 3) m/s^2, means of bins
    rate: Array  # (K, WINDOW_BINS, 3) rad/s, means of bins
    speed: Array  # (2, K) m/s, at both ends
    turn: Array  # (K,) rad/s, to the right; nan if neither course nor wheels give it
    axle: float  # m, forward of the sensor: the point that moves only forward
    speed_from: str  # wheels or GNSS

    @property
    def acceleration(self) -> Array:
        """(K,) m/s^2"""
        change: Array = (self.speed[1] - self.speed[0]) / WINDOW
        return change


Bins = dict[int, list[float]]  # by number of the bin: count of the readings, and their sums
MAX_BINS = 72_000  # of a source: two hours; what comes later is not gathered


class Gathering:
    """Collects the aligned events of a drive, in any order."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._span_ns: tuple[int, int] | None = None
        self.moved_ns = 0  # added to the stamps of the present session
        self.imu: Bins = {}  # specific force, angular rate
        self.course: Bins = {}  # velocity north, east
        self.wheels: dict[str, Bins] = {name: {} for name in config.wheel}  # speed

    def begin_session(self, t_receive_ns: int) -> None:
        """Receipts have stepped back, to this one: what follows is placed after all the rest."""
        if self._span_ns:
            self.moved_ns = self._span_ns[1] + APART_NS - t_receive_ns

    def add(self, measurement: Measurement) -> None:
        """Add one event; other kinds are ignored."""
        payload, t_ns = measurement.payload, measurement.t_ns + self.moved_ns
        if isinstance(payload, WheelSpeed):
            _put(self.wheels[measurement.source], t_ns, (payload.speed,))
        elif isinstance(payload, ImuSample):
            self._span_ns = (self._span_ns or (t_ns, 0))[0], t_ns
            _put(self.imu, t_ns, payload.specific_force_b + payload.angular_rate_b)
        elif isinstance(payload, GnssVelocity):
            _put(self.course, t_ns, (payload.north, payload.east))

    @property
    def elapsed_ns(self) -> int:
        """From the first inertial sample to the newest."""
        return self._span_ns[1] - self._span_ns[0] if self._span_ns else 0

    def windows(self, *, by_gnss: bool = False) -> Windows:
        """Means over whole windows in which a speed is known, with `by_gnss` from GNSS in place of the wheels. Raises
        MountingError if there are too few."""
        if not self.imu:
            raise MountingError("the logs have no sample of the inertial sensor")
        keys, means = means_of(self.imu)
        numbers, starts, counts = np.unique(keys // WINDOW_BINS, return_index=True, return_counts=True)
        numbers, starts = numbers[counts == WINDOW_BINS], starts[counts == WINDOW_BINS]
        samples = means[starts[:, None] + np.arange(WINDOW_BINS)]
        ends = np.stack([numbers, numbers + 1]) * WINDOW_BINS
        course = at(self.course, ends, 2)
        wheels = {name: at(bins, ends, 1)[..., 0] for name, bins in self.wheels.items() if bins and not by_gnss}
        speeds, speed_from = self._speeds(course, wheels)
        known = np.isfinite(speeds).all(axis=0)
        if known.sum() < MIN_WINDOWS:
            seconds = f"{known.sum() * WINDOW:.0f} s"
            raise MountingError(
                f"the speed is known from wheels or GNSS for {seconds} only; {MIN_WINDOWS * WINDOW:.0f} s are needed"
            )
        turn = np.where(np.isfinite(course_turn := _turn(course)), course_turn, self._turn_by_wheels(wheels, len(numbers)))
        return Windows(
            number=numbers[known],
            force=samples[known, :, :3],
            rate=samples[known, :, 3:],
            speed=speeds[:, known],
            turn=turn[known],
            axle=self._config.motion.point_m[0],
            speed_from=speed_from,
        )

    def _speeds(self, course: Array, wheels: dict[str, Array]) -> tuple[Array, str]:
        """Speed (2, K) [m/s] at both ends of the windows: of the unsteered wheels, else of all wheels, else from GNSS."""
        straight = [speed for name, speed in wheels.items() if not self._config.wheel[name].steered]
        chosen = straight or list(wheels.values())
        if chosen:
            return np.mean(chosen, axis=0), "wheels"
        return np.hypot(course[..., 0], course[..., 1]), "GNSS"

    def _turn_by_wheels(self, wheels: dict[str, Array], count: int) -> Array:
        """Turn rate (K,) [rad/s] from the speeds of unsteered wheels left and right; nan if there are none."""
        straight = [name for name in wheels if not self._config.wheel[name].steered]
        right = np.array([self._config.wheel[name].position_m[1] for name in straight])
        if len(straight) < 2 or np.ptp(right) == 0:
            return np.full(count, math.nan)
        off = right - right.mean()
        speeds = np.array([wheels[name].mean(axis=0) for name in straight])
        turn: Array = -(off @ speeds) / float(off @ off)
        return turn


def _put(bins: Bins, t_ns: int, values: tuple[float, ...]) -> None:
    total = bins.get(t_ns // BIN_NS)
    if total is not None:
        total[0] += 1.0
        for place, value in enumerate(values, 1):
            total[place] += value
    elif len(bins) < MAX_BINS:
        bins[t_ns // BIN_NS] = [1.0, *values]


def means_of(bins: Bins) -> tuple[NDArray[np.int64], Array]:
    """The numbers of the bins (K,), in order, and the means of their readings (K, n)."""
    keys = np.array(sorted(bins))
    totals = np.array([bins[key] for key in keys.tolist()])
    return keys, totals[:, 1:] / totals[:, :1]


def at(bins: Bins, instants: NDArray[np.int64] | Array, width: int) -> Array:
    """Means of a source (..., width) at some instants, counted in bins: interpolated between the two nearest; nan if those
    are far apart."""
    found = np.full((*instants.shape, width), math.nan)
    if len(bins) < 2:
        return found
    keys, means = means_of(bins)
    after = np.clip(np.searchsorted(keys + 0.5, instants), 1, len(keys) - 1)
    apart = keys[after] - keys[after - 1]
    share = (instants - keys[after - 1] - 0.5) / apart
    near = (apart * BIN <= MAX_GAP) & (share >= -1) & (share <= 2)
    between = means[after - 1] + share[..., None] * (means[after] - means[after - 1])
    found[near] = between[near]
    return found


def _turn(course: Array) -> Array:
    """Turn rate (K,) [rad/s] to the right from velocities (2, K, 2) [m/s]; nan if they are slow or unknown."""
    (north_0, east_0), (north_1, east_1) = course[0].T, course[1].T
    turned = np.arctan2(north_0 * east_1 - east_0 * north_1, north_0 * north_1 + east_0 * east_1) / WINDOW
    slow = ~(np.minimum(np.hypot(north_0, east_0), np.hypot(north_1, east_1)) > MIN_COURSE_SPEED)
    turned[slow] = math.nan
    result: Array = turned
    return result
