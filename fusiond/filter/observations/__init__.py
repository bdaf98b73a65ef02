"""The table of observation models: one file each, one line each. The kernel knows them by their place in `MODELS`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from fusiond.filter.observations import (
    barometric_height,
    gnss_position,
    gnss_velocity,
    non_holonomic,
    wheel_speed,
    zero_rotation,
    zero_velocity,
)
from fusiond.filter.observations.model import Observation
from fusiond.filter.state import FilterState
from fusiond.maths.wgs84 import Array


class Model(NamedTuple):
    """One kind of measurement. A source of it is called by the name of its table in the configuration, [table.NAME], with
    the suffix. `values` makes a row of numbers of a payload and that table, `parameters` another of the table alone, and
    `observe` takes both. Without a table it is a constraint, which the filter applies by itself."""

    name: str
    table: str | None
    suffix: str
    parameters: Callable[[Any], Array]
    values: Callable[[Any, Any], tuple[float, ...]]
    observe: Callable[[FilterState, Array, Array], Observation | None]


def no_values(payload: Any, section: Any) -> tuple[float, ...]:
    """Of a constraint, which has no payload."""
    return ()


MODELS = (
    Model("gnss_position", "gnss", ".position", gnss_position.parameters, gnss_position.values, gnss_position.observe),
    Model("gnss_velocity", "gnss", ".velocity", gnss_velocity.parameters, gnss_velocity.values, gnss_velocity.observe),
    Model("wheel_speed", "wheel", "", wheel_speed.parameters, wheel_speed.values, wheel_speed.observe),
    Model("non_holonomic", None, "", non_holonomic.parameters, no_values, non_holonomic.observe),
    Model("zero_velocity", None, "", zero_velocity.parameters, no_values, zero_velocity.observe),
    Model("zero_rotation", None, "", zero_rotation.parameters, no_values, zero_rotation.observe),
    Model(
        "barometric_height",
        "barometer",
        "",
        barometric_height.parameters,
        barometric_height.values,
        barometric_height.observe,
    ),
)
CONSTRAINTS = tuple(model for model in MODELS if model.table is None)
