"""Keys, tokens and hashes of rmw_zenoh, against its design and zenoh-ros2-sdk."""

from __future__ import annotations

from typing import Any

import pytest

from fusiond.config.outputs import Ros2
from fusiond_adapters.ros2 import wire
from fusiond_adapters.ros2.output import topics
from tests.helpers.ros2 import (
    definitions,
)

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = wire.Topic("/chatter", "std_msgs/msg/String", STRING_HASH, 7)
ZID = "8b20917502ee955ac4476e0266340d5c"


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
    assert [name for name, _ in found] == ["odometry", "odometry/local", "fix", "twist", "/tf", "/diagnostics"]
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
