"""Estimates the rotation of the inertial sensor against the vehicle from a drive: any rotation, upside down included.

The drive is cut into segments of some seconds. In the axes of the sensor in the middle of a segment, to which the gyro
relates every other instant, gravity is constant, so between two instants

    integral of the specific force = -gravity down dt + (velocity at the end) - (velocity at the start)

with the velocity of the sensor: the forward speed, and its motion about the unsteered axle in bends. That is linear in
`down`, one for each segment (roads slope), and in `forward`, which is constant in the sensor's own axes. The speed is that
of the wheels or of GNSS. The mean of `down` is that of the vehicle. The rotation about the sensor's axes, compared with the
change of the course, gives it a second time. The rotation that fits the directions best, each weighted by its uncertainty,
is Wahba's problem, solved by singular values (Markley and Crassidis 2014, section 5.4).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.app.mounting.windows import BIN, MIN_WINDOWS, WINDOW, WINDOW_BINS, MountingError, Windows
from fusiond.maths.rotation import euler, matrix, matrix_from_euler, quaternion_exp, skew
from fusiond.maths.typed import Array

SEGMENT_WINDOWS = 10  # of a segment: as long as the gyro's drift is negligible
MIN_SEGMENT_WINDOWS = 4
MIN_SPEED = 0.1  # m/s: at a lower speed the vehicle is at rest
GRAVITY_LIMITS = (9.0, 10.6)  # m/s^2: of the mean specific force
SPEED_FIT = (0.5, 1.6)  # of the specific force over the acceleration from the speeds, if that is certain
MAX_FIT_SIGMA = 0.1  # of that ratio, for it to be certain
MAX_SIGMA = math.radians(6.0)  # a rotation less certain than this is refused
CONTRADICTION = math.radians(20.0)  # directions that differ by more from the rotation contradict each other
MAX_CERTAIN_SIGMA = math.radians(7.0)  # a direction less certain than this contradicts nothing
ROAD_SIGMA = math.radians(2.0)  # scatter of the segments' down about the vehicle's, assumed where there are few
LEVEL_SIGMA = math.radians(0.7)  # error common to all segments: mean slope, load, accelerometer bias
FORWARD_SIGMA = math.radians(0.5)  # the same for forward
TURNING_SIGMA = math.radians(1.0)  # the same for turning: bends on slopes, body roll
MAX_CORRELATION = 0.9
DOWN, FORWARD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])

MEANING = {
    "level": "down, by the mean specific force",
    "forward": "forward, by the specific force while the speed changes",
    "turning": "down, by the gyro while the course changes",
}


class Direction(NamedTuple):
    """A direction: unit vector in sensor axes (3,), the same in vehicle axes (3,), its sigma [rad]."""

    name: str
    sensed: Array
    vehicle: Array
    sigma: float


class Mounting(NamedTuple):
    """The rotation of the sensor, and the evidence for it."""

    rotation: tuple[float, float, float]  # rad: roll, pitch, yaw, for the configuration
    turned: float  # rad, from the configured rotation
    sigma: tuple[float, float, float]  # rad, about the vehicle's forward, right and down axes
    directions: tuple[tuple[str, float, float], ...]  # name, difference from the rotation [rad], sigma [rad]
    seconds: float  # of the drive used
    standing: float  # s of it at rest
    acceleration: float  # m/s^2, root mean square
    turning: float  # rad/s, root mean square
    speed_from: str  # wheels or GNSS


def find(windows: Windows, configured_deg: tuple[float, float, float]) -> Mounting:
    """The rotation of the sensor's own axes against forward-right-down, from samples that were rotated as configured. Raises
    MountingError if the drive does not determine it."""
    directions = directions_of(windows)
    mat_vs, covariance = _wahba(directions)
    sigma = np.sqrt(np.diag(covariance))
    off = [angle_between(mat_vs @ direction.sensed, direction.vehicle) for direction in directions]
    acceleration, turning = _size(windows.acceleration), _size(windows.turn[np.isfinite(windows.turn)])
    for direction, angle in zip(directions, off, strict=True):
        if direction.sigma < MAX_CERTAIN_SIGMA and angle > CONTRADICTION:
            raise MountingError(
                f"no rotation fits: '{MEANING[direction.name]}' is {math.degrees(angle):.0f} deg from the other directions; "
                "is an axis of the accelerometer or of the gyro reversed, or does the vehicle drive in reverse?"
            )
    if sigma.max() > MAX_SIGMA:
        raise MountingError(
            f"too little motion: the speed changes by {acceleration:.2f} m/s^2, root mean square over "
            f"{len(windows.number) * WINDOW:.0f} s, which determines the rotation to {math.degrees(sigma.max()):.0f} deg "
            "only; drive a minute or more, pull away and brake a few times, and turn both ways"
        )
    mat_bs = mat_vs @ matrix_from_euler(*(math.radians(angle) for angle in configured_deg))
    return Mounting(
        rotation=_euler(mat_bs),
        turned=math.acos(min(1.0, max(-1.0, (float(np.trace(mat_vs)) - 1) / 2))),
        sigma=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
        directions=tuple((d.name, angle, d.sigma) for d, angle in zip(directions, off, strict=True)),
        seconds=len(windows.number) * WINDOW,
        standing=float((np.abs(windows.speed).max(axis=0) < MIN_SPEED).sum()) * WINDOW,
        acceleration=acceleration,
        turning=turning,
        speed_from=windows.speed_from,
    )


def directions_of(windows: Windows) -> list[Direction]:
    """The directions of down and forward that the drive determines. Raises MountingError."""
    axis = turning_axis(windows)
    found, bias = ([axis.direction], axis.bias) if axis else ([], np.zeros(3))
    segments = _segments(windows, bias)
    if not segments:
        seconds = f"{MIN_SEGMENT_WINDOWS * WINDOW:.0f} s"
        raise MountingError(f"the drive has too many gaps: at least {seconds} without a gap are needed")
    force = np.concatenate([segment.force - segment.force.mean(axis=0) for segment in segments])
    design = np.concatenate([segment.design - segment.design.mean(axis=0) for segment in segments])
    vectors, spread = _regress(force, design)
    forward, growth = vectors[0], float(np.linalg.norm(vectors[0]))
    ups = np.array([s.force.mean(axis=0) - np.einsum("jab,jb->a", s.design.mean(axis=0), vectors) for s in segments])
    found.append(_level(ups, np.array([len(segment.force) for segment in segments])))
    if spread[0] < MAX_FIT_SIGMA and not SPEED_FIT[0] <= growth <= SPEED_FIT[1]:
        raise MountingError(
            f"the specific force grows by {growth:.2f} m/s^2 for each 1 m/s^2 of the speed of the {windows.speed_from}: is "
            "their unit, radius or delay wrong?"
        )
    found.append(_direction("forward", forward, FORWARD, spread[0], FORWARD_SIGMA))
    return found


class TurningAxis(NamedTuple):
    """What the gyro measures while the course changes: one of it per unit of the course's, about down, if all is right."""

    direction: Direction
    gain: float  # 1: of the gyro's rate over the course's
    gain_sigma: float
    bias: Array  # (3,) rad/s


def turning_axis(windows: Windows) -> TurningAxis | None:
    """The axis that the gyro measures while the course changes; None where the course is not known for long enough."""
    known = np.isfinite(windows.turn)
    if known.sum() < MIN_WINDOWS:
        return None
    design = np.stack([np.ones(known.sum()), windows.turn[known]], axis=1)[:, :, None, None] * np.eye(3)
    (bias, axis), spread = _regress(windows.rate[known].mean(axis=1), design)
    direction = _direction("turning", axis, DOWN, spread[1], TURNING_SIGMA)
    return TurningAxis(direction, float(np.linalg.norm(axis)), float(spread[1]), bias)


def _level(ups: Array, weights: NDArray[np.int64]) -> Direction:
    """Down of the vehicle from the specific force (S, 3) [m/s^2] of each segment that the speed does not explain."""
    up = weights @ ups / weights.sum()
    gravity = float(np.linalg.norm(up))
    if not GRAVITY_LIMITS[0] <= gravity <= GRAVITY_LIMITS[1]:
        raise MountingError(
            f"the accelerometer reads {gravity:.2f} m/s^2 on average, which is not gravity: is its unit wrong?"
        )
    off = np.array([angle_between(up, one) for one in ups])
    scatter = math.sqrt((2 * ROAD_SIGMA * ROAD_SIGMA + float(off @ off) / 2) / (1 + len(ups)))
    return Direction("level", -up / gravity, DOWN, math.hypot(scatter / math.sqrt(len(ups)), LEVEL_SIGMA))


class Segment(NamedTuple):
    """A stretch of k windows, in the axes of the sensor in its middle."""

    force: Array  # (k, 3) m/s^2, mean specific force
    design: Array  # (k, 2, 3, 3): its derivative by `forward` (3,), and by a drift (3,) [m/s^3] of gravity from gyro bias


def _segments(windows: Windows, bias: Array) -> list[Segment]:
    """The stretches without a gap, cut into segments."""
    cuts = np.flatnonzero(np.diff(windows.number) != 1) + 1
    found = []
    for stretch in np.split(np.arange(len(windows.number)), cuts):
        for begin in range(0, len(stretch), SEGMENT_WINDOWS):
            chosen = stretch[begin : begin + SEGMENT_WINDOWS]
            if len(chosen) >= MIN_SEGMENT_WINDOWS:
                found.append(_segment(windows, chosen, bias))
    return found


def _segment(windows: Windows, chosen: NDArray[np.intp], bias: Array) -> Segment:
    count = len(chosen) * WINDOW_BINS
    rate = windows.rate[chosen].reshape(count, 3) - bias
    half = rate * (BIN / 2)
    edges, middles = [np.eye(3)], []
    for turn in half:
        step = matrix(quaternion_exp(turn))
        middles.append(edges[-1] @ step)
        edges.append(middles[-1] @ step)
    back = edges[count // 2].T
    turned = np.einsum("ab,kbc,kc->ka", back, np.array(middles), windows.force[chosen].reshape(count, 3))
    ends = np.einsum("ab,kbc->kac", back, np.array(edges[::WINDOW_BINS]))
    padded = np.concatenate([rate[:1], rate, rate[-1:]])
    swing = np.array([skew(w) for w in (padded[:-1] + padded[1:])[::WINDOW_BINS] / 2]) * windows.axle
    speed = windows.speed[:, chosen, None, None] * np.eye(3)  # the sensor's own velocity: speed forward - rate x axle
    by_forward = (ends[1:] @ (speed[1] - swing[1:]) - ends[:-1] @ (speed[0] - swing[:-1])) / WINDOW
    since = (np.arange(len(chosen)) - (len(chosen) - 1) / 2) * WINDOW
    by_drift = since[:, None, None] * np.eye(3)
    return Segment(turned.reshape(len(chosen), WINDOW_BINS, 3).mean(axis=1), np.stack([by_forward, by_drift], axis=1))


def _direction(name: str, vector: Array, vehicle: Array, spread: float, minimum: float) -> Direction:
    size = max(float(np.linalg.norm(vector)), 1e-9)
    return Direction(name, vector / size, vehicle, math.hypot(spread / size, minimum))


def _regress(measured: Array, design: Array) -> tuple[Array, Array]:
    """Least squares of K vectors (K, 3) on n vectors (n, 3) with the matrices (K, n, 3, 3): the n vectors, and the sigma
    (n,) of each, per axis. Errors of neighbours are correlated (bumps, slopes): the sigmas allow for it."""
    count, n = design.shape[:2]
    columns = design.transpose(0, 2, 1, 3).reshape(3 * count, 3 * n)
    found = np.asarray(np.linalg.lstsq(columns, measured.reshape(-1), rcond=None)[0], np.float64)
    rest = measured - (columns @ found).reshape(count, 3)
    total = float((rest * rest).sum())
    correlation = min(max(float((rest[1:] * rest[:-1]).sum()) / max(total, 1e-30), 0.0), MAX_CORRELATION)
    variance = total / max(1, 3 * (count - n)) * (1 + correlation) / (1 - correlation)
    information = columns.T @ columns / max(variance, 1e-12) + 1e-9 * np.eye(3 * n)  # regular even for an empty column
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
    """Roll, pitch, yaw [rad]; at a pitch of +-90 deg, where roll and yaw are not distinct, the roll is 0."""
    if math.hypot(float(mat_bs[2, 1]), float(mat_bs[2, 2])) > 1e-6:
        return euler(mat_bs)
    return 0.0, math.copysign(math.pi / 2, -float(mat_bs[2, 0])), math.atan2(-float(mat_bs[0, 1]), float(mat_bs[1, 1]))


def angle_between(a: Array, b: Array) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _size(values: NDArray[np.float64]) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(values * values))) if len(values) else 0.0
