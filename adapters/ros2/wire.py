"""The part of rmw_zenoh's protocol that a publisher needs: keys, type hashes, liveliness tokens, attachments.

After rmw_zenoh's docs/design.md and its sources (liveliness_utils.cpp, attachment_helpers.cpp, rmw_publisher_data.cpp).
A node and its publishers are liveliness tokens that exist as long as the session. A message is a CDR payload with an
attachment; without it rmw_zenoh drops the message.
"""

from __future__ import annotations

import struct
import time
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType

import xxhash
import zenoh

NO_HASH = "TypeHashNotSupported"  # what ROS 2 Humble uses for a hash
ATTACHMENT = struct.Struct("<qqB16s")  # sequence number, source time [ns, Unix], length of the gid, gid
GID_SIZE = 16  # bytes


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic. Its QoS is reliable, volatile, keep last `depth`, otherwise rmw_zenoh's default."""

    name: str  # absolute, such as /odometry
    kind: str  # such as nav_msgs/msg/Odometry
    hash: str  # RIHS01_ and 64 hexadecimal digits, or NO_HASH
    depth: int = 10
    urgent: bool = True  # ahead of other traffic


def topic_key(domain: int, topic: Topic) -> str:
    """The Zenoh key of the messages of a topic."""
    return f"{domain}/{topic.name.strip('/')}/{dds_type(topic.kind)}/{topic.hash}"


def dds_type(kind: str) -> str:
    """nav_msgs/msg/Odometry as nav_msgs::msg::dds_::Odometry_"""
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def mangled(name: str) -> str:
    """A name with slashes as one chunk of a key."""
    return name.replace("/", "%") or "%"


def node_token(domain: int, zid: str, node_id: int, namespace: str, node: str) -> str:
    """The liveliness token of a node; `zid` is that of the session."""
    return f"@ros2_lv/{domain}/{zid}/{node_id}/{node_id}/NN/%/{mangled(namespace)}/{mangled(node)}"


def publisher_token(domain: int, zid: str, node_id: int, entity_id: int, namespace: str, node: str, topic: Topic) -> str:
    """The liveliness token of a publisher."""
    where = f"@ros2_lv/{domain}/{zid}/{node_id}/{entity_id}/MP/%/{mangled(namespace)}/{mangled(node)}"
    return f"{where}/{mangled(topic.name)}/{dds_type(topic.kind)}/{topic.hash}/{qos(topic.depth)}"


def qos(depth: int) -> str:
    """Reliability, durability, history, deadline, lifespan, liveliness; rmw_zenoh's defaults are left empty.

    The depth is always given: its default, 42, is not the same in every implementation.
    """
    return f"::,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """The global id of an entity: XXH3, 128 bits, of its liveliness token, the low half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_SIZE, "little")


class Publisher:
    """Publishes on one topic."""

    def __init__(self, publisher: zenoh.Publisher, gid: bytes) -> None:
        self._publisher, self._gid = publisher, gid
        self._sequence = 0

    def put(self, payload: bytes) -> None:
        """Send a CDR message. Raises zenoh.ZError if the session is closed."""
        self._sequence += 1
        attachment = ATTACHMENT.pack(self._sequence, time.time_ns(), GID_SIZE, self._gid)
        self._publisher.put(payload, attachment=attachment)


class Node:
    """A node in the ROS graph. A context manager that must end before its session. Raises zenoh.ZError.

    With `lossless` its publishers wait for slow readers; otherwise they drop messages for which there is no room.
    """

    def __init__(self, session: zenoh.Session, domain: int, namespace: str, name: str, *, lossless: bool = False) -> None:
        self._congestion = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self._session, self._domain, self._namespace, self._name = session, domain, namespace, name
        self._zid = str(session.info.zid())
        self._entities = 0  # declared so far; the node itself is number 0
        self._declared = ExitStack()
        self._declare_token(node_token(domain, self._zid, 0, namespace, name))

    def publisher(self, topic: Topic) -> Publisher:
        """A publisher of the node."""
        self._entities += 1
        token = publisher_token(self._domain, self._zid, 0, self._entities, self._namespace, self._name, topic)
        publisher = self._declared.enter_context(
            self._session.declare_publisher(
                topic_key(self._domain, topic),
                congestion_control=self._congestion,
                priority=zenoh.Priority.REAL_TIME if topic.urgent else zenoh.Priority.DATA,
                express=False,  # the topics of one instant are one batch; at most two batches wait, others are dropped
            )
        )
        self._declare_token(token)
        return Publisher(publisher, gid(token))

    def _declare_token(self, token: str) -> None:
        self._declared.enter_context(self._session.liveliness().declare_token(token))

    def __enter__(self) -> Node:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._declared.close()
