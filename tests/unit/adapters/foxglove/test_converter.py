"""Messages for Foxglove: schemas that it can read, and poses in its frames."""

from __future__ import annotations

import json
import math
from typing import Any

import msgspec
import pytest

from fusiond.messages.types import EventMessage, HealthMessage, State, StateMessage
from fusiond_adapters.foxglove.converter import FOXGLOVE, POSE, TOPICS, TRAIL, TRAIL_POINTS, Converter, channels
from tests.helpers.drive import messages, settings
from tests.helpers.foxglove import PLAIN, fields, states


def check(schema: dict[str, Any], where: str) -> None:
    """What Foxglove's parser of JSON Schema accepts: one type for each field, objects with their fields, nothing else."""
    assert schema["type"] == "object" and not {"$ref", "anyOf", "$defs"} & schema.keys(), where
    for name, field in schema["properties"].items():
        inner = field["items"] if field["type"] == "array" else field
        if inner["type"] == "object":
            check(inner, f"{where}.{name}")
        else:
            assert inner["type"] in PLAIN, f"{where}.{name}"


def test_foxglove_can_read_every_schema() -> None:
    found = {channel.topic: channel for channel in channels(settings())}
    assert len(found) == len(channels(settings()))
    for channel in found.values():
        check(json.loads(channel.schema), channel.topic)
    health = json.loads(found[TOPICS[HealthMessage]].schema)
    assert fields(health, ".sources.imu0.clock.jitter_ms")["type"] == "number"
    assert "imu0" not in {topic.rpartition("/")[2] for topic in found}


def test_every_message_fits_its_schema() -> None:
    schemas = {channel.topic: json.loads(channel.schema) for channel in channels(settings())}
    kinds = {"number": (int, float), "integer": int, "string": str, "boolean": bool, "object": dict, "array": list}

    def fit(value: Any, schema: dict[str, Any], where: str) -> None:
        assert value is None or isinstance(value, kinds[schema["type"]]), where
        for inner in value if isinstance(value, list) else ():
            fit(inner, schema["items"], where)
        if isinstance(value, dict) and schema["properties"]:  # of a table by any names it says nothing
            for name, inner in value.items():
                fit(inner, schema["properties"][name], f"{where}.{name}")

    converter = Converter()
    seen = set()
    for message in messages():
        for record in converter.records(message):
            fit(json.loads(record.data), schemas[record.topic], record.topic)
            seen.add(record.topic)
    assert seen == schemas.keys()


def test_foxgloves_own_types_take_what_is_written() -> None:
    sdk = pytest.importorskip("foxglove.messages", reason="the extra foxglove is not installed")
    converter, seen = Converter(), set()
    made = {"timestamp": lambda value: sdk.Timestamp(value["sec"], value["nsec"])}
    made |= dict.fromkeys(("position", "translation", "velocity"), lambda value: sdk.Vector3(**value))
    made |= dict.fromkeys(("orientation", "rotation"), lambda value: sdk.Quaternion(**value))
    made |= {"pose": lambda value: sdk.Pose(**converted(value))}
    made |= {"poses": lambda values: [sdk.Pose(**converted(value)) for value in values]}
    made |= {"level": lambda value: [sdk.LogLevel.Info, sdk.LogLevel.Warning, sdk.LogLevel.Error][value - 2]}
    made |= {"position_covariance_type": {3: sdk.LocationFixPositionCovarianceType.Known}.__getitem__}

    def converted(content: dict[str, Any]) -> dict[str, Any]:
        return {name: made.get(name, lambda value: value)(value) for name, value in content.items()}

    for message in [*(m for m in messages() if isinstance(m, EventMessage)), *states()[:50]]:
        for record in converter.records(message):
            if record.topic in FOXGLOVE:
                kind = getattr(sdk, FOXGLOVE[record.topic].__name__)
                assert kind(**converted(json.loads(record.data))).encode()  # an unknown field is a TypeError
                seen.add(record.topic)
    assert seen == FOXGLOVE.keys()


def shown(converter: Converter, message: StateMessage) -> dict[str, dict[str, Any]]:
    return {record.topic: json.loads(record.data) for record in converter.records(message)}


def placed(message: StateMessage, **change: Any) -> StateMessage:
    assert message.state is not None
    state: State = msgspec.structs.replace(message.state, **change)
    return msgspec.structs.replace(message, t_ns=message.t_ns + 1_000_000_000, state=state)


def test_far_from_the_origin_up_is_not_the_origins_up() -> None:
    """100 km north the earth has fallen away, and a level vehicle that faces north is nose down in the origin's frame."""
    first = placed(states()[-1], lat_deg=48.0, lon_deg=11.0, height_m=500.0, quaternion_nb=(1.0, 0.0, 0.0, 0.0))
    converter = Converter()
    near = shown(converter, first)[POSE]["pose"]
    assert near["position"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    half = math.copysign(math.sqrt(0.5), near["orientation"]["w"])  # facing north: forward is +y
    assert near["orientation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": half, "w": half}, abs=1e-12)
    far = shown(converter, placed(first, lat_deg=48.9))[POSE]["pose"]
    radius = 6.37e6
    assert far["position"]["y"] == pytest.approx(radius * math.sin(math.radians(0.9)), rel=2e-3)
    assert far["position"]["z"] == pytest.approx(-radius * (1 - math.cos(math.radians(0.9))), rel=1e-2)
    x, y, z, w = (far["orientation"][axis] for axis in "xyzw")
    forward_z = 2 * (x * z - w * y)  # of the body's forward axis
    assert forward_z == pytest.approx(-math.sin(math.radians(0.9)), rel=1e-6)


def test_the_trail_is_where_the_body_was() -> None:
    """At 10 m/s to the north: each second all points of the last 600 m, 2 m apart, and the present one."""
    first, converter = placed(states()[-1], lat_deg=48.0, lon_deg=11.0, height_m=500.0), Converter()
    trails: list[list[float]] = []
    for number in range(4000):
        state = msgspec.structs.replace(placed(first, lat_deg=48.0 + math.degrees(number * 0.2 / 6.367e6)),
                                        t_ns=first.t_ns + number * 20_000_000)  # fmt: skip
        found = shown(converter, state).get(TRAIL)
        if found is not None:
            trails.append([pose["position"]["y"] for pose in found["poses"]])
    assert len(trails) == pytest.approx(80, abs=1)  # in 80 s
    assert len(trails[10]) == pytest.approx(5 * 10, abs=6) and len(trails[-1]) == TRAIL_POINTS + 1
    assert trails[-1] == sorted(trails[-1]) and trails[-1][-2] - trails[-1][0] == pytest.approx(2.0 * 299, rel=0.15)


def test_no_state_no_pose() -> None:
    message = msgspec.structs.replace(states()[0], state=None)
    assert [record.topic for record in Converter().records(message)] == [TOPICS[StateMessage]]
