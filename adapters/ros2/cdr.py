"""ROS 2 messages in CDR: frequent messages are packed once, then only their numbers are replaced."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

from fusiond.messages.local_frame import LocalState, Placed
from fusiond.messages.types import Block, Quaternion, Triple
from fusiond.units import SECOND

ODOMETRY = "nav_msgs/msg/Odometry"
FIX = "sensor_msgs/msg/NavSatFix"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
STATUS_FIX, STATUS_NO_FIX = 0, -1  # sensor_msgs/NavSatStatus
SERVICE_UNKNOWN = 0
COVARIANCE_TYPE_KNOWN = 3  # sensor_msgs/NavSatFix
OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
STAMP = struct.Struct("<iI")  # s, ns
HEADER = 4  # bytes before the first field: the encoding

_store = get_typestore(Stores.LATEST)


def type_hash(kind: str) -> str:
    """RIHS01_ and 64 hexadecimal digits, of a message type such as nav_msgs/msg/Odometry."""
    return _store.hash_rihs01(kind)


def _make(kind: str, *values: Any) -> Any:
    return _store.types[kind](*values)


def _serialized(message: Any) -> bytes:
    return bytes(_store.serialize_cdr(message, message.__msgtype__))


def _header(frame: str, t_ns: int = 0) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", *divmod(t_ns, SECOND))
    return _make("std_msgs/msg/Header", stamp, frame)


def _vector() -> Any:
    return _make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)


def _quaternion() -> Any:
    return _make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)


def _twist() -> Any:
    return _make(
        "geometry_msgs/msg/TwistWithCovariance", _make("geometry_msgs/msg/Twist", _vector(), _vector()), np.zeros(36)
    )


class Template:
    """The bytes of a message without its stamps and its numbers (consecutive 64-bit floats)."""

    def __init__(self, message: Any, numbers: int, behind: int = 0) -> None:
        """`numbers` is the count of consecutive numbers, `behind` the count of bytes after them."""
        self._bytes = bytearray(_serialized(message))
        self._numbers = struct.Struct(f"<{numbers}d")
        self._at = len(self._bytes) - behind - self._numbers.size

    def packed(self, t_ns: int, numbers: Iterable[float]) -> bytes:
        """The message with a stamp and its numbers."""
        STAMP.pack_into(self._bytes, HEADER, *divmod(t_ns, SECOND))
        self._numbers.pack_into(self._bytes, self._at, *numbers)
        return bytes(self._bytes)


class OdometryTemplate(Template):
    """nav_msgs/Odometry: the pose in a frame, the twist in the body frame."""

    def __init__(self, frame: str, child: str) -> None:
        position = _make("geometry_msgs/msg/Point", 0.0, 0.0, 0.0)
        pose = _make("geometry_msgs/msg/Pose", position, _quaternion())
        pose = _make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        super().__init__(_make(ODOMETRY, _header(frame), child, pose, _twist()), 7 + 36 + 6 + 36)

    def filled(self, t_ns: int, state: LocalState, rate_variance: Triple) -> bytes:
        """The body in the local frame."""
        pose = six(state.covariance_position_l, state.covariance_attitude_l)
        return self.placed(t_ns, Placed(state.position_l, state.quaternion_lb), pose, state, rate_variance)

    def placed(
        self, t_ns: int, body: Placed, covariance: Sequence[float], state: LocalState, rate_variance: Triple
    ) -> bytes:
        """The body where it is in any frame, with the covariance (6, 6) of its pose."""
        numbers = (*body.position, *xyzw(body.quaternion), *covariance, *twist(state, rate_variance))
        return self.packed(t_ns, numbers)


class TwistTemplate(Template):
    """geometry_msgs/TwistWithCovarianceStamped in the body frame."""

    def __init__(self, frame: str) -> None:
        super().__init__(_make(TWIST, _header(frame), _twist()), 6 + 36)

    def filled(self, t_ns: int, state: LocalState, rate_variance: Triple) -> bytes:
        return self.packed(t_ns, twist(state, rate_variance))


class FixTemplate(Template):
    """sensor_msgs/NavSatFix; `status` is STATUS_FIX or STATUS_NO_FIX."""

    def __init__(self, frame: str, status: int) -> None:
        state = _make("sensor_msgs/msg/NavSatStatus", status, SERVICE_UNKNOWN)
        message = _make(FIX, _header(frame), state, 0.0, 0.0, 0.0, np.zeros(9), COVARIANCE_TYPE_KNOWN)
        super().__init__(message, 3 + 9, behind=1)

    def filled(self, t_ns: int, position: Triple, covariance: Block) -> bytes:
        """Latitude, longitude [deg], altitude [m]; covariance east, north, up [m^2]."""
        return self.packed(t_ns, (*position, *covariance))


class TransformsTemplate:
    """tf2_msgs/TFMessage: a chain of frames, each relative to the previous one."""

    def __init__(self, frames: Sequence[str]) -> None:
        transforms: list[Any] = []
        self._stamps: list[int] = []
        self._places: list[int] = []
        self._numbers = struct.Struct("<7d")
        end = len(_serialized(_make(TF, transforms)))
        for parent, child in pairwise(frames):
            identity = _make("geometry_msgs/msg/Transform", _vector(), _quaternion())
            transforms.append(_make("geometry_msgs/msg/TransformStamped", _header(parent), child, identity))
            self._stamps.append(end)
            end = len(_serialized(_make(TF, transforms)))
            self._places.append(end - self._numbers.size)
        self._bytes = bytearray(_serialized(_make(TF, transforms)))

    def filled(self, t_ns: int, chain: Sequence[Placed]) -> bytes:
        seconds, rest = divmod(t_ns, SECOND)
        for stamp, place, placed in zip(self._stamps, self._places, chain, strict=True):
            STAMP.pack_into(self._bytes, stamp, seconds, rest)
            self._numbers.pack_into(self._bytes, place, *placed.position, *xyzw(placed.quaternion))
        return bytes(self._bytes)


def xyzw(quaternion: Quaternion) -> tuple[float, float, float, float]:
    """A quaternion in ROS's order."""
    w, x, y, z = quaternion
    return x, y, z, w


def twist(state: LocalState, rate_variance: Triple) -> tuple[float, ...]:
    """Velocity and angular rate in the body's axes, then their covariance (6, 6)."""
    x, y, z = rate_variance
    covariance = six(state.covariance_velocity_b, (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z))
    return (*state.velocity_b, *state.angular_rate_b, *covariance)


def six(upper: Block, lower: Block) -> tuple[float, ...]:
    """The covariance (6, 6), row by row, of two triples with independent errors."""
    none = (0.0, 0.0, 0.0)
    above = (*upper[:3], *none, *upper[3:6], *none, *upper[6:], *none)
    return (*above, *none, *lower[:3], *none, *lower[3:6], *none, *lower[6:])


class Status(NamedTuple):
    """diagnostic_msgs/DiagnosticStatus"""

    level: int
    name: str
    message: str
    values: Mapping[str, object]


def diagnostics(t_ns: int, hardware: str, statuses: Iterable[Status]) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    made = []
    for status in statuses:
        values = [_make("diagnostic_msgs/msg/KeyValue", key, str(value)) for key, value in status.values.items()]
        made.append(
            _make("diagnostic_msgs/msg/DiagnosticStatus", status.level, status.name, status.message, hardware, values)
        )
    return _serialized(_make(DIAGNOSTICS, _header("", t_ns), made))
