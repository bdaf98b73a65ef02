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
from fusiond_adapters.ros2 import cdr
from fusiond_adapters.ros2.convert import KINDS, Converter
from tests.helpers.estimates import random_state
from tests.helpers.ros2 import ROS_PYTHON, STORE, T0, health, read_by_ros, state_numbered


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
    topics = {"odometry", "odometry/local", "twist", "fix"}
    assert set(payloads(converter, state_numbered(4, Mode.DEAD_RECKONING))) == topics | {"/tf"}
    assert set(payloads(Converter(Ros2(tf=False)), state_numbered(5))) == topics


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


def test_the_odometry_in_odom_is_continuous_where_that_in_map_jumps() -> None:
    """A drive to the north at 10 m/s; after 1 s a reset moves the state by 80 m and turns it by 0.5 rad."""
    converter, poses = Converter(Ros2()), dict[str, list[list[float]]](odometry=[], **{"odometry/local": []})
    sigmas: list[float] = []
    for number in range(100):
        jumped = number >= 50
        turned = (math.cos(0.25), 0.0, 0.0, math.sin(0.25)) if jumped else (1.0, 0.0, 0.0, 0.0)
        north = 10.0 * number * 0.02 + (80.0 if jumped else 0.0)
        velocity = (10.0 * math.cos(0.5), 10.0 * math.sin(0.5), 0.0) if jumped else (10.0, 0.0, 0.0)
        place = {"lat_deg": 48.0 + math.degrees(north / 6.37e6), "lon_deg": 11.0, "height_m": 0.0}
        motion = {"velocity_ned_mps": velocity, "quaternion_nb": turned, "angular_rate_b_rps": (0.0, 0.0, 0.0)}
        state = random_state(1, **place, **motion)
        sent = payloads(converter, state_numbered(number, state=state, resets=int(jumped)))
        for name, found in poses.items():
            message = read(name, sent[name])
            found.append([*numbers(message.pose.pose.position), *numbers(message.pose.pose.orientation)])
            assert message.header.frame_id == ("map" if name == "odometry" else "odom")
        covariance = np.reshape(read("odometry/local", sent["odometry/local"]).pose.covariance, (6, 6))
        sigmas.append(math.sqrt(covariance[0, 0] + covariance[1, 1]))
        if number == 99:
            transforms = read("/tf", sent["/tf"]).transforms
            chain = [(one.header.frame_id, one.child_frame_id) for one in transforms]
            assert chain == [("map", "odom"), ("odom", "base_link")]
            below = transforms[1].transform
            assert [*numbers(below.translation), *numbers(below.rotation)] == poses["odometry/local"][-1]
    steps = {name: np.linalg.norm(np.diff(np.array(found)[:, :3], axis=0), axis=1) for name, found in poses.items()}
    assert steps["odometry"].max() > 79 and steps["odometry/local"].max() == pytest.approx(0.2, rel=0.05)
    turns = np.abs(np.diff(np.array(poses["odometry/local"])[:, 3:], axis=0)).max()
    assert turns < 1e-3  # the Earth's rotation, and rounding
    assert sigmas[0] == 0.0 and sigmas == sorted(sigmas) and sigmas[-1] > 0.05


def numbers(message: Any) -> list[float]:
    return [getattr(message, name) for name in "xyzw" if hasattr(message, name)]


@pytest.mark.parametrize(("rate", "count"), [(50.0, 50), (20.0, 20), (1.0, 1), (1000.0, 50)])
def test_states_are_sent_at_a_rate_of_their_own(rate: float, count: int) -> None:
    converter = Converter(Ros2(rate_hz=rate, tf=False))
    sent = [name for number in range(100) for name, _ in converter.state(state_numbered(number))]
    assert len(sent) == pytest.approx(2 * count * 4, abs=4)


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


@pytest.mark.skipif(not ROS_PYTHON.exists(), reason="needs ROS 2's wheels, which are for CPython 3.11: make ros")
def test_ros_2_itself_reads_every_message() -> None:
    """Its own deserializer, its own types and hashes; and what its own serializer makes of them."""
    converter, sent = Converter(Ros2()), list[tuple[str, bytes]]()
    for number in range(3):
        sent += converter.state(state_numbered(number))
    sent += converter.health(health())
    known = [(name, payload) for name, payload in sent if name != "/tf"]  # there is no wheel of tf2_msgs
    assert {name for name, _ in known} == KINDS.keys() - {"/tf"}
    answers = read_by_ros([(KINDS[name], payload) for name, payload in known])
    for (name, payload), (type_hash, content, again) in zip(known, answers, strict=True):
        assert type_hash == cdr.type_hash(KINDS[name])
        assert content == plain(read(name, payload))
        assert len(again) == len(payload) and plain(read(name, again)) == content  # it leaves gaps as they were in memory
    assert answers[1][1]["header"]["frame_id"] == "odom" and len(answers) == len(known) == 3 * 4 + 1


def plain(value: Any) -> Any:
    """What rosbags read, as JSON has it."""
    if hasattr(value, "__msgtype__"):
        names = [name for name in value.__dataclass_fields__ if name != "__msgtype__" and not name.isupper()]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(inner) for inner in value] if isinstance(value, list) else value
