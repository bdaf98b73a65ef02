"""Barometric height: the pressure altitude of the standard atmosphere (ICAO Doc 7488/3) is the height and an offset, which
is a state: weather, geoid, and the sensor's own error."""

from __future__ import annotations

import math

from fusiond.config.schema import Barometer
from fusiond.events import Pressure
from fusiond.filter.observations.model import RESETS, Observation, Unusable, begin, empty_row
from fusiond.filter.state import HEIGHT_OFFSET, HEIGHT_OFFSET_ERROR, POSITION, POSITION_E, FilterState
from fusiond.maths.atmosphere import geometric_height, pressure_altitude
from fusiond.maths.portable import square
from fusiond.maths.typed import Array, Vector, compiled
from fusiond.maths.wgs84 import geodetic, mat_ne

ALTITUDE, VARIANCE = 0, 1  # m, m^2: values

PRESSURE_LIMITS = (1_000.0, 120_000.0)  # Pa: 31 km up, below the Dead Sea


def parameters(barometer: Barometer) -> Array:
    row = empty_row()
    row[RESETS] = HEIGHT_OFFSET_ERROR.start
    return row


def values(reading: Pressure, barometer: Barometer) -> tuple[float, ...]:
    """Pressure altitude [m], as a geometric height, and its variance [m^2]. Raises Unusable."""
    if not PRESSURE_LIMITS[0] <= reading.absolute <= PRESSURE_LIMITS[1]:
        raise Unusable("impossible pressure" if math.isfinite(reading.absolute) else "not finite")
    return geometric_height(pressure_altitude(reading.absolute)), square(barometer.sigma_m)


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (1,) [m], up: pressure altitude less height and offset. The height is that of the IMU."""
    x = state.nominal
    to_n = mat_ne(x[POSITION_E])
    begin(seen, 1)
    seen.jacobian[0, POSITION] = -to_n[2]  # up is minus down
    seen.jacobian[0, HEIGHT_OFFSET_ERROR.start] = 1.0
    _, _, height = geodetic(x[POSITION_E])
    seen.innovation[0] = row[ALTITUDE] - height - x[HEIGHT_OFFSET.start]
    seen.variance[0] = row[VARIANCE]
    return True
