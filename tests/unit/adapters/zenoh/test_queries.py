"""Answers to Zenoh queries: the latest messages, states within the horizon, and wrong queries."""

from __future__ import annotations

import threading
import time

import pytest

from fusiond.app.client import Client, ClientError
from fusiond.messages.types import ConfigMessage, EventMessage, InfoMessage, InnovationMessage
from fusiond_adapters.zenoh.queries import Answers
from tests.helpers.estimates import random_messages as states
from tests.helpers.network import DEADLINE
from tests.helpers.zenoh import endpoint, event, publishing, settings

CONFIG = ConfigMessage(vehicle="rover", config={"vehicle": {"name": "rover"}})
INFO = InfoMessage(
    vehicle="rover", version="1", kernel="numpy", encoding="json", schemas={}, keys={}, sources={"imu0": "imu"}, config={}
)


def test_the_nearest_state_is_at_most_a_period_away() -> None:
    answers, published = Answers(settings("tcp/127.0.0.1:1")), states(3)
    assert answers.state_at(published[0].t_ns) is None
    for message in published:
        answers.keep(message)
    period_ns = published[1].t_ns - published[0].t_ns
    assert period_ns == 20_000_000  # 50 Hz
    assert answers.state_at(published[1].t_ns + 9_000_000) == published[1]
    assert answers.state_at(published[1].t_ns + 11_000_000) == published[2]
    assert answers.state_at(published[2].t_ns + period_ns) == published[2]
    assert answers.state_at(published[2].t_ns + period_ns + 1) is None


def test_states_are_kept_for_the_horizon() -> None:
    where, published = endpoint(), states(80)
    with publishing(settings(where)) as output, Client(where, "rover") as client:
        for message in [*published, event("done")]:
            output.outbox.put(message)
        assert next(client.stream(EventMessage, DEADLINE)) == event("done")
        assert client.state_at(published[-51].t_ns) == published[-51]  # one second at 50 Hz
        with pytest.raises(ClientError, match="over 1 s ago"):
            client.state_at(published[-53].t_ns)


@pytest.mark.parametrize(("parameters", "why"), [("?t_ns=soon", "whole number"), ("?t_ns=-1", "whole number")])
def test_a_wrong_query_is_answered_with_the_reason(parameters: str, why: str) -> None:
    where = endpoint()
    with publishing(settings(where), CONFIG), Client(where, "rover") as client:
        (reply,) = client._session.get(f"fusiond/rover/state{parameters}", timeout=DEADLINE)
        assert reply.err is not None and why in reply.err.payload.to_string()


def test_one_query_for_everything() -> None:
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


def test_who_asks_without_end_is_answered_within_the_budget() -> None:
    """2000 queries at once: some get replies, all end, and the answers took a twentieth of the time."""
    where, published = endpoint(), states(3)
    with publishing(settings(where), *published) as output, Client(where, "rover") as client:
        output.outbox.put(event("done"))
        next(client.stream(EventMessage, DEADLINE))
        (thread,) = (one for one in threading.enumerate() if one.name == "zenoh answers")
        clock = time.pthread_getcpuclockid(thread.ident or 0)
        began, worked = time.monotonic(), time.clock_gettime(clock)
        asked = [client._session.get("fusiond/rover/**", timeout=DEADLINE) for _ in range(2000)]
        replied = sum(1 for replies in asked if any(reply.ok for reply in replies))
        took, worked = time.monotonic() - began, time.clock_gettime(clock) - worked
        assert client.state_at(published[-1].t_ns) == published[-1]
    assert 0 < replied < 2000
    assert worked < 0.1 * took + 0.01
