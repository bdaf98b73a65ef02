"""Payloads of what sensors measured, whatever the protocol: axes turned, and the unusable refused with a reason."""

from __future__ import annotations

import math

from fusiond.config.schema import Gnss, Imu
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Invalid, Vector3

Matrix = tuple[Vector3, Vector3, Vector3]  # row by row


class InertialAxes:
    """What an [imu.NAME] says of its samples: its mounting, and the limits of what it can measure."""

    def __init__(self, imu: Imu) -> None:
        self._mat_bs = _rotation(imu.rotation_deg) if any(imu.rotation_deg) else None  # sensor axes to body
        self._accel_limit, self._gyro_limit = imu.accel_limit, imu.gyro_limit

    def sample(self, force_s: Vector3, rate_s: Vector3) -> ImuSample | Invalid:
        """A specific force [m/s^2] and an angular rate [rad/s] in the sensor's axes as a payload in the body's."""
        calm, slow = _within(force_s, self._accel_limit), _within(rate_s, self._gyro_limit)
        if not (calm and slow):
            finite = math.isfinite(sum(force_s) + sum(rate_s))
            return Invalid(("beyond gyro_limit" if calm else "beyond accel_limit") if finite else "not finite")
        if self._mat_bs is None:
            return ImuSample(force_s, rate_s)
        return ImuSample(_rotated(self._mat_bs, force_s), _rotated(self._mat_bs, rate_s))


def gnss_position(
    gnss: Gnss,
    fix_type: int,
    place: Vector3,
    sigma_horizontal: float | None = None,
    sigma_vertical: float | None = None,
) -> GnssPosition | Invalid:
    """A fix of a receiver. `place`: latitude and longitude [deg], height [m]. `fix_type`: GPS_FIX_TYPE."""
    latitude_deg, longitude_deg, height = place
    if fix_type < gnss.minimum_fix_type:
        return Invalid("no fix")
    if latitude_deg == 0 and longitude_deg == 0:
        return Invalid("no position")
    if not math.isfinite(latitude_deg + longitude_deg + height):
        return Invalid("not finite")
    if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
        return Invalid("not on earth")
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    return GnssPosition(latitude, longitude, height, sigma_horizontal, sigma_vertical, fix_type)


def velocity_by_course(speed: float, course: float, sigma: float | None = None) -> GnssVelocity:
    """Speed over ground [m/s] and course [rad, clockwise from north] as a velocity."""
    return GnssVelocity(speed * math.cos(course), speed * math.sin(course), None, sigma)


def _within(vector: Vector3, limit: float) -> bool:
    """Is every component finite, and at most `limit` in size?"""
    x, y, z = vector
    return -limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit


def _rotation(angles_deg: Vector3) -> Matrix:
    """The matrix Rz(yaw) Ry(pitch) Rx(roll): it rotates a vector from the sensor's axes to the body's."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in map(math.radians, angles_deg))
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def _rotated(mat: Matrix, vector: Vector3) -> Vector3:
    x, y, z = vector
    (a, b, c), (d, e, f), (g, h, i) = mat
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
