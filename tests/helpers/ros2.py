"""Messages for the tests of the ROS 2 output, the type definitions of rosbags, and ROS 2 itself as a reader."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from typing import Any

from rosbags.typesys import Stores, get_typestore

from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, InputHealth, LatencyHealth, OutcomeCounts, SourceHealth, StateMessage
from fusiond.units import SECOND
from tests.helpers.estimates import random_state
from tests.helpers.network import DEADLINE
from tests.helpers.paths import ROOT

STORE = get_typestore(Stores.ROS2_JAZZY)
ROS_PYTHON = ROOT / "build" / "ros" / "bin" / "python"  # with ROS 2's wheels, by `make ros`
T0 = 1_700_000_000 * SECOND


def state_numbered(number: int = 1, mode: Mode = Mode.NOMINAL, **given: Any) -> StateMessage:
    values: dict[str, Any] = {"state": random_state(number), "age_ms": 1.0, "resets": 0, **given}
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
        reset_reason="gnss.position: rejected for too long" if resets else None,
        outcomes=OutcomeCounts(fused=10, rejected=2),
        latency_ms=LatencyHealth(),
        sources={
            "gnss.position": SourceHealth(outcomes=OutcomeCounts(fused=4), present=True, age_ms=3.0, rate_hz=5.0),
            "wheel": SourceHealth(outcomes=OutcomeCounts(), present=False),
        },
        inputs={"mavlink.fc": InputHealth(received=100, dropped=dropped, counts={"bad": 1})},
        outputs={},
    )


def definitions(kind: str) -> tuple[str, dict[str, str]]:
    """The .msg text of a type, and of those inside it."""
    first, *rest = STORE.generate_msgdef(kind, ros_version=2)[0].split("=" * 80 + "\n")
    inside = (part.split("\n", 1) for part in rest)
    return first, {name.removeprefix("MSG: ").replace("/", "/msg/"): text for name, text in inside}


# --- ROS 2 itself

ROS_READER = """
import importlib, json, sys
from pathlib import Path
from rclpy.serialization import deserialize_message, serialize_message

def plain(value):
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, (str, int, float)):
        return value
    return [plain(inner) for inner in value]

for kind, payload in json.load(sys.stdin):
    package, _, name = kind.split("/")
    message = deserialize_message(bytes.fromhex(payload), getattr(importlib.import_module(package + ".msg"), name))
    described = json.loads(Path(sys.prefix, "share", package, "msg", name + ".json").read_text())
    (found,) = [one["hash_string"] for one in described["type_hashes"] if one["type_name"] == kind]
    print(json.dumps([found, plain(message), serialize_message(message).hex()]))
"""


def read_by_ros(messages: Sequence[tuple[str, bytes]]) -> list[tuple[str, dict[str, Any], bytes]]:
    """Type and CDR of messages, read by ROS 2's own code: the type's hash, the content, and CDR written again from it."""
    asked = json.dumps([[kind, payload.hex()] for kind, payload in messages])
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [ROS_PYTHON, "-c", ROS_READER],
        input=asked, env=environment, capture_output=True, text=True, timeout=2 * DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    return [(type_hash, content, bytes.fromhex(again)) for type_hash, content, again in answers]
