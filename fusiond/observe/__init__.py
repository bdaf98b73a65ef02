"""The table of observation models: one file each, one line each. The kernel knows them by their place in `MODELS`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from fusiond.earth import Array
from fusiond.measurements import GnssPosition, GnssVelocity, WheelSpeed
from fusiond.observe import gnss_position, gnss_velocity, non_holonomic, wheel_speed, zero_rotation, zero_velocity
from fusiond.observe.model import Observation
from fusiond.state import FilterState


class Model(NamedTuple):
    """`payload` is what a source of this model sends; None marks a constraint that the filter applies by itself."""

    name: str
    payload: type | None
    observe: Callable[[FilterState, Array, Array], Observation | None]


MODELS = (
    Model("gnss_position", GnssPosition, gnss_position.observe),
    Model("gnss_velocity", GnssVelocity, gnss_velocity.observe),
    Model("wheel_speed", WheelSpeed, wheel_speed.observe),
    Model("non_holonomic", None, non_holonomic.observe),
    Model("zero_velocity", None, zero_velocity.observe),
    Model("zero_rotation", None, zero_rotation.observe),
)
CONSTRAINTS = MODELS[3:]
