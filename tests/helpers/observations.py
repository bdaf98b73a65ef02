"""An observation model, asked as the filter asks it: into memory that still holds another observation."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from fusiond.filter.observations.model import Observation
from fusiond.filter.state import FilterState
from fusiond.maths.typed import Array


class Observed(NamedTuple):
    """What a model observes on m axes."""

    innovation: Array  # (m,)
    jacobian: Array  # (m, n)
    variance: Array  # (m,)


def observed(
    observe: Callable[[FilterState, Array, Array, Observation], bool], state: FilterState, row: Array, parameters: Array
) -> Observed | None:
    """What a model observes; None where there is nothing. A number that the model leaves unwritten is not finite."""
    seen = Observation(state.size)
    seen.innovation[:] = seen.jacobian[:] = seen.variance[:] = seen.common[:] = math.nan
    return Observed(*seen.trimmed()) if observe(state, row, parameters, seen) else None
