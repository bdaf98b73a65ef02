"""The table of observation models: one file each, one line each. A source's model is known by its place in `MODELS`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from fusiond.filter.observations import (
    barometric_height,
    gnss_position,
    gnss_velocity,
    gnss_yaw,
    lateral,
    non_holonomic,
    parked,
    steering,
    wheel_speed,
    yaw_rate,
    zero_rotation,
    zero_velocity,
)
from fusiond.filter.observations.model import Observation
from fusiond.filter.state import FilterState
from fusiond.maths.typed import Array, Vector, compiled


class Model(NamedTuple):
    """One kind of measurement; a stream of a sensor names it (fusiond.config.sensor.Stream). `values` makes a row of numbers
    of a payload and the sensor's table of the configuration, `parameters` another of the table alone, and `observe` takes
    both and fills an Observation."""

    name: str
    parameters: Callable[[Any], Array]
    values: Callable[[Any, Any], tuple[float, ...]]
    observe: Callable[[FilterState, Array, Array, Observation], bool]


MODELS = (
    Model("gnss_position", gnss_position.parameters, gnss_position.values, gnss_position.observe),
    Model("gnss_velocity", gnss_velocity.parameters, gnss_velocity.values, gnss_velocity.observe),
    Model("wheel_speed", wheel_speed.parameters, wheel_speed.values, wheel_speed.observe),
    Model("barometric_height", barometric_height.parameters, barometric_height.values, barometric_height.observe),
    Model("gnss_yaw", gnss_yaw.parameters, gnss_yaw.values, gnss_yaw.observe),
    Model("yaw_rate", yaw_rate.parameters, yaw_rate.values, yaw_rate.observe),
    Model("steering", steering.parameters, steering.values, steering.observe),
    Model("lateral_acceleration", lateral.parameters, lateral.values, lateral.observe),
    Model("parked", parked.parameters, parked.values, parked.observe),
)
IMU = -1  # stands for the inertial sensor where others have their place in MODELS
MODEL = {model.name: number for number, model in enumerate(MODELS)}
GNSS_POSITION, GNSS_VELOCITY, WHEEL_SPEED = MODEL["gnss_position"], MODEL["gnss_velocity"], MODEL["wheel_speed"]
GNSS_YAW = MODEL["gnss_yaw"]
ON_AXLE = (MODEL["steering"], MODEL["lateral_acceleration"])  # models whose point is the middle of the unsteered axle
CONSTRAINTS = (non_holonomic, zero_velocity, zero_rotation)  # observed by the filter itself: rows of Parameters.constraints


@compiled
def observe(state: FilterState, model: int, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Observe a source's reading by its model."""
    return MODELS[model].observe(state, row, parameter, seen)
