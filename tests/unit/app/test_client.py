"""The client: typed messages by subscription and query, from a real session."""

from __future__ import annotations

import select
from threading import Event
from typing import Literal

import pytest
import zenoh

from fusiond.app.client import Client, ClientError
from fusiond.config.outputs import Encoding
from fusiond.estimator.solution import Mode
from fusiond.messages.types import (
    ConfigMessage,
    EventMessage,
    HealthMessage,
    InfoMessage,
    LatencyHealth,
    OutcomeCounts,
    StateMessage,
)
from fusiond.units import SECOND
from tests.helpers.estimates import random_messages as states
from tests.helpers.network import DEADLINE, python, read_line
from tests.helpers.paths import ROOT
from tests.helpers.zenoh import endpoint, event, publishing, sees, settings

CONFIG = ConfigMessage(vehicle="rover", config={"vehicle": {"name": "rover"}})
HEALTH = HealthMessage(
    vehicle="rover", t_ns=1, version="1", uptime_s=1.0, mode=Mode.NOMINAL, resets=0, outcomes=OutcomeCounts(fused=5),
    latency_ms=LatencyHealth(), sources={}, inputs={}, outputs={},
)  # fmt: skip
INFO = InfoMessage(
    vehicle="rover", version="1", kernel="numpy", encoding="json", schemas={}, keys={}, sources={"imu0": "imu"}, config={}
)


@pytest.mark.parametrize(("encoding", "mode"), [("json", "peer"), ("msgpack", "router")])
def test_queries_return_what_was_published(encoding: Encoding, mode: Literal["peer", "router"]) -> None:
    where, published = endpoint(), states(30)
    with publishing(settings(where, encoding, mode), INFO, CONFIG) as output, Client(where, "rover") as client:
        heard = client.stream(EventMessage, DEADLINE)
        output.outbox.put(event("now"))
        assert next(heard) == event("now")  # so the earlier messages have been kept too
        for message in published:
            output.outbox.put(message)
        output.outbox.put(event("then"))
        assert next(heard) == event("then")
        assert (client.info(), client.config(), client.latest(StateMessage)) == (INFO, CONFIG, published[-1])
        assert sees(client, "rover")
        for message in published:
            assert client.state_at(message.t_ns) == message
        between = published[7].t_ns + 4_000_000
        assert client.state_at(between) == published[7]
        for t_ns in (published[0].t_ns - SECOND, published[-1].t_ns + SECOND):
            with pytest.raises(ClientError, match="no state was published about then"):
                client.state_at(t_ns)
        with pytest.raises(ClientError, match="no answer"):
            client.health()  # none was published
        assert output.counts()["sent"] == len(published) + 4 and client.undecodable == 0


def test_a_late_subscriber_gets_rare_messages_at_once_and_of_a_stream_only_new_ones() -> None:
    where, published = endpoint(), states(3)
    with (
        publishing(settings(where), *published[:2], INFO, event("one"), event("two")) as output,
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
                output.outbox.put(published[2])
                if came.wait(0.1):
                    break
        assert set(map(type, got)) == {StateMessage} and got[0] == published[2]


def test_samples_that_are_no_message_are_counted_and_ignored() -> None:
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


def test_an_endpoint_without_fusiond_is_an_error_that_names_it() -> None:
    where = endpoint()
    with pytest.raises(ClientError, match=where):
        Client(where, "rover")


def test_the_documented_client_works() -> None:
    """As printed, except for the port."""
    text = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    where, published = endpoint(), states(2)[1]
    code = text.split("```python\n")[1].split("```")[0].replace("tcp/127.0.0.1:7447", where)
    with publishing(settings(where), INFO, HEALTH) as output, python(f"{code}\n") as reader:
        assert read_line(reader) == "1 nominal"
        assert read_line(reader).startswith("OutcomeCounts(fused=5,")
        for _ in range(100):  # until the subscription has reached the publisher
            output.outbox.put(published)
            if reader.stdout is not None and select.select([reader.stdout], [], [], 0.1)[0]:
                break
        assert published.state is not None
        assert read_line(reader) == f"{published.t_ns} nominal {published.state.lat_deg}"


def test_closing_twice_does_nothing() -> None:
    where = endpoint()
    with publishing(settings(where)):
        client = Client(where, "rover")
        client.close()
        client.close()
