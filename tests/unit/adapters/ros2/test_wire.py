"""ROS 2 output: bytes against rosbags and pycdr2, protocol against zenoh-ros2-sdk, what is told of states and health."""

import math
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fusiond.config.load import parse
from fusiond.config.schema import Config, Ros2
from fusiond.config.toml import ConfigError
from fusiond.estimator.solution import Mode
from fusiond.messages.local_frame import LocalFrame, LocalState, Placed
from fusiond.messages.types import (
    HealthMessage,
    InputHealth,
    LatencyHealth,
    OutcomeCounts,
    SourceHealth,
    StateMessage,
)
from fusiond_adapters.registry import ros2 as factory
from tests.unit.messages.test_local_frame import state

rosbags_store = pytest.importorskip("rosbags.typesys", reason="needs the extra ros2")
pytest.importorskip("xxhash", reason="needs the extra ros2")

from fusiond_adapters.ros2 import cdr, wire  # noqa: E402
from fusiond_adapters.ros2.convert import KINDS, Converter  # noqa: E402
from fusiond_adapters.ros2.output import topics  # noqa: E402

STORE = rosbags_store.get_typestore(rosbags_store.Stores.ROS2_JAZZY)
DEADLINE = 15.0  # s
SECOND = 1_000_000_000  # ns
T0 = 1_700_000_000 * SECOND
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = wire.Topic("/chatter", "std_msgs/msg/String", STRING_HASH, 7)
ZID = "8b20917502ee955ac4476e0266340d5c"


def told(number: int = 1, mode: Mode = Mode.NOMINAL, **given: Any) -> StateMessage:
    values: dict[str, Any] = {"state": state(number), "age_ms": 1.0, "resets": 0, **given}
    t_ns = T0 + 7 + number * 20_000_000
    return StateMessage(vehicle="rover", t_ns=t_ns, mode=mode, outcomes=OutcomeCounts(), **values)


def health(t_ns: int = T0 + 9, mode: Mode = Mode.NOMINAL, resets: int = 0, dropped: int = 0) -> HealthMessage:
    return HealthMessage(
        vehicle="rover",
        t_ns=t_ns,
        version="0",
        uptime_s=12.5,
        mode=mode,
        resets=resets,
        reset_reason="gnss.position is believed again" if resets else None,
        outcomes=OutcomeCounts(fused=10, rejected=2),
        latency_ms=LatencyHealth(),
        sources={
            "gnss.position": SourceHealth(outcomes=OutcomeCounts(fused=4), present=True, age_ms=3.0, rate_hz=5.0),
            "wheel": SourceHealth(outcomes=OutcomeCounts(), present=False),
        },
        inputs={"mavlink.fc": InputHealth(received=100, dropped=dropped, counts={"bad": 1})},
        outputs={},
    )


def payloads(converter: Converter, *messages: StateMessage) -> dict[str, bytes]:
    return {name: payload for message in messages for name, payload in converter.state(message)}


def read(name: str, payload: bytes) -> Any:
    return STORE.deserialize_cdr(payload, KINDS[name])


# --- CDR


def made(kind: str, *values: Any) -> Any:
    return STORE.types[kind](*values)


def header(t_ns: int, frame: str) -> Any:
    return made("std_msgs/msg/Header", made("builtin_interfaces/msg/Time", *divmod(t_ns, SECOND)), frame)


def xyz(kind: str, numbers: Any) -> Any:
    return made(f"geometry_msgs/msg/{kind}", *map(float, numbers))


def block_diagonal(first: Any, second: Any) -> Any:
    whole = np.zeros((6, 6))
    whole[:3, :3], whole[3:, 3:] = np.reshape(first, (3, 3)), np.reshape(second, (3, 3))
    return whole.ravel()


def twist(local: LocalState, variance: Any) -> Any:
    both = made("geometry_msgs/msg/Twist", xyz("Vector3", local.velocity_b), xyz("Vector3", local.angular_rate_b))
    covariance = block_diagonal(local.covariance_velocity_b, np.diag(variance))
    return made("geometry_msgs/msg/TwistWithCovariance", both, covariance)


def bytes_of(message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


FRAMES = [("map", "odom", "base_link"), ("m", "od", "b"), ("a_map", "an_odometry", "rover")]


@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("seed", range(3))
def test_packed_messages_are_rosbags_bytes(frames: tuple[str, str, str], seed: int) -> None:
    world, odom, base = frames
    s = state(seed)
    local, t_ns, variance = LocalFrame.at(state(seed + 9)).state(s), T0 + 123_456_789 + seed, (0.1, 0.2, 0.3)

    w, x, y, z = local.quaternion_lb
    pose = made("geometry_msgs/msg/Pose", xyz("Point", local.position_l), xyz("Quaternion", (x, y, z, w)))
    covariance = block_diagonal(local.covariance_position_l, local.covariance_attitude_l)
    pose = made("geometry_msgs/msg/PoseWithCovariance", pose, covariance)
    odometry = made(cdr.ODOMETRY, header(t_ns, world), base, pose, twist(local, variance))
    template = cdr.OdometryTemplate(world, base)
    template.filled(5, LocalFrame.at(s).state(state(1)), (9.0, 9.0, 9.0))  # leaves nothing behind
    assert template.filled(t_ns, local, variance) == bytes_of(odometry)

    stamped = made(cdr.TWIST, header(t_ns, base), twist(local, variance))
    assert cdr.TwistTemplate(base).filled(t_ns, local, variance) == bytes_of(stamped)

    place, block = (s.lat_deg, s.lon_deg, s.height_m), s.covariance_position_m2
    for status in (cdr.STATUS_FIX, cdr.STATUS_NO_FIX):
        fix = made(cdr.FIX, header(t_ns, base), made("sensor_msgs/msg/NavSatStatus", status, 0), *place, np.array(block), 3)
        assert cdr.FixTemplate(base, status).filled(t_ns, place, block) == bytes_of(fix)

    chain = (Placed(local.position_l, local.quaternion_lb), Placed(local.velocity_l, (1.0, 0.0, 0.0, 0.0)))
    transforms = []
    for parent, child, placed in zip((world, odom), (odom, base), chain, strict=True):
        w, x, y, z = placed.quaternion
        turned = made("geometry_msgs/msg/Transform", xyz("Vector3", placed.position), xyz("Quaternion", (x, y, z, w)))
        transforms.append(made("geometry_msgs/msg/TransformStamped", header(t_ns, parent), child, turned))
    assert cdr.TransformsTemplate(frames).filled(t_ns, chain) == bytes_of(made(cdr.TF, transforms))


def test_packed_messages_are_pycdr2s_bytes() -> None:
    """pycdr2 shares nothing with rosbags."""
    pycdr2 = pytest.importorskip("pycdr2", reason="needs pycdr2")
    types = pytest.importorskip("pycdr2.types")

    def struct_of(name: str, **fields: Any) -> Any:
        plain = type(name, (pycdr2.IdlStruct,), {"__annotations__": fields, "__module__": __name__}, typename=name)
        return dataclass(plain)

    stamp = struct_of("Stamp", sec=types.int32, nanosec=types.uint32)
    head = struct_of("Header", stamp=stamp, frame_id=str)
    fix = struct_of(
        "Fix", header=head, status=types.int8, service=types.uint16, latitude=float, longitude=float, altitude=float,
        covariance=types.array[types.float64, 9], covariance_type=types.uint8,
    )  # fmt: skip
    numbers = types.array[types.float64, 7 + 36 + 6 + 36]
    odometry = struct_of("Odometry", header=head, child_frame_id=str, numbers=numbers)
    s = state()
    local = LocalFrame.at(s).state(s)
    packed = cdr.OdometryTemplate("odom", "base_link").filled(T0 + 5, local, (1.0, 2.0, 3.0))
    body = list(struct.unpack("<85d", packed[-680:]))
    assert packed == odometry(head(stamp(*divmod(T0 + 5, SECOND)), "odom"), "base_link", body).serialize()
    assert body[:3] == list(local.position_l) and body[6] == local.quaternion_lb[0]
    block = list(s.covariance_position_m2)
    want = fix(head(stamp(*divmod(T0 + 5, SECOND)), "gps"), -1, 0, s.lat_deg, s.lon_deg, s.height_m, block, 3)
    place = (s.lat_deg, s.lon_deg, s.height_m)
    assert cdr.FixTemplate("gps", -1).filled(T0 + 5, place, s.covariance_position_m2) == want.serialize()


# --- The protocol


def test_tokens_and_keys_are_those_of_rmw_zenohs_design() -> None:
    """The examples of its docs/design.md, to the letter."""
    assert wire.topic_key(0, CHATTER) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert wire.topic_key(2, changed(CHATTER, name="/robot1/chatter")).startswith("2/robot1/chatter/std_msgs::")
    node = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert wire.node_token(0, "aac3178e146ba6f1fc6e6a4085e77f21", 0, "/", "listener") == node
    publisher = f"@ros2_lv/0/{ZID}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    assert wire.publisher_token(0, ZID, 0, 10, "/", "talker", CHATTER) == publisher


def changed(topic: wire.Topic, **changes: Any) -> wire.Topic:
    return wire.Topic(**{name: changes.get(name, getattr(topic, name)) for name in wire.Topic.__slots__})


@pytest.mark.parametrize("namespace", ["/", "/fleet/rover_1"])
def test_tokens_and_keys_are_the_sdks(namespace: str) -> None:
    pytest.importorskip("zenoh_ros2_sdk", reason="needs zenoh-ros2-sdk")
    from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity  # noqa: PLC0415
    from zenoh_ros2_sdk.keyexpr import (  # noqa: PLC0415
        endpoint_liveliness_keyexpr,
        node_liveliness_keyexpr,
        topic_keyexpr,
    )
    from zenoh_ros2_sdk.qos import QosProfile  # noqa: PLC0415
    from zenoh_ros2_sdk.utils import get_type_hash, ros2_to_dds_type  # noqa: PLC0415

    node = NodeEntity(42, ZID, 0, "fusiond", namespace)
    assert wire.node_token(42, ZID, 0, namespace, "fusiond") == node_liveliness_keyexpr(node)
    found = list(topics(Ros2(namespace=namespace)))
    assert [name for name, _ in found] == ["odometry", "fix", "twist", "/tf", "/diagnostics"]
    for entity, (name, topic) in enumerate(found, 1):
        prefix = "" if namespace == "/" or name.startswith("/") else namespace
        assert topic.name == f"{prefix}/{name.strip('/')}"
        definition, dependencies = definitions(topic.kind)
        assert topic.hash == get_type_hash(topic.kind, definition, dependencies)
        dds = ros2_to_dds_type(topic.kind)
        assert wire.topic_key(42, topic) == topic_keyexpr(42, topic.name, dds, topic.hash)
        qos = QosProfile(history_depth=topic.depth).encode()
        endpoint = EndpointEntity(node, entity, EntityKind.PUBLISHER, topic.name, dds, topic.hash, qos)
        assert wire.publisher_token(42, ZID, 0, entity, namespace, "fusiond", topic) == endpoint_liveliness_keyexpr(endpoint)


def definitions(kind: str) -> tuple[str, dict[str, str]]:
    """The .msg text of a type, and of those inside it."""
    first, *rest = STORE.generate_msgdef(kind, ros_version=2)[0].split("=" * 80 + "\n")
    inside = (part.split("\n", 1) for part in rest)
    return first, {name.removeprefix("MSG: ").replace("/", "/msg/"): text for name, text in inside}


def test_humble_has_no_hashes() -> None:
    assert {topic.hash for _, topic in topics(Ros2(type_hashes=False))} == {"TypeHashNotSupported"}


# --- What is told


def test_nothing_is_told_of_a_state_that_is_not_fit() -> None:
    converter = Converter(Ros2())
    unfit = [told(1, Mode.ALIGNING, state=None), told(2, Mode.LOST), told(3, Mode.LOST, state=None)]
    assert payloads(converter, *unfit) == {} and converter.unfit == 3
    assert converter.origin == "none yet"
    assert set(payloads(converter, told(4, Mode.DEAD_RECKONING))) == {"odometry", "/tf", "twist", "fix"}
    assert set(payloads(Converter(Ros2(tf=False)), told(5))) == {"odometry", "twist", "fix"}


def test_a_fix_by_dead_reckoning_is_not_called_a_fix() -> None:
    for mode, status in ((Mode.NOMINAL, 0), (Mode.DEAD_RECKONING, -1)):
        assert read("fix", payloads(Converter(Ros2()), told(1, mode))["fix"]).status.status == status


def test_the_origin_stays_where_it_was_given_or_first_found() -> None:
    first = told(1)
    assert first.state is not None
    converter = Converter(Ros2())
    assert_allclose(numbers(read("odometry", payloads(converter, first)["odometry"]).pose.pose.position), 0.0, atol=1e-8)
    origin = converter.origin
    again = read("odometry", payloads(converter, told(2, resets=1))["odometry"])
    assert np.linalg.norm(numbers(again.pose.pose.position)) > 100 and converter.origin == origin
    place = (first.state.lat_deg, first.state.lon_deg, first.state.height_m - 2.0)
    given = read("odometry", payloads(Converter(Ros2(origin=place)), first)["odometry"])
    assert_allclose(numbers(given.pose.pose.position), (0.0, 0.0, 2.0), atol=1e-8)


def numbers(message: Any) -> list[float]:
    return [getattr(message, name) for name in "xyzw" if hasattr(message, name)]


@pytest.mark.parametrize(("rate", "count"), [(50.0, 50), (20.0, 20), (1.0, 1), (1000.0, 50)])
def test_states_are_told_at_a_rate_of_their_own(rate: float, count: int) -> None:
    converter = Converter(Ros2(rate_hz=rate, tf=False))
    sent = [name for number in range(100) for name, _ in converter.state(told(number))]
    assert len(sent) == pytest.approx(2 * count * 3, abs=3)


def test_diagnostics_tell_of_a_reset_at_once() -> None:
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
    assert "pose in map jumped: gnss.position is believed again" in after["fusiond: state"].message
    assert {pair.key: pair.value for pair in after["fusiond: state"].values}["resets"] == "2"
    later = diagnosed(health(T0 + 10 * SECOND, resets=2, dropped=3))
    assert (later["fusiond: state"].level, later["fusiond: input mavlink.fc"].level) == (0, 0)
    assert diagnosed(health(T0 + 11 * SECOND, Mode.LOST, resets=3))["fusiond: state"].level == 2


# --- Configuration


BASE = """
[mavlink.fc]
[imu.main]
link = "fc"
"""


def test_off_unless_enabled() -> None:
    assert factory(Config(), None) == []  # type: ignore[arg-type]
    code = "import sys, fusiond_adapters.registry, fusiond.config.load; print('rosbags' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
    config = parse(BASE + '[zenoh]\nlisten = []\n[ros2]\nenabled = true\nnamespace = "/rover"\n')
    (output,) = factory(config, None)  # type: ignore[arg-type]
    assert output.name == "ros2" and "tcp/127.0.0.1:7447" in output.about


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ("", "tcp/127.0.0.1:7447 is where \\[zenoh\\] listens"),
        ('odom_frame = "map"', "must differ"),
        ("origin = [91.0, 0.0, 0.0]", "latitude must be in"),
        ('namespace = "rover"', "namespace"),
        ('map_frame = "/map"', "map_frame"),
        ("domain = 233", "domain"),
    ],
)
def test_what_makes_no_sense_is_refused(lines: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        parse(f"{BASE}\n[ros2]\nenabled = true\n{lines}\n", Path("x.toml"))


def test_angles_are_told_in_radians_and_stamps_in_whole_nanoseconds() -> None:
    message = told(3)
    odometry = read("odometry", payloads(Converter(Ros2()), message)["odometry"])
    stamp = odometry.header.stamp
    assert (stamp.sec, stamp.nanosec) == divmod(message.t_ns, SECOND)
    assert math.isclose(np.linalg.norm(numbers(odometry.pose.pose.orientation)), 1.0, rel_tol=1e-12)
