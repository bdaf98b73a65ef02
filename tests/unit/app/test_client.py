"""The client: typed messages by subscription and on demand, from what a real session publishes and answers."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Literal

import pytest
import zenoh

from fusiond.app.client import Client, ClientError
from fusiond.config.outputs import Encoding, Publish, Zenoh
from fusiond.config.schema import Config, Vehicle
from fusiond.estimator.solution import Mode
from fusiond.messages.types import (
    ConfigMessage,
    EventMessage,
    HealthMessage,
    InfoMessage,
    InnovationMessage,
    LatencyHealth,
    Message,
    OutcomeCounts,
    StateMessage,
)
from fusiond.ports.outputs import OutputLost
from fusiond_adapters.zenoh.output import ZenohOutput
from tests.helpers.estimates import random_messages as states
from tests.helpers.network import DEADLINE, python, read_line
from tests.helpers.paths import ROOT

CONFIG = ConfigMessage(vehicle="rover", config={"vehicle": {"name": "rover"}})
HEALTH = HealthMessage(
    vehicle="rover", t_ns=1, version="1", uptime_s=1.0, mode=Mode.NOMINAL, resets=0, outcomes=OutcomeCounts(fused=5),
    latency_ms=LatencyHealth(), sources={}, inputs={}, outputs={},
)  # fmt: skip
INFO = InfoMessage(
    vehicle="rover", version="1", kernel="numpy", encoding="json", schemas={}, keys={}, sources={"imu0": "imu"}, config={}
)


def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def settings(where: str, encoding: Encoding = "json", mode: Literal["peer", "router"] = "peer") -> Config:
    section = Zenoh(mode=mode, listen=[where])
    return Config(vehicle=Vehicle(name="rover"), zenoh=section, publish=Publish(encoding=encoding, rate_hz=50.0))


@contextmanager
def publishing(config: Config, *first: Message) -> Iterator[ZenohOutput]:
    """The output as the daemon runs it, which has published some messages."""
    output, stop, opened, ends = ZenohOutput(config), Event(), Event(), []

    def session() -> None:
        try:
            output.session(stop)
        except OutputLost as lost:
            ends.append(lost)

    output.outbox.attend(lambda: 0, opened.set)
    thread = Thread(target=session)
    thread.start()
    try:
        assert opened.wait(DEADLINE)
        for message in first:
            output.outbox.put(message)
        yield output
    finally:
        stop.set()
        output.outbox.rouse()
        thread.join(DEADLINE)
    assert not ends


def event(text: str) -> EventMessage:
    return EventMessage(vehicle="rover", t_ns=1, kind="mode", severity="info", subject="", text=text)


@pytest.mark.parametrize(("encoding", "mode"), [("json", "peer"), ("msgpack", "router")])
def test_what_is_asked_for_is_what_was_published(encoding: Encoding, mode: Literal["peer", "router"]) -> None:
    where, told = endpoint(), states(30)
    with publishing(settings(where, encoding, mode), INFO, CONFIG) as output, Client(where, "rover") as client:
        heard = client.stream(EventMessage, DEADLINE)
        output.outbox.put(event("now"))
        assert next(heard) == event("now")  # so what came before has been kept as well
        for message in told:
            output.outbox.put(message)
        output.outbox.put(event("then"))
        assert next(heard) == event("then")
        assert (client.info(), client.config(), client.latest(StateMessage)) == (INFO, CONFIG, told[-1])
        assert client.alive() == {"rover"}
        for message in told:
            assert client.state_at(message.t_ns) == message
        between = told[7].t_ns + 4_000_000
        assert client.state_at(between) == told[7]
        for t_ns, why in ((told[0].t_ns - 10**9, "no state was published about then"), (told[-1].t_ns + 10**9, "no state")):
            with pytest.raises(ClientError, match=why):
                client.state_at(t_ns)
        with pytest.raises(ClientError, match="no answer"):
            client.health()  # none was published
        assert output.counts()["sent"] == len(told) + 4 and client.undecodable == 0


def test_only_the_horizon_is_remembered() -> None:
    where, told = endpoint(), states(80)
    with publishing(settings(where)) as output, Client(where, "rover") as client:
        for message in [*told, event("done")]:
            output.outbox.put(message)
        assert next(client.stream(EventMessage, DEADLINE)) == event("done")
        assert client.state_at(told[-51].t_ns) == told[-51]  # one second at 50 Hz
        with pytest.raises(ClientError, match="over 1 s ago"):
            client.state_at(told[-53].t_ns)


@pytest.mark.parametrize(("parameters", "why"), [("?t_ns=soon", "whole number"), ("?t_ns=-1", "whole number")])
def test_a_wrong_question_is_told_so(parameters: str, why: str) -> None:
    where = endpoint()
    with publishing(settings(where), CONFIG), Client(where, "rover") as client:
        (reply,) = client._session.get(f"fusiond/rover/state{parameters}", timeout=DEADLINE)
        assert reply.err is not None and why in reply.err.payload.to_string()


def test_one_question_for_everything() -> None:
    where = endpoint()
    innovation = InnovationMessage(
        vehicle="rover", source="left", t_ns=1, t_receive_ns=2, outcome="fused", test_ratio=0.5, innovation=(0.1,),
        variance=(0.02,),
    )  # fmt: skip
    with publishing(settings(where), INFO, innovation) as output, Client(where, "rover") as client:
        output.outbox.put(event("done"))
        next(client.stream(EventMessage, DEADLINE))
        replies = client._session.get("fusiond/rover/**", timeout=DEADLINE)
        found = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        assert found == {"fusiond/rover/info", "fusiond/rover/innovations/left", "fusiond/rover/events"}
        assert client.latest(InnovationMessage) == innovation


def test_a_late_joiner_gets_the_last_at_once_and_a_stream_only_what_comes() -> None:
    where, told = endpoint(), states(3)
    with (
        publishing(settings(where), *told[:2], INFO, event("one"), event("two")) as output,
        Client(where, "rover") as first,
    ):
        heard = first.stream(EventMessage, DEADLINE)
        assert [next(heard), next(heard)] == [event("one"), event("two")]
        assert next(first.stream(InfoMessage, DEADLINE)) == INFO
        with pytest.raises(TimeoutError, match=r"no state of rover for 0\.2 s"):
            next(first.stream(StateMessage, 0.2))
        got: list[StateMessage] = []
        came = Event()

        def receive(message: StateMessage) -> None:
            got.append(message)
            came.set()

        with first.subscribed(StateMessage, receive):
            for _ in range(100):  # until the subscription has reached the publisher
                output.outbox.put(told[2])
                if came.wait(0.1):
                    break
        assert set(map(type, got)) == {StateMessage} and got[0] == told[2]


def test_what_is_no_message_is_counted_and_passed_over() -> None:
    where = endpoint()
    with publishing(settings(where)) as output, Client(where, "rover") as client:
        heard = client.stream(EventMessage, DEADLINE)
        output.outbox.put(event("one"))
        assert next(heard) == event("one")
        for payload, encoding in ((b"{", zenoh.Encoding.APPLICATION_JSON), (b"\x00", zenoh.Encoding.ZENOH_BYTES)):
            client._session.put("fusiond/rover/events", payload, encoding=encoding)
        output.outbox.put(event("two"))
        assert next(heard) == event("two")
        assert client.undecodable == 2


def test_nobody_there_is_an_error_that_names_the_endpoint() -> None:
    where = endpoint()
    with pytest.raises(ClientError, match=where):
        Client(where, "rover")


def test_the_documented_client_works() -> None:
    """As printed, but for the port and the name of the vehicle; its last words are the timeout's."""
    text = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    where, told = endpoint(), states(2)[1]
    code = text.split("```python\n")[1].split("```")[0].replace("tcp/127.0.0.1:7447", where)
    with publishing(settings(where), INFO, HEALTH) as output, python(f"{code}\n") as reader:
        assert read_line(reader) == "1 nominal"
        assert read_line(reader).startswith("OutcomeCounts(fused=5,")
        for _ in range(100):  # until the subscription has reached the publisher
            output.outbox.put(told)
            if reader.stdout is not None and select.select([reader.stdout], [], [], 0.1)[0]:
                break
        assert told.state is not None
        assert read_line(reader) == f"{told.t_ns} nominal {told.state.lat_deg}"


def test_closing_twice_is_none() -> None:
    where = endpoint()
    with publishing(settings(where)):
        client = Client(where, "rover")
        client.close()
        client.close()
