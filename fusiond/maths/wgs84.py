"""The WGS-84 ellipsoid: geodetic and earth-fixed coordinates, the local north-east-down frame, normal gravity.

Equations: Groves, Principles of GNSS, Inertial and Multisensor Integrated Navigation Systems (2013), chapter 2;
normal gravity: NIMA TR8350.2 (2000), equations 4-1 and 4-3; geodetic latitude: Bowring (1976, 1985).
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.maths.portable import atan2, sin_cos, square
from fusiond.maths.typed import Array, Matrix3, Vector3, compiled

SEMI_MAJOR = 6378137.0  # m
FLATTENING = 1 / 298.257223563
SEMI_MINOR = SEMI_MAJOR * (1 - FLATTENING)  # m
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
SECOND_ECCENTRICITY2 = ECCENTRICITY2 / (1 - ECCENTRICITY2)
EARTH_RATE = 7.292115e-5  # rad/s
MU = 3.986004418e14  # m^3/s^2, geocentric gravitational constant
EQUATOR_GRAVITY = 9.7803253359  # m/s^2
SOMIGLIANA = 0.00193185265241
GRAVITY_RATIO = square(EARTH_RATE) * square(SEMI_MAJOR) * SEMI_MINOR / MU


def radii(latitude: float) -> tuple[float, float]:
    """Radii of curvature (meridian, transverse) [m] at a geodetic latitude [rad]."""
    w2 = 1 - ECCENTRICITY2 * square(sin_cos(latitude)[0])
    transverse = SEMI_MAJOR / math.sqrt(w2)
    return transverse * (1 - ECCENTRICITY2) / w2, transverse


def ecef(latitude: float, longitude: float, height: float) -> Array:
    """Earth-centred, earth-fixed position (3,) [m] of geodetic coordinates [rad, rad, m]."""
    _, transverse = radii(latitude)
    (sin_lat, cos_lat), (sin_lon, cos_lon) = sin_cos(latitude), sin_cos(longitude)
    around = (transverse + height) * cos_lat
    return np.array([around * cos_lon, around * sin_lon, (transverse * (1 - ECCENTRICITY2) + height) * sin_lat])


@compiled
def geodetic_trig(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Sine and cosine of latitude, then of longitude, of an earth-fixed position [m].

    Bowring's formula, twice: exact to double precision from the Earth's core region outward to space. On the axis the
    longitude is taken as 0.
    """
    p = math.sqrt(x * x + y * y)
    if p > 0:
        sin_lon, cos_lon = y / p, x / p
    else:
        sin_lon, cos_lon = 0.0, 1.0
    tangent_n, tangent_d = z * SEMI_MAJOR, p * SEMI_MINOR  # of the reduced latitude
    sin_lat, cos_lat = 0.0, 1.0
    for _ in range(2):
        norm = math.sqrt(tangent_n * tangent_n + tangent_d * tangent_d)
        sin_b, cos_b = tangent_n / norm, tangent_d / norm
        up = z + SECOND_ECCENTRICITY2 * SEMI_MINOR * sin_b * sin_b * sin_b
        out = p - ECCENTRICITY2 * SEMI_MAJOR * cos_b * cos_b * cos_b
        norm = math.sqrt(up * up + out * out)
        sin_lat, cos_lat = up / norm, out / norm
        tangent_n, tangent_d = sin_lat * SEMI_MINOR, cos_lat * SEMI_MAJOR
    return sin_lat, cos_lat, sin_lon, cos_lon


@compiled
def height_of(x: float, y: float, z: float, sin_lat: float, cos_lat: float) -> float:
    """Height above the ellipsoid [m] of an earth-fixed position [m] whose geodetic latitude is known."""
    root = math.sqrt(1 - ECCENTRICITY2 * sin_lat * sin_lat)
    return math.sqrt(x * x + y * y) * cos_lat + z * sin_lat - SEMI_MAJOR * root


@compiled
def geodetic(position_e: Vector3) -> tuple[float, float, float]:
    """Latitude, longitude [rad], height [m] of an earth-fixed position (3,) [m]."""
    x, y, z = float(position_e[0]), float(position_e[1]), float(position_e[2])
    sin_lat, cos_lat, sin_lon, cos_lon = geodetic_trig(x, y, z)
    return atan2(sin_lat, cos_lat), atan2(sin_lon, cos_lon), height_of(x, y, z, sin_lat, cos_lat)


@compiled
def mat_ne_from_trig(sin_lat: float, cos_lat: float, sin_lon: float, cos_lon: float) -> Matrix3:
    """Rotation (3, 3) from earth-fixed to north-east-down axes."""
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [-sin_lon, cos_lon, 0.0],
            [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
        ]
    )


@compiled
def mat_ne(position_e: Vector3) -> Matrix3:
    """Rotation (3, 3) from earth-fixed to north-east-down axes at an earth-fixed position (3,) [m]."""
    sin_lat, cos_lat, sin_lon, cos_lon = geodetic_trig(position_e[0], position_e[1], position_e[2])
    return mat_ne_from_trig(sin_lat, cos_lat, sin_lon, cos_lon)


@compiled
def normal_gravity(sin_lat: float, height: float) -> float:
    """Gravity [m/s^2], centrifugal part included, from the sine of latitude and the height [m]: Somigliana's formula
    and its second-order continuation upward (TR8350.2, 4-1 and 4-3)."""
    s2 = sin_lat * sin_lat
    surface = EQUATOR_GRAVITY * (1 + SOMIGLIANA * s2) / math.sqrt(1 - ECCENTRICITY2 * s2)
    ratio = height / SEMI_MAJOR
    return surface * (1 - 2 * ratio * (1 + FLATTENING + GRAVITY_RATIO - 2 * FLATTENING * s2) + 3 * ratio * ratio)


def gravity(latitude: float, height: float) -> float:
    """Normal gravity [m/s^2] at a latitude [rad] and height [m]."""
    return normal_gravity(sin_cos(latitude)[0], height)


@compiled
def gravity_e(position_e: Vector3) -> Vector3:
    """Normal gravity vector (3,) [m/s^2] in earth-fixed axes at an earth-fixed position (3,) [m]."""
    x, y, z = float(position_e[0]), float(position_e[1]), float(position_e[2])
    sin_lat, cos_lat, sin_lon, cos_lon = geodetic_trig(x, y, z)
    g = normal_gravity(sin_lat, height_of(x, y, z, sin_lat, cos_lat))
    return np.array([-g * cos_lat * cos_lon, -g * cos_lat * sin_lon, -g * sin_lat])


def earth_rate_n(latitude: float) -> Array:
    """The Earth's rotation (3,) [rad/s] in north-east-down axes at a latitude [rad]."""
    sine, cosine = sin_cos(latitude)
    return np.array([EARTH_RATE * cosine, 0.0, -EARTH_RATE * sine])
