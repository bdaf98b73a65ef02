"""The engine: one way in, ticks in two steps, messages in order."""

from __future__ import annotations

from itertools import pairwise

import pytest

from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.events import Received
from fusiond.messages import HealthMessage, InnovationMessage, Message, SettledMessage, StateMessage
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.drive import LOGS, folder, messages, settings

RATE = 50.0  # Hz


@pytest.fixture(scope="module")
def setup() -> Config:
    return settings()


@pytest.fixture(scope="module")
def events() -> list[Received]:
    return list(open_logs([str(folder() / log) for log in LOGS], settings()))


def test_the_state_goes_first_and_the_rest_with_flush(setup: Config, events: list[Received]) -> None:
    sent: list[Message] = []
    engine = Engine(setup, sent.append, rate_hz=RATE)
    engine.feed(events[0])
    assert not sent and not engine.unfinished
    engine.elapse(events[0].t_receive_ns)
    assert [type(message) for message in sent] == [StateMessage] and engine.unfinished
    engine.flush()
    assert HealthMessage in {type(message) for message in sent} and not engine.unfinished
    count = len(sent)
    engine.flush()  # nothing is left
    assert len(sent) == count


def test_what_was_not_flushed_goes_before_anything_else_is_done(setup: Config, events: list[Received]) -> None:
    order: list[str] = []
    engine = Engine(setup, lambda message: order.append(type(message).__name__), rate_hz=RATE)
    receive = engine.fusion.feed

    def noted(event: Received) -> object:
        order.append("event")
        return receive(event)

    engine.fusion.feed = noted  # type: ignore[method-assign, assignment]
    for event in events[:400]:
        engine.feed(event)
    assert {after for before, after in pairwise(order) if before == "event"} == {"event", "StateMessage"}
    assert {"InnovationMessage", "HealthMessage"} <= {before for before, after in pairwise(order) if after == "event"}


def test_flushing_early_or_late_changes_no_message(setup: Config, events: list[Received]) -> None:
    sent: list[Message] = []
    engine = Engine(setup, sent.append, rate_hz=RATE)
    for number, event in enumerate(events):
        engine.feed(event)
        if number % 3:
            engine.flush()
        elif number % 2:
            engine.prepare()
    engine.finish()
    assert tuple(sent) == messages()
    assert {type(message) for message in sent} >= {StateMessage, SettledMessage, InnovationMessage, HealthMessage}


def test_only_states_are_the_same_states(setup: Config, events: list[Received]) -> None:
    sent: list[Message] = []
    engine = Engine(setup, sent.append, rate_hz=RATE, only_states=True)
    for event in events:
        engine.feed(event)
    engine.finish()
    assert sent == [message for message in messages() if isinstance(message, StateMessage)]


def test_time_passes_for_an_event_that_is_kept_out(setup: Config, events: list[Received]) -> None:
    sent: list[Message] = []
    engine = Engine(setup, sent.append, rate_hz=RATE)
    for event in events:
        engine.advance(event.t_receive_ns)
    engine.finish()
    states = [message.t_ns for message in sent if isinstance(message, StateMessage)]
    assert states == [message.t_ns for message in messages() if isinstance(message, StateMessage)]
    assert sum(engine.fusion.totals().values()) == 0


def test_without_a_sink_there_are_no_ticks(setup: Config, events: list[Received]) -> None:
    engine = Engine(setup, None)
    for event in events[:1000]:
        engine.feed(event)
    engine.finish()
    assert engine.ticks == 0 and not engine.unfinished
    assert engine.elapsed_ns > 0


def test_the_pace_is_kept_with_nothing_held_back(setup: Config, events: list[Received]) -> None:
    """While it sleeps before a tick or an event, all of the last tick has gone out."""
    held: list[bool] = []
    engine = Engine(setup, lambda _: None, rate_hz=RATE, pace=lambda _: held.append(engine.unfinished))
    for event in events[:500]:
        engine.feed(event)
    assert len(held) > 500 and not any(held)
