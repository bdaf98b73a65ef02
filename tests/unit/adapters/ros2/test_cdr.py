"""CDR: packed messages have the bytes that rosbags and pycdr2 give."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from fusiond.messages.local_frame import LocalFrame, LocalState, Placed
from fusiond.units import SECOND
from fusiond_adapters.ros2 import cdr
from tests.helpers.estimates import random_state
from tests.helpers.ros2 import (
    STORE,
    T0,
)


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
    s = random_state(seed)
    local, t_ns, variance = LocalFrame.at(random_state(seed + 9)).state(s), T0 + 123_456_789 + seed, (0.1, 0.2, 0.3)

    w, x, y, z = local.quaternion_lb
    pose = made("geometry_msgs/msg/Pose", xyz("Point", local.position_l), xyz("Quaternion", (x, y, z, w)))
    covariance = block_diagonal(local.covariance_position_l, local.covariance_attitude_l)
    pose = made("geometry_msgs/msg/PoseWithCovariance", pose, covariance)
    odometry = made(cdr.ODOMETRY, header(t_ns, world), base, pose, twist(local, variance))
    template = cdr.OdometryTemplate(world, base)
    template.filled(5, LocalFrame.at(s).state(random_state(1)), (9.0, 9.0, 9.0))  # leaves nothing behind
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
    s = random_state()
    local = LocalFrame.at(s).state(s)
    packed = cdr.OdometryTemplate("odom", "base_link").filled(T0 + 5, local, (1.0, 2.0, 3.0))
    body = list(struct.unpack("<85d", packed[-680:]))
    assert packed == odometry(head(stamp(*divmod(T0 + 5, SECOND)), "odom"), "base_link", body).serialize()
    assert body[:3] == list(local.position_l) and body[6] == local.quaternion_lb[0]
    block = list(s.covariance_position_m2)
    want = fix(head(stamp(*divmod(T0 + 5, SECOND)), "gps"), -1, 0, s.lat_deg, s.lon_deg, s.height_m, block, 3)
    place = (s.lat_deg, s.lon_deg, s.height_m)
    assert cdr.FixTemplate("gps", -1).filled(T0 + 5, place, s.covariance_position_m2) == want.serialize()
