"""ROS 2 messages made from states and health."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fusiond.config.outputs import Ros2
from fusiond.estimator.solution import Mode
from fusiond.messages.types import (
    HealthMessage,
    StateMessage,
)
from fusiond.units import SECOND
from fusiond_adapters.ros2.convert import KINDS, Converter
from tests.helpers.ros2 import (
    STORE,
    T0,
    health,
    state_numbered,
)


def payloads(converter: Converter, *messages: StateMessage) -> dict[str, bytes]:
    return {name: payload for message in messages for name, payload in converter.state(message)}


def read(name: str, payload: bytes) -> Any:
    return STORE.deserialize_cdr(payload, KINDS[name])


def test_nothing_is_sent_of_a_state_that_is_not_usable() -> None:
    converter = Converter(Ros2())
    aligning, lost = state_numbered(1, Mode.ALIGNING, state=None), state_numbered(2, Mode.LOST)
    unfit = [aligning, lost, state_numbered(3, Mode.LOST, state=None)]
    assert payloads(converter, *unfit) == {} and converter.unfit == 3
    assert converter.origin == "none yet"
    assert set(payloads(converter, state_numbered(4, Mode.DEAD_RECKONING))) == {"odometry", "/tf", "twist", "fix"}
    assert set(payloads(Converter(Ros2(tf=False)), state_numbered(5))) == {"odometry", "twist", "fix"}


def test_a_fix_by_dead_reckoning_is_not_called_a_fix() -> None:
    for mode, status in ((Mode.NOMINAL, 0), (Mode.DEAD_RECKONING, -1)):
        assert read("fix", payloads(Converter(Ros2()), state_numbered(1, mode))["fix"]).status.status == status


def test_the_origin_stays_where_it_was_given_or_first_found() -> None:
    first = state_numbered(1)
    assert first.state is not None
    converter = Converter(Ros2())
    assert_allclose(numbers(read("odometry", payloads(converter, first)["odometry"]).pose.pose.position), 0.0, atol=1e-8)
    origin = converter.origin
    again = read("odometry", payloads(converter, state_numbered(2, resets=1))["odometry"])
    assert np.linalg.norm(numbers(again.pose.pose.position)) > 100 and converter.origin == origin
    place = (first.state.lat_deg, first.state.lon_deg, first.state.height_m - 2.0)
    given = read("odometry", payloads(Converter(Ros2(origin=place)), first)["odometry"])
    assert_allclose(numbers(given.pose.pose.position), (0.0, 0.0, 2.0), atol=1e-8)


def numbers(message: Any) -> list[float]:
    return [getattr(message, name) for name in "xyzw" if hasattr(message, name)]


@pytest.mark.parametrize(("rate", "count"), [(50.0, 50), (20.0, 20), (1.0, 1), (1000.0, 50)])
def test_states_are_sent_at_a_rate_of_their_own(rate: float, count: int) -> None:
    converter = Converter(Ros2(rate_hz=rate, tf=False))
    sent = [name for number in range(100) for name, _ in converter.state(state_numbered(number))]
    assert len(sent) == pytest.approx(2 * count * 3, abs=3)


def test_diagnostics_report_a_reset_at_once() -> None:
    converter = Converter(Ros2())

    def diagnosed(message: HealthMessage) -> dict[str, Any]:
        ((name, payload),) = converter.health(message)
        array = read(name, payload)
        assert array.header.stamp.sec * SECOND + array.header.stamp.nanosec == message.t_ns
        assert {status.hardware_id for status in array.status} == {"rover"}
        return {status.name: status for status in array.status}

    calm = diagnosed(health(resets=1))
    assert {name: status.level for name, status in calm.items()} == {
        "fusiond: state": 0, "fusiond: gnss.position": 0, "fusiond: wheel": 1, "fusiond: input mavlink.fc": 0,
    }  # fmt: skip
    assert calm["fusiond: wheel"].message == "absent"
    after = diagnosed(health(T0 + 10, resets=2, dropped=3))
    assert (after["fusiond: state"].level, after["fusiond: input mavlink.fc"].message) == (1, "3 dropped")
    assert "pose in map jumped: gnss.position: rejected for too long" in after["fusiond: state"].message
    assert {pair.key: pair.value for pair in after["fusiond: state"].values}["resets"] == "2"
    later = diagnosed(health(T0 + 10 * SECOND, resets=2, dropped=3))
    assert (later["fusiond: state"].level, later["fusiond: input mavlink.fc"].level) == (0, 0)
    assert diagnosed(health(T0 + 11 * SECOND, Mode.LOST, resets=3))["fusiond: state"].level == 2


def test_angles_are_in_radians_and_stamps_in_whole_nanoseconds() -> None:
    message = state_numbered(3)
    odometry = read("odometry", payloads(Converter(Ros2()), message)["odometry"])
    stamp = odometry.header.stamp
    assert (stamp.sec, stamp.nanosec) == divmod(message.t_ns, SECOND)
    assert math.isclose(np.linalg.norm(numbers(odometry.pose.pose.orientation)), 1.0, rel_tol=1e-12)
