"""The outbox of an output: bounded, counted, and opened once."""

from __future__ import annotations

from fusiond.messages.types import ConfigMessage, EventMessage, Message, StateMessage
from fusiond.ports.outputs import Outbox
from tests.helpers.estimates import random_messages as states


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


def test_a_session_is_open_when_it_first_takes_messages() -> None:
    outbox = Outbox(3, (Message,))
    outbox.attend(lambda: 5, lambda: outbox.put(event("hello")))
    assert [outbox.take(0), outbox.take(0)] == [[event("hello")], []]


def test_a_state_is_sent_at_once_if_the_output_can_and_queued_if_it_cannot() -> None:
    first, second = states(2)
    sent: list[StateMessage] = []

    def send(state: StateMessage) -> bool:
        if able := state is first:
            sent.append(state)
        return able

    outbox = Outbox(3, (StateMessage, EventMessage))
    outbox.attend(lambda: first.t_ns + 7, lambda: None)
    outbox.at_once = send
    for message in (first, event("queued"), second):
        outbox.put(message)
    assert (sent, outbox.take(0), outbox.offered, outbox.dropped) == ([first], [event("queued"), second], 3, 0)
    assert outbox.latency.count == 2
