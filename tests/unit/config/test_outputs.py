"""The sections of the outputs: names that ROS 2 accepts, limits, and outputs that are off by default."""

from __future__ import annotations

import pytest

from fusiond.config import load as config
from tests.helpers.complaints import BASE, check


@pytest.mark.parametrize(
    ("line", "key", "part"),
    [
        ('namespace = "rover"', "ros2.namespace", "must be a slash, or names that each follow a slash"),
        ('namespace = "/rover/"', "ros2.namespace", "must be a slash, or names that each follow a slash"),
        ('map_frame = "/map"', "ros2.map_frame", "must be a name without blanks"),
        ('map_frame = ""', "ros2.map_frame", "must be a name without blanks"),
        ("domain = 233", "ros2.domain", "<= 232"),
    ],
)
def test_names_and_numbers_that_ros_2_does_not_accept(line: str, key: str, part: str) -> None:
    check(f"{BASE}[ros2]\n{line}\n", 5, key, part)


@pytest.mark.parametrize("namespace", ["/", "/rover", "/fleet/rover_1"])
def test_namespaces_of_ros_2(namespace: str) -> None:
    assert config.parse(f'{BASE}[ros2]\nnamespace = "{namespace}"\n').ros2.namespace == namespace


def test_outputs_are_off_by_default_but_for_zenoh_on_loopback() -> None:
    loaded = config.parse(BASE)
    assert not (loaded.foxglove.enabled or loaded.ros2.enabled or loaded.prometheus.enabled)
    assert loaded.mcap.folder is loaded.record.folder is None
    assert loaded.autopilot.link is loaded.ground_station.link is loaded.ground_station.connection is None
    assert (loaded.zenoh.listen, loaded.zenoh.multicast_scouting) == (["tcp/127.0.0.1:7447"], False)
