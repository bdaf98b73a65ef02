"""The true motion: a script of segments, its smooth kinematics in closed form, and the position by quadrature.

The point on the road below the middle of the rear axle moves along the vehicle's forward axis; if the axle slips, it also
moves out of a bend, by an angle that is proportional to the lateral acceleration.
Heading and slope are functions of the distance driven, speed is one of time; all pass from value to value by `blend`,
whose third derivative is still continuous in between, so that rates and accelerations have no steps anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusiond.events import Vector3
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import Scenario
from fusiond.simulation.wgs84 import radii, wrapped

RAMP = 0.3  # share of a blend over which its slope rises, and falls again
BLOCK = 65536  # samples evaluated at once, to bound the memory
LATITUDE_PASSES = 3  # of the quadrature: the radii depend on the latitude that is sought


def blend(u: Array) -> tuple[Array, Array, Array, Array]:
    """A smooth step from 0 at u = 0 to 1 at u = 1, and its first three derivatives by u."""
    x, y = np.minimum(u / RAMP, 1), np.minimum((1 - u) / RAMP, 1)
    area = 1 - RAMP
    rise, fall = x - np.sin(2 * np.pi * x) / (2 * np.pi), y - np.sin(2 * np.pi * y) / (2 * np.pi)
    value = _rise_integral(u) + (1 - RAMP / 2) - _rise_integral(1 - u) - u
    second = (np.cos(2 * np.pi * y) - np.cos(2 * np.pi * x)) / RAMP
    third = 2 * np.pi * (np.sin(2 * np.pi * x) + np.sin(2 * np.pi * y)) / RAMP**2
    return value / area, (rise + fall - 1) / area, second / area, third / area


def blend_integral(u: Array) -> Array:
    """Integral of `blend` from 0 to u."""
    whole = float(_rise_integral2(np.ones(1))[0])
    total = _rise_integral2(u) + (1 - RAMP / 2) * u - (whole - _rise_integral2(1 - u)) - u * u / 2
    return total / (1 - RAMP)


def _rise_integral(u: Array) -> Array:
    x = np.minimum(u / RAMP, 1)
    return RAMP * (x * x / 2 + (np.cos(2 * np.pi * x) - 1) / (4 * np.pi**2)) + np.maximum(u - RAMP, 0)


def _rise_integral2(u: Array) -> Array:
    x, rest = np.minimum(u / RAMP, 1), np.maximum(u - RAMP, 0)
    ramp = x**3 / 6 + np.sin(2 * np.pi * x) / (8 * np.pi**3) - x / (4 * np.pi**2)
    return RAMP**2 * ramp + rest * RAMP / 2 + rest * rest / 2


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Motion at N instants. The IMU's unless said otherwise."""

    speed: Array  # (N,) m/s, of the rear axle along the vehicle's forward axis
    curvature: Array  # (N,) 1/m, of the rear axle's track, right-hand bends positive
    yaw_rate: Array  # (N,) rad/s, about the normal of the road
    mat_nb: Array  # (N, 3, 3)
    rate_nb_b: Array  # (N, 3) rad/s, of b against n
    velocity_n: Array  # (N, 3) m/s
    acceleration_n: Array  # (N, 3) m/s^2, time derivative of velocity_n


class Trajectory:
    """The drive of a scenario; times are seconds from its start, limited to the drive."""

    def __init__(self, scenario: Scenario) -> None:
        self._script(scenario)
        self.lean = -np.radians(scenario.vehicle.roll_deg_per_mps2)  # rad per m/s^2 to the right
        self.slip = np.radians(scenario.vehicle.slip_deg_per_mps2)  # rad per m/s^2
        self.lever_v = np.array(scenario.imu.position_m)
        self.mat_vb = euler_matrix(*(np.radians(np.array([angle])) for angle in scenario.imu.mount_deg))[0]
        steps = int(scenario.duration_s * scenario.imu.rate_hz + 1e-6)
        self.t = np.arange(steps + 1) / scenario.imu.rate_hz
        self.duration = float(self.t[-1])
        self._integrate(scenario)

    def _script(self, scenario: Scenario) -> None:
        """Tables over the segments: begin, duration, and first value and change of speed, heading and slope."""
        segments = scenario.segment
        self.length = np.array([segment.duration_s for segment in segments])
        self.begin = np.concatenate([[0.0], np.cumsum(self.length)[:-1]])
        speeds, grades = [scenario.start.speed_mps], [scenario.start.grade_deg]
        for segment in segments:
            speeds.append(speeds[-1] if segment.speed_mps is None else segment.speed_mps)
            grades.append(grades[-1] if segment.grade_deg is None else segment.grade_deg)
        turns = np.radians([segment.turn_deg for segment in segments])
        self.speed, self.speed_change = np.array(speeds[:-1]), np.diff(speeds)
        self.pitch, self.pitch_change = np.radians(grades[:-1]), np.radians(np.diff(grades))
        self.heading = np.radians(scenario.start.heading_deg) + np.concatenate([[0.0], np.cumsum(turns)[:-1]])
        self.heading_change = turns
        self.road = self.length * (self.speed + self.speed_change / 2)  # m, length of the road

    def kinematics(self, t: Array) -> Kinematics:
        """The motion at the times `t` (N,) [s]."""
        i = np.clip(np.searchsorted(self.begin, t, side="right") - 1, 0, len(self.begin) - 1)
        length, road = self.length[i], self.road[i]
        u = np.clip((t - self.begin[i]) / length, 0, 1)
        step, step1, step2, _ = blend(u)
        v0, change = self.speed[i], self.speed_change[i]
        v, dv, ddv = v0 + change * step, change / length * step1, change / length**2 * step2
        driven = length * (v0 * u + change * blend_integral(u))
        moves = road != 0
        per_road = np.divide(1, road, out=np.zeros_like(road), where=moves)
        step, step1, step2, step3 = blend(np.clip(driven * per_road, 0, 1))
        turn, slope = self.heading_change[i], self.pitch_change[i]
        bend, bend1, bend2 = (turn * per_road**k * s for k, s in ((1, step1), (2, step2), (3, step3)))
        tilt, tilt1 = (slope * per_road**k * s for k, s in ((1, step1), (2, step2)))
        yaw = (self.heading[i] + turn * step, bend * v, bend1 * v * v + bend * dv)
        pitch = (self.pitch[i] + slope * step, tilt * v, tilt1 * v * v + tilt * dv)
        roll = (
            self.lean * v * v * bend,
            self.lean * (2 * v * dv * bend + v**3 * bend1),
            self.lean * (2 * (dv * dv + v * ddv) * bend + 5 * v * v * dv * bend1 + v**4 * bend2),
        )
        slip = (-self.slip * v**3 * bend, -self.slip * (3 * v * v * dv * bend + v**4 * bend1))
        return self._body(v, dv, bend, slip, (roll, pitch, yaw))

    def _body(
        self, v: Array, dv: Array, bend: Array, slip: tuple[Array, Array], angles: tuple[tuple[Array, Array, Array], ...]
    ) -> Kinematics:
        """Motion of the IMU from that of the rear axle, forward and to the right, and the Euler angles with two derivatives
        each."""
        (roll, droll, ddroll), (pitch, dpitch, ddpitch), (yaw, dyaw, ddyaw) = angles
        mat_nv = euler_matrix(roll, pitch, yaw)
        cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
        level, lean = dyaw * cp, ddyaw * cp - dyaw * dpitch * sp
        rate = np.stack([droll - dyaw * sp, dpitch * cr + level * sr, level * cr - dpitch * sr], -1)
        rate1 = np.stack(
            [
                ddroll - ddyaw * sp - dyaw * dpitch * cp,
                ddpitch * cr - dpitch * droll * sr + lean * sr + level * droll * cr,
                lean * cr - level * droll * sr - ddpitch * sr - dpitch * droll * cr,
            ],
            -1,
        )
        forward = np.stack([cp * cy, cp * sy, -sp], -1)
        forward1 = np.stack([-dpitch * sp * cy - level * sy, -dpitch * sp * sy + level * cy, -dpitch * cp], -1)
        sideways, sideways1 = (np.stack([np.zeros_like(v), speed, np.zeros_like(v)], -1) for speed in slip)
        swing = np.cross(rate, self.lever_v)
        swing1 = np.cross(rate1, self.lever_v) + np.cross(rate, swing + sideways) + sideways1
        swing = swing + sideways
        return Kinematics(
            speed=v,
            curvature=bend,
            yaw_rate=level,
            mat_nb=mat_nv @ self.mat_vb,
            rate_nb_b=rate @ self.mat_vb,
            velocity_n=v[:, None] * forward + turned(mat_nv, swing),
            acceleration_n=dv[:, None] * forward + v[:, None] * forward1 + turned(mat_nv, swing1),
        )

    def lever_b(self, point_m: Vector3) -> Array:
        """A point of the vehicle (from the point below the rear axle) from the IMU, in the IMU's axes (3,) [m]."""
        lever: Array = (np.array(point_m) - self.lever_v) @ self.mat_vb
        return lever

    def velocity_n(self, t: Array) -> Array:
        """Velocity (N, 3) [m/s] of the IMU."""
        blocks = [self.kinematics(t[k : k + BLOCK]).velocity_n for k in range(0, len(t), BLOCK)]
        return np.concatenate(blocks)

    def _integrate(self, scenario: Scenario) -> None:
        """Position of the IMU on the grid `t`, by Simpson's rule; the grid is fine against every change of velocity."""
        step = np.diff(self.t)
        ends, middles = self.velocity_n(self.t), self.velocity_n(self.t[:-1] + step / 2)

        def integral(at_ends: Array, at_middles: Array, first: float) -> Array:
            parts = step / 6 * (at_ends[:-1] + 4 * at_middles + at_ends[1:])
            return first + np.concatenate([[0.0], np.cumsum(parts)])

        def between(values: Array, slopes: Array) -> Array:
            result: Array = (values[:-1] + values[1:]) / 2 + step / 8 * (slopes[:-1] - slopes[1:])
            return result

        height = integral(-ends[:, 2], -middles[:, 2], scenario.start.height_m)
        height_middle = between(height, -ends[:, 2])
        latitude = np.full(len(self.t), np.radians(scenario.start.latitude_deg))
        latitude_rate = np.zeros(len(self.t))
        for _ in range(LATITUDE_PASSES):
            latitude_middle = between(latitude, latitude_rate)
            latitude_rate = ends[:, 0] / (radii(latitude)[0] + height)
            rate_middle = middles[:, 0] / (radii(latitude_middle)[0] + height_middle)
            latitude = integral(latitude_rate, rate_middle, latitude[0])
        latitude_middle = between(latitude, latitude_rate)
        longitude_rate = ends[:, 1] / ((radii(latitude)[1] + height) * np.cos(latitude))
        rate_middle = middles[:, 1] / ((radii(latitude_middle)[1] + height_middle) * np.cos(latitude_middle))
        longitude = integral(longitude_rate, rate_middle, np.radians(scenario.start.longitude_deg))
        self._position = np.stack([latitude, longitude, height], -1)
        self._rate = np.stack([latitude_rate, longitude_rate, -ends[:, 2]], -1)

    def position(self, t: Array) -> tuple[Array, Array, Array]:
        """Latitude, longitude [rad], height [m] of the IMU: cubic between the points of the grid."""
        inside = np.clip(t, 0, self.t[-1])
        i = np.clip(np.searchsorted(self.t, inside, side="right") - 1, 0, len(self.t) - 2)
        h = (self.t[i + 1] - self.t[i])[:, None]
        s = (inside - self.t[i])[:, None] / h
        p, q = self._position[i], self._position[i + 1]
        dp, dq = self._rate[i] * h, self._rate[i + 1] * h
        found = p + s * (dp + s * (3 * (q - p) - 2 * dp - dq + s * (dp + dq - 2 * (q - p))))
        return found[:, 0], wrapped(found[:, 1]), found[:, 2]


def turned(matrices: Array, vectors: Array) -> Array:
    """Each of N vectors (N, 3) by its matrix (N, 3, 3)."""
    result: Array = np.einsum("nij,nj->ni", matrices, vectors)
    return result


def euler_matrix(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Rotations (N, 3, 3) Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
