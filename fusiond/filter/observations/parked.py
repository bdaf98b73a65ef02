"""A parked car: with the gear lever at park or the handbrake on it stands, so its velocity over ground is nothing. One
that is not parked says nothing of its velocity."""

from __future__ import annotations

from fusiond.config.car import ParkedSensor
from fusiond.events import Parked
from fusiond.filter.observations.model import UNWEIGHTED, Observation, begin, empty_row
from fusiond.filter.state import VELOCITY, VELOCITY_E, FilterState
from fusiond.maths.portable import square
from fusiond.maths.typed import Array, Vector, compiled

STANDS, VARIANCE = 0, 1  # 1 or 0, (m/s)^2: values


def parameters(_sensor: ParkedSensor) -> Array:
    return empty_row()


def values(reading: Parked, sensor: ParkedSensor) -> tuple[float, ...]:
    """Whether the car is parked, and the variance of its velocity then [(m/s)^2]."""
    return float(reading.parked), square(sensor.sigma_mps)


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (3,) [m/s], earth-fixed axes."""
    begin(seen, 3)
    stands = row[STANDS] != 0.0
    for i in range(3):
        seen.jacobian[i, VELOCITY.start + i] = 1.0 if stands else 0.0
        seen.innovation[i] = -state.nominal[VELOCITY_E.start + i] if stands else 0.0
        seen.variance[i] = row[VARIANCE] if stands else UNWEIGHTED
    return True
