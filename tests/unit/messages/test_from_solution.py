"""State messages made from estimates: units, and nothing that is not finite goes out."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import get_args

import numpy as np
import pytest

from fusiond.config.outputs import Encoding
from fusiond.estimator.solution import Mode, Solution, SolutionState
from fusiond.messages.codec import decode, encode
from fusiond.messages.csv import csv_row
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import StateMessage
from tests.helpers.estimates import COUNTS, T_NS, message, numbers, state

VECTORS = [field.name for field in dataclasses.fields(SolutionState) if field.name != "covariance"]


def test_sigmas_and_blocks_are_those_of_the_covariance() -> None:
    covariance = np.diag([4.0, 9.0, 16.0, 1.0, 7.0, 100.0, 1e-4, 1e-4, math.radians(3.0) ** 2])
    covariance[0, 1] = covariance[1, 0] = 0.5
    published = message(state(covariance=covariance)).state
    assert published is not None
    assert published.sigma_position_ned_m == (2.0, 3.0, 4.0)
    assert published.sigma_velocity_mps == 2.0  # of variances 1 and 7; down does not count
    assert published.sigma_yaw_deg == pytest.approx(3.0)
    assert published.covariance_position_m2 == (4.0, 0.5, 0.0, 0.5, 9.0, 0.0, 0.0, 0.0, 16.0)
    assert published.covariance_velocity_m2ps2[8] == 100.0
    assert published.covariance_attitude_rad2[0] == 1e-4


def test_units_of_the_message() -> None:
    published = message(state()).state
    assert published is not None
    assert published.lat_deg == math.degrees(0.8401)
    assert (published.roll_deg, published.pitch_deg, published.yaw_deg) == pytest.approx(np.degrees([0.02, -0.03, 3.0]))
    assert published.mount_deg == (math.degrees(0.01), math.degrees(-0.02))
    assert message(state()).age_ms == 2.5


def test_numpy_numbers_are_published_as_numbers() -> None:
    array = np.array([1.5, 2.5, 3.5])
    sent = message(state(height=array[0], wheel_scale=array[1], velocity_n=tuple(array), mount=tuple(array[:2])))
    assert sent.state is not None and {type(number) for number in numbers(sent.state)} == {float}
    assert csv_row(sent).split(",")[3:6] == ["1.5", "1.5", "2.5"]
    assert decode(encode(sent, "msgpack"), StateMessage, "msgpack") == sent


def test_while_aligning_there_is_no_state() -> None:
    sent = state_message(Solution(T_NS, Mode.ALIGNING, None, 0, None), "rover", COUNTS)
    assert (sent.state, sent.age_ms, sent.fault) == (None, None, None)
    assert csv_row(sent) == "1700000000123456" + "," * 15 + "aligning"
    assert json.loads(encode(sent, "json"))["state"] is None


@pytest.mark.parametrize("name", VECTORS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_withholds_the_state(name: str, bad: float) -> None:
    good = getattr(state(), name)
    sent = message(state(**{name: (bad, *good[1:]) if isinstance(good, tuple) else bad}))
    assert (sent.mode, sent.state) == (Mode.LOST, None)
    assert sent.fault is not None and sent.fault.endswith("not finite")
    for encoding in get_args(Encoding):
        assert decode(encode(sent, encoding), StateMessage, encoding) == sent
    assert csv_row(sent).endswith(",,lost")


@pytest.mark.parametrize(
    ("bad", "place"), [(-1e-9, (4, 4)), (math.nan, (8, 8)), (math.inf, (0, 0)), (math.nan, (0, 1))]
)
def test_a_covariance_that_is_none_withholds_the_state(bad: float, place: tuple[int, int]) -> None:
    covariance = np.eye(9)
    covariance[place] = bad
    sent = message(state(covariance=covariance))
    assert (sent.mode, sent.state) == (Mode.LOST, None)
    assert sent.fault is not None and sent.fault.startswith("covariance")


def test_a_number_too_large_for_its_published_unit_is_withheld() -> None:
    assert message(state(latitude=1e308)).fault == "lat_deg: not finite"
