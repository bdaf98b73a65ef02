"""Zenoh as an output: messages queued before a session, states sent at once, patience, and its counts."""

from __future__ import annotations

from threading import Event, Thread

import pytest

from fusiond.app.client import Client
from fusiond.messages.types import EventMessage
from fusiond_adapters.zenoh.output import ZenohOutput
from tests.helpers.estimates import random_messages as states
from tests.helpers.network import DEADLINE
from tests.helpers.ros2 import health
from tests.helpers.zenoh import endpoint, event, publishing, settings


@pytest.mark.parametrize(("patience_s", "stale"), [(0.0, 3), (1.0, 0)])
def test_old_states_are_not_sent_unless_the_output_may_wait(patience_s: float, stale: int) -> None:
    output, stop, opened = ZenohOutput(settings(endpoint())), Event(), Event()
    output.outbox.patience_s = patience_s
    for message in [*states(3), event("queued")]:
        output.outbox.put(message)
    output.outbox.attend(lambda: 0, opened.set)
    stop.set()  # it ends as soon as its outbox is empty
    thread = Thread(target=output.session, args=(stop,))
    thread.start()
    thread.join(DEADLINE)
    assert opened.is_set() and not thread.is_alive()
    counts = output.counts()
    assert (counts["sent"], counts["stale"], counts["sessions"]) == (4 - stale, stale, 1)
    assert output.notes() == {"session": "closed"}
    assert output.outbox.at_once is None


def test_a_state_is_sent_in_the_thread_that_puts_it() -> None:
    where, published = endpoint(), states(2)
    with publishing(settings(where)) as output, Client(where, "rover") as client:
        heard = client.stream(EventMessage, DEADLINE)
        output.outbox.put(event("open"))
        assert next(heard) == event("open")
        before = output.sent
        for message in published:
            output.outbox.put(message)
            assert output.outbox.waiting == 0
        assert output.sent == before + 2
        assert client.state_at(published[1].t_ns) == published[1]


def test_clients_are_counted_among_those_connected() -> None:
    where = endpoint()
    with publishing(settings(where)) as output, Client(where, "rover"), Client(where, "rover") as client:
        heard = client.stream(EventMessage, DEADLINE)
        for text in ("one", "two"):
            output.outbox.put(event(text))
            assert next(heard) == event(text)
            output.outbox.put(health())  # makes the output count
        output.outbox.put(event("three"))
        assert next(heard) == event("three")
        assert output.notes() == {"session": "0 routers, 0 peers, 2 clients connected"}
