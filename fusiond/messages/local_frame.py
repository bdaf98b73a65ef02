"""The published state in a local frame: a plane tangent to the Earth at an origin, with axes of several conventions.

Frames besides those of the glossary:
    l   local: the tangent plane at a fixed origin, its third axis vertical there
    o   odometry: the local frame less the filter's corrections, so that the pose in it never jumps, but drifts
In the convention ENU_FLU, l is east-north-up and b is forward-left-up; in NED_FRD they are as in the glossary.

Inputs and results are the tuples of the messages; plain floats are many times faster than arrays of this size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from fusiond.maths.portable import sin_cos
from fusiond.maths.wgs84 import EARTH_RATE, ecef
from fusiond.messages.types import Block, Quaternion, State, Triple
from fusiond.units import SECOND

MAX_GAP_NS = SECOND  # a longer gap is not integrated


class Convention(NamedTuple):
    """Rotations into the axes of a convention, as quaternions (w, x, y, z); both are half turns or the identity."""

    world: Quaternion  # from north-east-down
    body: Quaternion  # from forward-right-down


NED_FRD = Convention((1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
ENU_FLU = Convention((0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0), (0.0, 1.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class LocalState:
    """A state in the axes of a local frame; covariances are 3 x 3, row by row, symmetric."""

    position_l: Triple  # m, from the origin
    quaternion_lb: Quaternion  # w, x, y, z, body to local
    velocity_l: Triple  # m/s, over ground
    velocity_b: Triple  # m/s, over ground
    angular_rate_l: Triple  # rad/s, of the body against the Earth
    angular_rate_b: Triple  # rad/s, of the body against the Earth
    covariance_position_l: Block  # m^2
    covariance_attitude_l: Block  # rad^2, small rotations about the axes of l
    covariance_velocity_b: Block  # m^2/s^2: of the velocity over ground, rotated; without the attitude's error


class LocalFrame:
    """A tangent plane of the ellipsoid."""

    def __init__(self, latitude: float, longitude: float, height: float, convention: Convention = ENU_FLU) -> None:
        """The origin: geodetic coordinates [rad, rad, m]."""
        self.origin = (latitude, longitude, height)
        self._convention = convention
        self._origin_e = ecef(latitude, longitude, height).tolist()
        self._quaternion_le = _product(convention.world, _conjugate(_quaternion_en(latitude, longitude)))
        self._mat_le = _matrix(self._quaternion_le)
        self._mat_world = _matrix(convention.world)

    @classmethod
    def at(cls, state: State, convention: Convention = ENU_FLU) -> LocalFrame:
        """The frame with its origin at the position of a state."""
        return cls(math.radians(state.lat_deg), math.radians(state.lon_deg), state.height_m, convention)

    def state(self, state: State) -> LocalState:
        """A state in this frame. Axes at the state's position are rotated to those at the origin."""
        latitude, longitude = math.radians(state.lat_deg), math.radians(state.lon_deg)
        quaternion_ln = _product(self._quaternion_le, _quaternion_en(latitude, longitude))
        quaternion_nb = _product(state.quaternion_nb, self._convention.body)
        quaternion_lb = _product(quaternion_ln, quaternion_nb)
        mat_ln, mat_bn, mat_lb = _matrix(quaternion_ln), _matrix(_conjugate(quaternion_nb)), _matrix(quaternion_lb)
        sine, cosine = sin_cos(latitude)
        x, y, z = _rotated(_matrix(_conjugate(self._convention.body)), state.angular_rate_b_rps)
        earth_x, earth_y, earth_z = _rotated(mat_bn, (EARTH_RATE * cosine, 0.0, -EARTH_RATE * sine))
        rate_b = (x - earth_x, y - earth_y, z - earth_z)
        (px, py, pz), (ox, oy, oz) = ecef(latitude, longitude, state.height_m).tolist(), self._origin_e
        return LocalState(
            position_l=_rotated(self._mat_le, (px - ox, py - oy, pz - oz)),
            quaternion_lb=quaternion_lb,
            velocity_l=_rotated(mat_ln, state.velocity_ned_mps),
            velocity_b=_rotated(mat_bn, state.velocity_ned_mps),
            angular_rate_l=_rotated(mat_lb, rate_b),
            angular_rate_b=rate_b,
            covariance_position_l=_turned(mat_ln, state.covariance_position_m2),
            covariance_attitude_l=_turned(mat_ln, state.covariance_attitude_rad2),
            covariance_velocity_b=_turned(mat_bn, state.covariance_velocity_m2ps2),
        )

    def covariance_axes(self, covariance_n: Block) -> Block:
        """A covariance with its axes renamed by the convention, not rotated to those at the origin."""
        return _turned(self._mat_world, covariance_n)


class Placed(NamedTuple):
    """Position and attitude of one frame in another."""

    position: Triple  # m
    quaternion: Quaternion  # w, x, y, z


class OdometryFrame:
    """Keeps the odometry frame: the filter's velocity and turn rate, integrated from one state to the next.

    Roll and pitch are the filter's own, which gravity keeps from drifting; position and heading are free of its corrections.
    In a gap without a reset the frame does not move in the local one, so the body moves as the filter says. In a gap with a
    reset nothing is known of the motion, and the body stays where it was in the odometry frame.
    """

    def __init__(self) -> None:
        self._position_o = (0.0, 0.0, 0.0)
        self._turn = 0.0  # rad, of the local frame in the odometry frame, about the vertical
        self._shift_l = (0.0, 0.0, 0.0)  # m, of the odometry frame's origin in the local frame
        self._last: tuple[int, LocalState] | None = None
        self._resets = 0

    def loses_sight(self, t_ns: int, resets: int) -> bool:
        """Whether a state that follows now comes after a gap with a reset; `resets` counts the resets so far."""
        return self._last is not None and t_ns - self._last[0] > MAX_GAP_NS and resets != self._resets

    def follow(self, t_ns: int, state: LocalState, resets: int = 0) -> tuple[Placed, Placed]:
        """The odometry frame in the local one, and the body in the odometry frame. Stamps must increase."""
        last, blind = self._last, self.loses_sight(t_ns, resets)
        self._last, self._resets = (t_ns, state), resets
        if last is not None and blind:
            self._turn -= _correction(last[1], state, 0.0)
            self._shift_l = _less(state.position_l, _about_vertical(-self._turn, self._position_o))
        elif last is not None and 0 < t_ns - last[0] <= MAX_GAP_NS:
            dt = (t_ns - last[0]) / SECOND
            step = _about_vertical(self._turn, _scaled(_sum(last[1].velocity_l, state.velocity_l), dt / 2))
            self._position_o = _sum(self._position_o, step)
            self._turn -= _correction(last[1], state, dt)
            self._shift_l = _less(state.position_l, _about_vertical(-self._turn, self._position_o))
        else:
            self._position_o = _about_vertical(self._turn, _less(state.position_l, self._shift_l))
        sine, cosine = math.sin(self._turn / 2), math.cos(self._turn / 2)
        body = _product((cosine, 0.0, 0.0, sine), state.quaternion_lb)
        return Placed(self._shift_l, (cosine, 0.0, 0.0, -sine)), Placed(self._position_o, body)


def _correction(before: LocalState, after: LocalState, dt: float) -> float:
    """Change of heading [rad] that the angular rate does not account for."""
    w, _, _, z = _product(after.quaternion_lb, _conjugate(before.quaternion_lb))
    rate = (before.angular_rate_l[2] + after.angular_rate_l[2]) / 2
    return math.remainder(2 * math.atan2(z, w) - rate * dt, math.tau)


# --- Plain floats


def _quaternion_en(latitude: float, longitude: float) -> Quaternion:
    """Rotation from north-east-down to earth-fixed axes: about the third axis by the longitude, then about the second."""
    (sz, cz), (sy, cy) = sin_cos(longitude / 2), sin_cos(-(latitude + math.pi / 2) / 2)
    return cz * cy, -sz * sy, cz * sy, sz * cy


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _conjugate(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    return w, -x, -y, -z


def _matrix(quaternion: Quaternion) -> Block:
    w, x, y, z = quaternion
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    return (
        1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
        2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
        2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
    )  # fmt: skip


def _rotated(mat: Block, vector: Triple) -> Triple:
    a, b, c, d, e, f, g, h, i = mat
    x, y, z = vector
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _turned(mat: Block, covariance: Block) -> Block:
    """mat P mat', symmetric to the last bit; of P only the upper triangle is read."""
    a, b, c, d, e, f, g, h, i = mat
    xx, xy, xz, _, yy, yz, _, _, zz = covariance
    ax, ay, az = a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz
    dx, dy, dz = d * xx + e * xy + f * xz, d * xy + e * yy + f * yz, d * xz + e * yz + f * zz
    gx, gy, gz = g * xx + h * xy + i * xz, g * xy + h * yy + i * yz, g * xz + h * yz + i * zz
    first, second, third = ax * d + ay * e + az * f, ax * g + ay * h + az * i, dx * g + dy * h + dz * i
    return (
        ax * a + ay * b + az * c, first, second,
        first, dx * d + dy * e + dz * f, third,
        second, third, gx * g + gy * h + gz * i,
    )  # fmt: skip


def _about_vertical(angle: float, vector: Triple) -> Triple:
    x, y, z = vector
    sine, cosine = math.sin(angle), math.cos(angle)
    return cosine * x - sine * y, sine * x + cosine * y, z


def _sum(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _less(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _scaled(a: Triple, factor: float) -> Triple:
    return a[0] * factor, a[1] * factor, a[2] * factor
