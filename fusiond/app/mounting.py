"""Finds how the inertial sensor is turned against the vehicle, from a drive: any rotation, upside down included.

The drive is cut into segments of some seconds. In the axes that the sensor has in the middle of a segment, to which the
gyro carries every other instant, gravity stands still, so between two instants

    integral of the specific force = -gravity down dt + (velocity at the end) - (velocity at the begin)

with the velocity of the sensor: speed forward, and what it swings about the unsteered axle in bends. That is linear in
`down`, one for each segment (roads slope), and in `forward`, which is the same in the sensor's own axes all the time; the
speed is told by wheels or GNSS. The mean of `down` is that of the vehicle. Turning about the sensor's axes, set against the
change of the course, gives it once more. The rotation that fits the directions best, each by its uncertainty, is Wahba's
problem, solved by singular values (Markley and Crassidis 2014, section 5.4).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.config.schema import Config
from fusiond.errors import UnusableError
from fusiond.events import GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.maths.rotation import euler, matrix, matrix_from_euler, quaternion_exp, skew
from fusiond.maths.typed import Array

BIN_NS = 100_000_000  # readings are averaged over so long on arrival
BIN = BIN_NS * 1e-9  # s
WINDOW_BINS = 10  # of a window, between whose ends the change of speed is looked at
WINDOW = WINDOW_BINS * BIN  # s
SEGMENT_WINDOWS = 10  # of a segment: as long as a gyro can be left to itself
LEAST_SEGMENT = 4  # windows
LONGEST_GAP = 1.5  # s: between two speeds further apart none is known
COURSE_SPEED = 3.0  # m/s: slower than this the course is not looked at
LEAST_WINDOWS = 10
STANDING = 0.1  # m/s: slower than this the vehicle stands
GRAVITY_LIMITS = (9.0, 10.6)  # m/s^2: what the accelerometer may read on average
SPEED_FIT = (0.5, 1.6)  # what the force may grow with the acceleration that the speeds tell, where that is sure
MOST_SIGMA = math.radians(6.0)  # a rotation less certain than this is not told
CONTRADICTION = math.radians(20.0)  # directions that fit a rotation no better contradict each other
TOLD = math.radians(20.0)  # what is less certain than this is not worth a line
SURE = math.radians(7.0)  # and what is less certain than this contradicts nothing
ROAD_SIGMA = math.radians(2.0)  # rad: how the down of one segment scatters about the vehicle's, at least where there are few
LEVEL_SIGMA = math.radians(0.7)  # rad: what no number of segments tells: the mean slope, the load, the accelerometer's bias
FORWARD_SIGMA = math.radians(0.5)  # rad: likewise
TURNING_SIGMA = math.radians(1.0)  # rad: likewise: bends on slopes, body roll
MOST_CORRELATION = 0.9
DOWN, FORWARD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])

MEANING = {
    "level": "down, by the mean specific force",
    "forward": "forward, by the specific force while the speed changes",
    "turning": "down, by the gyro while the course changes",
}


class MountingError(UnusableError):
    """The rotation cannot be told from this drive; the message says what is missing or wrong."""


class Direction(NamedTuple):
    """One direction found: in sensor axes (3,), unit; where it points in the vehicle (3,); its sigma [rad]."""

    name: str
    sensed: Array
    vehicle: Array
    sigma: float


class Mounting(NamedTuple):
    """How the sensor lies, and what that rests on."""

    rotation: tuple[float, float, float]  # rad: roll, pitch, yaw, to be configured
    turned: float  # rad, from what is configured
    sigma: tuple[float, float, float]  # rad, about the vehicle's forward, right and down axes
    directions: tuple[tuple[str, float, float], ...]  # name, rad off the rotation found, sigma [rad]
    seconds: float  # of the drive looked at
    standing: float  # s of them
    acceleration: float  # m/s^2, root mean square
    turning: float  # rad/s, root mean square
    speed_from: str  # wheels or GNSS


class Windows(NamedTuple):
    """The drive in windows of `WINDOW`, K of them, in the order of time."""

    number: NDArray[np.int64]  # (K,) counted in windows: tells neighbours
    force: Array  # (K, WINDOW_BINS, 3) m/s^2, means of bins
    rate: Array  # (K, WINDOW_BINS, 3) rad/s, likewise
    speed: Array  # (2, K) m/s, at begin and end
    turn: Array  # (K,) rad/s, to the right; nan where neither course nor wheels tell it
    axle: float  # m, forward of the sensor: where the vehicle goes nowhere but forward
    speed_from: str

    @property
    def acceleration(self) -> Array:
        """(K,) m/s^2"""
        change: Array = (self.speed[1] - self.speed[0]) / WINDOW
        return change


Bins = dict[int, Array]


class Gathering:
    """Takes the events of a drive, aligned, in any order."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._span_ns: tuple[int, int] | None = None
        self._imu: Bins = {}
        self._course: Bins = {}
        self._wheels: dict[str, Bins] = {name: {} for name in config.wheel}

    def add(self, measurement: Measurement) -> None:
        """Take one event; kinds that do not matter are passed over."""
        payload = measurement.payload
        if isinstance(payload, ImuSample):
            self._span_ns = (self._span_ns or (measurement.t_ns, 0))[0], measurement.t_ns
            _put(self._imu, measurement.t_ns, (*payload.specific_force_b, *payload.angular_rate_b))
        elif isinstance(payload, GnssVelocity):
            _put(self._course, measurement.t_ns, (payload.north, payload.east))
        elif isinstance(payload, WheelSpeed):
            _put(self._wheels[measurement.source], measurement.t_ns, (payload.speed,))

    @property
    def elapsed_ns(self) -> int:
        """From the first inertial sample to the newest."""
        return self._span_ns[1] - self._span_ns[0] if self._span_ns else 0

    def windows(self) -> Windows:
        """Means over whole windows in which a speed is known. MountingError where there is none."""
        if not self._imu:
            raise MountingError("there is no sample of the inertial sensor in the logs")
        keys = np.array(sorted(self._imu))
        numbers, starts, counts = np.unique(keys // WINDOW_BINS, return_index=True, return_counts=True)
        numbers, starts = numbers[counts == WINDOW_BINS], starts[counts == WINDOW_BINS]
        means = np.array([self._imu[key][1:] / self._imu[key][0] for key in keys.tolist()])
        samples = means[starts[:, None] + np.arange(WINDOW_BINS)]
        ends = np.stack([numbers, numbers + 1]) * WINDOW_BINS
        course = _at(self._course, ends, 2)
        wheels = {name: _at(bins, ends, 1)[..., 0] for name, bins in self._wheels.items() if bins}
        speeds, speed_from = self._speeds(course, wheels)
        known = np.isfinite(speeds).all(axis=0)
        if known.sum() < LEAST_WINDOWS:
            seconds = f"{known.sum() * WINDOW:.0f} s"
            raise MountingError(
                f"wheels or GNSS tell the speed for {seconds} only; {LEAST_WINDOWS * WINDOW:.0f} s are needed"
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
        """Speed (2, K) [m/s] at both ends of the windows: that of the wheels that do not steer, or of all; else GNSS's."""
        straight = [speed for name, speed in wheels.items() if not self._config.wheel[name].steered]
        chosen = straight or list(wheels.values())
        if chosen:
            return np.mean(chosen, axis=0), "wheels"
        return np.hypot(course[..., 0], course[..., 1]), "GNSS"

    def _turn_by_wheels(self, wheels: dict[str, Array], count: int) -> Array:
        """Turn rate (K,) [rad/s] by the speeds of unsteered wheels left and right; nan where there are none such."""
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
    if total is None:
        total = bins[t_ns // BIN_NS] = np.zeros(1 + len(values))
    total += (1.0, *values)


def _at(bins: Bins, instants: NDArray[np.int64], width: int) -> Array:
    """Means of a stream at some instants, counted in bins, (..., width): between the two next to each; nan where those lie
    far apart."""
    found = np.full((*instants.shape, width), math.nan)
    if len(bins) < 2:
        return found
    keys = np.array(sorted(bins))
    means = np.array([bins[key][1:] / bins[key][0] for key in keys.tolist()])
    after = np.clip(np.searchsorted(keys + 0.5, instants), 1, len(keys) - 1)
    apart = keys[after] - keys[after - 1]
    share = (instants - keys[after - 1] - 0.5) / apart
    near = (apart * BIN <= LONGEST_GAP) & (share >= -1) & (share <= 2)
    between = means[after - 1] + share[..., None] * (means[after] - means[after - 1])
    found[near] = between[near]
    return found


def _turn(course: Array) -> Array:
    """Turn rate (K,) [rad/s] to the right by velocities (2, K, 2) [m/s]; nan where they are slow or unknown."""
    (north_0, east_0), (north_1, east_1) = course[0].T, course[1].T
    turned = np.arctan2(north_0 * east_1 - east_0 * north_1, north_0 * north_1 + east_0 * east_1) / WINDOW
    slow = ~(np.minimum(np.hypot(north_0, east_0), np.hypot(north_1, east_1)) > COURSE_SPEED)
    turned[slow] = math.nan
    result: Array = turned
    return result


def find(windows: Windows, configured_deg: tuple[float, float, float]) -> Mounting:
    """The rotation of the sensor's own axes against forward-right-down, of samples that were turned as configured.
    MountingError where the drive does not tell it."""
    directions = _directions(windows)
    mat_vs, covariance = _wahba(directions)
    sigma = np.sqrt(np.diag(covariance))
    off = [_angle(mat_vs @ direction.sensed, direction.vehicle) for direction in directions]
    acceleration, turning = _size(windows.acceleration), _size(windows.turn[np.isfinite(windows.turn)])
    for direction, angle in zip(directions, off, strict=True):
        if direction.sigma < SURE and angle > CONTRADICTION:
            raise MountingError(
                f"no rotation fits: '{MEANING[direction.name]}' is {math.degrees(angle):.0f} deg off what the others say; "
                "is an axis of the accelerometer or of the gyro reversed, or does the vehicle drive in reverse?"
            )
    if sigma.max() > MOST_SIGMA:
        raise MountingError(
            f"too little motion: the speed changes by {acceleration:.2f} m/s^2, root mean square over "
            f"{len(windows.number) * WINDOW:.0f} s, which tells the rotation to {math.degrees(sigma.max()):.0f} deg only; "
            "drive a minute or more, pull away and brake a few times, and turn both ways"
        )
    mat_bs = mat_vs @ matrix_from_euler(*(math.radians(angle) for angle in configured_deg))
    return Mounting(
        rotation=_euler(mat_bs),
        turned=math.acos(min(1.0, max(-1.0, (float(np.trace(mat_vs)) - 1) / 2))),
        sigma=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
        directions=tuple((d.name, angle, d.sigma) for d, angle in zip(directions, off, strict=True)),
        seconds=len(windows.number) * WINDOW,
        standing=float((np.abs(windows.speed).max(axis=0) < STANDING).sum()) * WINDOW,
        acceleration=acceleration,
        turning=turning,
        speed_from=windows.speed_from,
    )


def _directions(windows: Windows) -> list[Direction]:
    """What the drive tells of down and forward."""
    found, bias = _by_turning(windows)
    segments = _segments(windows, bias)
    if not segments:
        raise MountingError(f"the drive is in pieces: {LEAST_SEGMENT * WINDOW:.0f} s without a gap are needed at the least")
    force = np.concatenate([segment.force - segment.force.mean(axis=0) for segment in segments])
    design = np.concatenate([segment.design - segment.design.mean(axis=0) for segment in segments])
    told, spread = _regress(force, design)
    forward, growth = told[0], float(np.linalg.norm(told[0]))
    ups = np.array([s.force.mean(axis=0) - np.einsum("jab,jb->a", s.design.mean(axis=0), told) for s in segments])
    found.append(_level(ups, np.array([len(segment.force) for segment in segments])))
    if spread[0] < 0.1 and not SPEED_FIT[0] <= growth <= SPEED_FIT[1]:
        raise MountingError(
            f"the specific force grows by {growth:.2f} m/s^2 where the speed of the {windows.speed_from} says 1: is their "
            "unit, radius or delay wrong?"
        )
    found.append(_direction("forward", forward, FORWARD, spread[0], FORWARD_SIGMA))
    return found


def _by_turning(windows: Windows) -> tuple[list[Direction], Array]:
    """Down as the axis that the gyro sees while the course changes, if it does; and the gyro's bias (3,) [rad/s]."""
    known = np.isfinite(windows.turn)
    if known.sum() < LEAST_WINDOWS:
        return [], np.zeros(3)
    design = np.stack([np.ones(known.sum()), windows.turn[known]], axis=1)[:, :, None, None] * np.eye(3)
    (bias, axis), spread = _regress(windows.rate[known].mean(axis=1), design)
    return [_direction("turning", axis, DOWN, spread[1], TURNING_SIGMA)], bias


def _level(ups: Array, weights: NDArray[np.int64]) -> Direction:
    """Down of the vehicle by the specific force (S, 3) [m/s^2] that the speed does not explain, in each segment."""
    up = weights @ ups / weights.sum()
    gravity = float(np.linalg.norm(up))
    if not GRAVITY_LIMITS[0] <= gravity <= GRAVITY_LIMITS[1]:
        raise MountingError(
            f"the accelerometer reads {gravity:.2f} m/s^2 on average, which is not gravity: its unit is wrong"
        )
    off = np.array([_angle(up, one) for one in ups])
    scatter = math.sqrt((2 * ROAD_SIGMA * ROAD_SIGMA + float(off @ off) / 2) / (1 + len(ups)))
    return Direction("level", -up / gravity, DOWN, math.hypot(scatter / math.sqrt(len(ups)), LEVEL_SIGMA))


class Segment(NamedTuple):
    """A stretch of k windows, in the axes that the sensor has in its middle."""

    force: Array  # (k, 3) m/s^2, mean specific force
    design: Array  # (k, 2, 3, 3): what of it comes by `forward` (3,), and by a drift (3,) [m/s^3] of gravity: gyro bias


def _segments(windows: Windows, bias: Array) -> list[Segment]:
    """The stretches without a gap, in pieces."""
    cuts = np.flatnonzero(np.diff(windows.number) != 1) + 1
    found = []
    for stretch in np.split(np.arange(len(windows.number)), cuts):
        for begin in range(0, len(stretch), SEGMENT_WINDOWS):
            rows = stretch[begin : begin + SEGMENT_WINDOWS]
            if len(rows) >= LEAST_SEGMENT:
                found.append(_segment(windows, rows, bias))
    return found


def _segment(windows: Windows, rows: NDArray[np.intp], bias: Array) -> Segment:
    count = len(rows) * WINDOW_BINS
    rate = windows.rate[rows].reshape(count, 3) - bias
    half = rate * (BIN / 2)
    edges, middles = [np.eye(3)], []
    for turn in half:
        step = matrix(quaternion_exp(turn))
        middles.append(edges[-1] @ step)
        edges.append(middles[-1] @ step)
    back = edges[count // 2].T
    turned = np.einsum("ab,kbc,kc->ka", back, np.array(middles), windows.force[rows].reshape(count, 3))
    ends = np.einsum("ab,kbc->kac", back, np.array(edges[::WINDOW_BINS]))
    padded = np.concatenate([rate[:1], rate, rate[-1:]])
    swing = np.array([skew(w) for w in (padded[:-1] + padded[1:])[::WINDOW_BINS] / 2]) * windows.axle
    speed = windows.speed[:, rows, None, None] * np.eye(3)  # the sensor's own velocity: speed forward - rate x axle
    by_forward = (ends[1:] @ (speed[1] - swing[1:]) - ends[:-1] @ (speed[0] - swing[:-1])) / WINDOW
    since = (np.arange(len(rows)) - (len(rows) - 1) / 2) * WINDOW
    by_drift = since[:, None, None] * np.eye(3)
    return Segment(turned.reshape(len(rows), WINDOW_BINS, 3).mean(axis=1), np.stack([by_forward, by_drift], axis=1))


def _direction(name: str, vector: Array, vehicle: Array, spread: float, least: float) -> Direction:
    size = max(float(np.linalg.norm(vector)), 1e-9)
    return Direction(name, vector / size, vehicle, math.hypot(spread / size, least))


def _regress(measured: Array, design: Array) -> tuple[Array, Array]:
    """Least squares of vectors (K, 3) on n vectors (n, 3) that come in by matrices (K, n, 3, 3): those vectors, and the
    sigma (n,) of each, per axis. Errors of neighbours are alike (bumps, slopes): the sigmas allow for it."""
    count, n = design.shape[:2]
    columns = design.transpose(0, 2, 1, 3).reshape(3 * count, 3 * n)
    found = np.asarray(np.linalg.lstsq(columns, measured.reshape(-1), rcond=None)[0], np.float64)
    rest = measured - (columns @ found).reshape(count, 3)
    total = float((rest * rest).sum())
    alike = min(max(float((rest[1:] * rest[:-1]).sum()) / max(total, 1e-30), 0.0), MOST_CORRELATION)
    variance = total / max(1, 3 * (count - n)) * (1 + alike) / (1 - alike)
    information = columns.T @ columns / max(variance, 1e-12) + 1e-9 * np.eye(3 * n)  # a column of nothing tells nothing
    spread = np.diag(np.linalg.inv(information)).reshape(n, 3).mean(axis=1)
    sigma: Array = np.sqrt(spread)
    vectors: Array = found.reshape(n, 3)
    return vectors, sigma


def _wahba(directions: list[Direction]) -> tuple[Array, Array]:
    """Rotation (3, 3) from sensor to vehicle axes, and the covariance (3, 3) [rad^2] of its error in vehicle axes."""
    profile, information = np.zeros((3, 3)), np.eye(3) * 1e-6
    for _, sensed, vehicle, sigma in directions:
        weight = 1 / (sigma * sigma)
        profile += weight * np.outer(vehicle, sensed)
        information += weight * (np.eye(3) - np.outer(vehicle, vehicle))
    left, _, right = np.linalg.svd(profile)
    proper: Array = left @ np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)]) @ right
    return proper, np.asarray(np.linalg.inv(information), np.float64)


def _euler(mat_bs: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad]; standing on end, where roll and yaw are one, all of it is yaw."""
    if math.hypot(float(mat_bs[2, 1]), float(mat_bs[2, 2])) > 1e-6:
        return euler(mat_bs)
    return 0.0, math.copysign(math.pi / 2, -float(mat_bs[2, 0])), math.atan2(-float(mat_bs[0, 1]), float(mat_bs[1, 1]))


def _angle(a: Array, b: Array) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _size(values: NDArray[np.float64]) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(values * values))) if len(values) else 0.0


def text(mounting: Mounting, source: str) -> str:
    """What is told to the person who installs the vehicle, with the line for the configuration."""
    roll, pitch, yaw = (_tenth(angle) for angle in mounting.rotation)
    lines = [
        f"[imu.{source}]",
        f"rotation_deg = [{roll}, {pitch}, {yaw}]",
        "",
        f"{_deg(mounting.turned)} deg from what is configured; one sigma: {_deg(mounting.sigma[0])} deg about the forward "
        f"axis, {_deg(mounting.sigma[1])} about right, {_deg(mounting.sigma[2])} about down",
        f"rests on {mounting.seconds:.0f} s of driving ({mounting.standing:.0f} s of them at rest), the speed of the "
        f"{mounting.speed_from}; root mean squares: {mounting.acceleration:.2f} m/s^2 of speed's change, "
        f"{_deg(mounting.turning)} deg/s of turning:",
    ]
    lines += [
        f"  {MEANING[name]}: sigma {_deg(sigma)} deg, {_deg(off)} deg off the rotation found"
        for name, off, sigma in mounting.directions
        if sigma < TOLD
    ]
    return "\n".join(lines)


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f}"


def _tenth(angle: float) -> float:
    """Degrees, rounded; no negative zero."""
    return round(math.degrees(angle), 1) + 0.0
