"""The simulated barometer: the standard atmosphere's pressure at the height and a wandering offset."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.atmosphere import GAS_CONSTANT, LAYERS, STANDARD_GRAVITY, geopotential_height
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import Barometer

CENTI_CELSIUS = 3200  # of the sensor in its warm box


def measure(barometer: Barometer, height: Array, random: np.random.Generator) -> NDArray[np.float32]:
    """Readings (N,) [hPa], as SCALED_PRESSURE holds them, at heights (N,) [m] of the troposphere."""
    white, steps = random.standard_normal((2, len(height)))
    walk = np.cumsum(steps) * barometer.offset_walk_m / np.sqrt(max(barometer.rate_hz, 1e-9))
    return pressure(height + barometer.offset_m + walk + barometer.sigma_m * white).astype(np.float32)


def pressure(altitude: Array) -> Array:
    """The standard pressure [hPa] at geometric heights [m] of the troposphere."""
    base, _, temperature, gradient = LAYERS[0]
    ratio: Array = 1 + gradient * geopotential_height(altitude) / temperature
    return base / 100 * ratio ** (-STANDARD_GRAVITY / (GAS_CONSTANT * gradient))
