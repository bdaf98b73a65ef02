"""Foxglove: schemas that it can read, the layout, the live server against a real WebSocket client."""

from __future__ import annotations

import importlib
import json
import math
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

import msgspec
import pytest

from fusiond.config.explain import description
from fusiond.config.schema import Foxglove, Mcap, Prometheus
from fusiond.config.toml import ConfigError
from fusiond.messages import EventMessage, HealthMessage, InnovationMessage, State, StateMessage, encode
from fusiond.ports.outputs import OutputLost
from fusiond_adapters.foxglove import layout as foxglove_layout
from fusiond_adapters.foxglove.converter import FOXGLOVE, LOG, POSE, TOPICS, Converter, channels, innovations_topic
from tests.helpers.drive import messages, settings
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"
DEADLINE = 15.0  # s
SECOND = 1_000_000_000  # ns
PLAIN = {"number", "integer", "string", "boolean"}


def states() -> list[StateMessage]:
    return [message for message in messages() if isinstance(message, StateMessage) and message.state is not None]


# --- Schemas and layout


def check(schema: dict[str, Any], where: str) -> None:
    """What Foxglove's parser of JSON Schema accepts: one type for each field, objects with their fields, nothing else."""
    assert schema["type"] == "object" and not {"$ref", "anyOf", "$defs"} & schema.keys(), where
    for name, field in schema["properties"].items():
        inner = field["items"] if field["type"] == "array" else field
        if inner["type"] == "object":
            check(inner, f"{where}.{name}")
        else:
            assert inner["type"] in PLAIN, f"{where}.{name}"


def fields(schema: dict[str, Any], path: str) -> dict[str, Any]:
    """The schema at a message path such as `.state.sigma[0]`. KeyError where there is no such field."""
    for part in filter(None, path.split(".")):
        name, _, index = part.partition("[")
        schema = schema["properties"][name]
        schema = schema["items"] if index else schema
    return schema


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


def test_the_documented_layout_fits_the_demo_and_its_paths_exist() -> None:
    from fusiond.app.demo import demo  # noqa: PLC0415
    from fusiond.config import load as config  # noqa: PLC0415

    car = config.load(demo.DRIVE / "fusiond.toml")
    text = (DOCS / "foxglove-layout.json").read_text()
    assert text == foxglove_layout.text(car), "write it anew: python -m fusiond_adapters.foxglove.layout CONFIG"
    layout = json.loads(text)
    schemas = {channel.topic: json.loads(channel.schema) for channel in channels(car)}

    def panels(part: str | dict[str, Any]) -> Iterator[str]:
        if isinstance(part, str):
            yield part
        else:
            yield from panels(part["first"])
            yield from panels(part["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    for panel in layout["configById"].values():
        for path in panel.get("paths", []):
            topic, dot, rest = path["value"].partition(".")
            assert fields(schemas[topic], dot + rest)["type"] in PLAIN
        named = [panel[key] for key in ("followTopic", "topicToRender", "topicPath") if key in panel]
        assert all(topic in schemas for topic in [*named, *panel.get("topics", {})])
    ratios = {path["value"] for path in layout["configById"]["Plot!ratios"]["paths"]}
    assert ratios == {f"{innovations_topic(source)}.test_ratio" for source in car.sources() if source != "imu0"}


def test_the_layout_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert foxglove_layout.main([str(tmp_path / "none.toml")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert foxglove_layout.main([]) == 2


# --- Frames


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


def test_no_state_no_pose() -> None:
    message = msgspec.structs.replace(states()[0], state=None)
    assert [record.topic for record in Converter().records(message)] == [TOPICS[StateMessage]]


# --- The server


@contextmanager
def serving(server: Any) -> Iterator[list[OutputLost]]:
    """A session in a thread, and what it raised."""
    stop, opened, lost = Event(), Event(), list[OutputLost]()
    server.outbox.attend(lambda: 0, opened.set)

    def run() -> None:
        try:
            server.session(stop)
        except OutputLost as error:
            lost.append(error)
            opened.set()

    thread = Thread(target=run)
    thread.start()
    try:
        assert opened.wait(DEADLINE)
        yield lost
    finally:
        stop.set()
        server.outbox.rouse()
        thread.join(DEADLINE)
        assert not thread.is_alive()


def server_of(port: int = 0) -> Any:
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    from fusiond_adapters.foxglove.server import FoxgloveServer  # noqa: PLC0415

    section = Foxglove(enabled=True, port=port, rate_hz=None)
    return FoxgloveServer(msgspec.structs.replace(settings(), foxglove=section))


def received(peer: Any) -> Iterator[bytes]:
    """What has come to a client, and comes within a tenth of a second."""
    while True:
        try:
            data = peer.recv(0.1)
        except TimeoutError:
            return
        assert isinstance(data, bytes)
        yield data


def test_a_client_gets_the_states_and_events() -> None:
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    server = server_of()
    state = states()[-1]
    event = next(message for message in messages() if isinstance(message, EventMessage))
    with serving(server) as lost:
        assert not lost and server.notes() == {"url": server.url}
        with client.connect(server.url, subprotocols=["foxglove.sdk.v1"], open_timeout=DEADLINE) as peer:
            assert json.loads(peer.recv(DEADLINE))["name"] == "fusiond tested"
            told = {one["topic"]: one for one in json.loads(peer.recv(DEADLINE))["channels"]}
            assert {(c.topic, c.schema_name, c.schema.decode()) for c in channels(settings())} == {
                (one["topic"], one["schemaName"], one["schema"]) for one in told.values()
            }
            wanted = {7: TOPICS[StateMessage], 8: POSE, 9: LOG}
            subscriptions = [{"id": number, "channelId": told[topic]["id"]} for number, topic in wanted.items()]
            peer.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
            got: dict[str, tuple[int, bytes]] = {}
            sent: dict[int, StateMessage] = {}
            ends = time.monotonic() + DEADLINE
            while len(got) < len(wanted) and time.monotonic() < ends:  # until the server has taken note of all of it
                state = msgspec.structs.replace(state, t_ns=state.t_ns + SECOND)  # what comes sooner is left out
                sent[state.t_ns] = state
                server.outbox.put(state)
                server.outbox.put(event)
                for data in received(peer):
                    kind, number, t_ns = struct.unpack_from("<BIQ", data)
                    assert kind == 1
                    got[wanted[number]] = t_ns, data[13:]
    t_ns, told_state = got[TOPICS[StateMessage]]
    assert told_state == encode(sent[t_ns], "json")
    assert json.loads(got[LOG][1])["message"] == event.text
    assert json.loads(got[POSE][1])["frame_id"] == "local_enu"
    assert server.url is None and server.counts()["records"] >= 5


def test_a_topic_that_it_does_not_have_is_counted() -> None:
    server = server_of()
    stray = InnovationMessage(vehicle="tested", source="imu0", t_ns=1, t_receive_ns=2, outcome="invalid",
                              test_ratio=None, innovation=(), variance=())  # fmt: skip
    with serving(server) as lost:
        server.outbox.put(stray)
        server.outbox.put(states()[-1])
        until(lambda: server.counts()["records"] > 0)
    assert not lost and server.counts()["unknown topics"] == 1


def test_a_taken_port_is_told_and_tried_again() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        server = server_of(taken.getsockname()[1])
        with serving(server) as lost:
            assert "Address already in use" in str(lost[0]) and server.about in str(lost[0])
    with serving(server) as lost:
        assert not lost and server.url is not None


def test_a_client_that_does_not_read_holds_up_nothing() -> None:
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    server, rounds = server_of(), 8
    with (
        serving(server),
        client.connect(server.url, subprotocols=["foxglove.sdk.v1"], max_queue=1, close_timeout=0.1) as peer,
    ):
        peer.recv(DEADLINE)
        told = json.loads(peer.recv(DEADLINE))["channels"]
        subscriptions = [{"id": number, "channelId": one["id"]} for number, one in enumerate(told)]
        peer.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        for _ in range(rounds):  # 10 MB in all, of which the peer reads nothing
            for message in states():
                server.outbox.put(message)
            until(lambda: server.outbox.latency.count == server.outbox.offered - server.outbox.dropped)
    assert server.outbox.offered == rounds * len(states()) and server.outbox.dropped == 0


def until(condition: Callable[[], bool]) -> None:
    """Wait until something holds."""
    for _ in range(int(DEADLINE * 100)):
        if condition():
            return
        Event().wait(0.01)
    raise AssertionError("not reached")


# --- Without the extras


@pytest.mark.parametrize(
    ("adapter", "library"), [("mcap", "mcap"), ("foxglove.server", "foxglove"), ("prometheus", "prometheus_client")]
)
def test_a_missing_extra_is_named(adapter: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, f"fusiond_adapters.{adapter}", raising=False)
    with pytest.raises(ConfigError, match=rf"pip install 'fusiond\[{adapter.removesuffix('.server')}\]'"):
        importlib.import_module(f"fusiond_adapters.{adapter}")


def test_check_tells_what_is_on() -> None:
    tables = {"mcap": Mcap(folder="out"), "foxglove": Foxglove(enabled=True), "prometheus": Prometheus(enabled=True)}
    on = "\n".join(description(msgspec.structs.replace(settings(), **tables)))
    off = "\n".join(description(settings()))
    for told in ("ws://127.0.0.1:8765", "http://127.0.0.1:9464/metrics", "1024 MB at most"):
        assert told in on and told not in off
