"""WGS-84 for whole arrays: radii, gravity, rates; independent of `fusiond.maths.wgs84`, so that each checks the other."""

from __future__ import annotations

import numpy as np

from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import EARTH_RATE, EQUATOR_GRAVITY, FLATTENING, GRAVITY_RATIO, SEMI_MAJOR, SOMIGLIANA

E2 = FLATTENING * (2 - FLATTENING)


def radii(latitude: Array) -> tuple[Array, Array]:
    """Radii of curvature [m], meridian and transverse, each of the shape of `latitude` [rad]."""
    w2 = 1 - E2 * np.sin(latitude) ** 2
    return SEMI_MAJOR * (1 - E2) / (w2 * np.sqrt(w2)), SEMI_MAJOR / np.sqrt(w2)


def gravity(latitude: Array, height: Array) -> Array:
    """Normal gravity [m/s^2], downward, at latitudes [rad] and heights [m] (NIMA TR8350.2, 4-1 and 4-3)."""
    sin2 = np.sin(latitude) ** 2
    surface = EQUATOR_GRAVITY * (1 + SOMIGLIANA * sin2) / np.sqrt(1 - E2 * sin2)
    first = 2 / SEMI_MAJOR * (1 + FLATTENING + GRAVITY_RATIO - 2 * FLATTENING * sin2)
    result: Array = surface * (1 - first * height + 3 * (height / SEMI_MAJOR) ** 2)
    return result


def earth_rate_n(latitude: Array) -> Array:
    """Rotation (N, 3) [rad/s] of the Earth in north-east-down axes at latitudes (N,) [rad]."""
    return EARTH_RATE * np.stack([np.cos(latitude), np.zeros_like(latitude), -np.sin(latitude)], axis=-1)


def transport_rate_n(latitude: Array, height: Array, velocity_n: Array) -> Array:
    """Rotation (N, 3) [rad/s] of the north-east-down axes against the Earth, moving with `velocity_n` (N, 3) [m/s]."""
    meridian, transverse = radii(latitude)
    north, east = velocity_n[:, 0], velocity_n[:, 1]
    around = east / (transverse + height)
    return np.stack([around, -north / (meridian + height), -around * np.tan(latitude)], axis=-1)


def shifted(latitude: Array, longitude: Array, height: Array, offset_n: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude [rad], height [m] of the points `offset_n` (N, 3) [m] (a few metres) away."""
    meridian, transverse = radii(latitude)
    north = latitude + offset_n[:, 0] / (meridian + height)
    east = longitude + offset_n[:, 1] / ((transverse + height) * np.cos(latitude))
    return north, wrapped(east), height - offset_n[:, 2]


def wrapped(angle: Array) -> Array:
    """Angles [rad] wrapped to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
