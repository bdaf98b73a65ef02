"""The standard atmosphere (ICAO Doc 7488/3): pressure, and the height at which it has that pressure."""

from __future__ import annotations

from typing import TypeVar

from fusiond.maths.portable import exp, log
from fusiond.maths.typed import Array

GAS_CONSTANT = 287.05287  # J/(kg K), of dry air
STANDARD_GRAVITY = 9.80665  # m/s^2
NOMINAL_RADIUS = 6_356_766.0  # m, of the Earth, between geopotential and geometric height
LAYERS = (  # base: pressure [Pa], geopotential height [m], temperature [K], and its gradient above [K/m]
    (101_325.0, 0.0, 288.15, -0.0065),
    (22_632.040, 11_000.0, 216.65, 0.0),
    (5_474.8774, 20_000.0, 216.65, 0.001),
)

Height = TypeVar("Height", float, Array)


def pressure_altitude(pressure: float) -> float:
    """Geopotential height [m] at which the standard atmosphere has a pressure [Pa], up to 32 km."""
    base, height, temperature, gradient = next((layer for layer in LAYERS[:0:-1] if pressure < layer[0]), LAYERS[0])
    depth = -GAS_CONSTANT / STANDARD_GRAVITY * log(pressure / base)  # m/K: height over temperature
    if gradient == 0:
        return height + temperature * depth
    return height + temperature / gradient * (exp(gradient * depth) - 1)


def geometric_height(geopotential: Height) -> Height:
    """Height above the sea [m] of a geopotential height [m]."""
    return NOMINAL_RADIUS * geopotential / (NOMINAL_RADIUS - geopotential)


def geopotential_height(geometric: Height) -> Height:
    """Geopotential height [m] of a height above the sea [m]."""
    return NOMINAL_RADIUS * geometric / (NOMINAL_RADIUS + geometric)
