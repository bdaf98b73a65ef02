"""The server for Foxglove against a real WebSocket client."""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any

import msgspec
import pytest

from fusiond.config.outputs import Foxglove
from fusiond.messages.codec import encode
from fusiond.messages.types import EventMessage, InnovationMessage, StateMessage
from fusiond.units import SECOND
from fusiond_adapters.foxglove.converter import LOG, POSE, TOPICS, channels
from tests.helpers.drive import messages, settings
from tests.helpers.foxglove import states
from tests.helpers.network import DEADLINE
from tests.helpers.serving import serving


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
            channels_sent = {one["topic"]: one for one in json.loads(peer.recv(DEADLINE))["channels"]}
            assert {(c.topic, c.schema_name, c.schema.decode()) for c in channels(settings())} == {
                (one["topic"], one["schemaName"], one["schema"]) for one in channels_sent.values()
            }
            wanted = {7: TOPICS[StateMessage], 8: POSE, 9: LOG}
            subscriptions = [{"id": number, "channelId": channels_sent[topic]["id"]} for number, topic in wanted.items()]
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
    t_ns, published_state = got[TOPICS[StateMessage]]
    assert published_state == encode(sent[t_ns], "json")
    assert json.loads(got[LOG][1])["message"] == event.text
    assert json.loads(got[POSE][1])["frame_id"] == "local_enu"
    assert server.url is None and server.counts()["records"] >= 5 and server.counts()["clients"] == 1


def test_a_topic_that_it_does_not_have_is_counted() -> None:
    server = server_of()
    stray = InnovationMessage(vehicle="tested", source="imu0", t_ns=1, t_receive_ns=2, outcome="invalid",
                              test_ratio=None, innovation=(), variance=())  # fmt: skip
    with serving(server) as lost:
        server.outbox.put(stray)
        server.outbox.put(states()[-1])
        until(lambda: server.counts()["records"] > 0)
    assert not lost and server.counts()["unknown topics"] == 1


def test_a_port_in_use_is_reported_and_tried_again() -> None:
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
        channels_sent = json.loads(peer.recv(DEADLINE))["channels"]
        subscriptions = [{"id": number, "channelId": one["id"]} for number, one in enumerate(channels_sent)]
        peer.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        for _ in range(rounds):  # 10 MB in all, of which the peer reads nothing
            for message in states():
                server.outbox.put(message)
            until(lambda: server.outbox.latency.count == server.outbox.offered - server.outbox.dropped)
    assert server.outbox.offered == rounds * len(states()) and server.outbox.dropped == 0


def test_a_page_of_a_foreign_site_is_refused() -> None:
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    from websockets.exceptions import InvalidStatus  # noqa: PLC0415

    server = server_of()
    with serving(server):
        for origin in ("https://evil.example", "null", "http://127.0.0.1:8765"):
            with pytest.raises(InvalidStatus, match="HTTP 403"):
                client.connect(server.url, subprotocols=["foxglove.sdk.v1"], origin=origin, open_timeout=DEADLINE)
        for origin in (None, "https://app.foxglove.dev", "file://"):
            with client.connect(server.url, subprotocols=["foxglove.sdk.v1"], origin=origin, open_timeout=DEADLINE) as peer:
                assert json.loads(peer.recv(DEADLINE))["name"] == "fusiond tested"
        assert (server.counts()["clients"], server.counts()["refused"]) == (3, 3)


def until(condition: Callable[[], bool]) -> None:
    """Wait until something holds."""
    for _ in range(int(DEADLINE * 100)):
        if condition():
            return
        Event().wait(0.01)
    raise AssertionError("not reached")
