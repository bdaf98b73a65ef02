"""The outbox of an output: bounded, counted, and opened once."""

from __future__ import annotations

from fusiond.messages.types import ConfigMessage, EventMessage, Message
from fusiond.ports.outputs import Outbox


def event(text: str) -> EventMessage:
    return EventMessage(vehicle="v", t_ns=1, kind="mode", severity="info", subject="", text=text)


def test_a_full_outbox_drops_the_oldest_and_counts() -> None:
    outbox = Outbox(3, (EventMessage,))
    for number in range(5):
        outbox.put(event(str(number)))
    outbox.put(ConfigMessage(vehicle="v", config={}))  # not wanted
    assert (outbox.offered, outbox.dropped) == (5, 2)
    assert [message.text for message in outbox.take(0) if isinstance(message, EventMessage)] == ["2", "3", "4"]
    assert outbox.take(0) == []


def test_an_outbox_tells_once_that_it_is_attended() -> None:
    outbox = Outbox(3, (Message,))
    outbox.attend(lambda: 5, lambda: outbox.put(event("hello")))
    assert [outbox.take(0), outbox.take(0)] == [[event("hello")], []]
