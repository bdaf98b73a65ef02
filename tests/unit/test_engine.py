"""The engine: one way in, ticks in two steps, messages in order."""

from __future__ import annotations

from itertools import pairwise

import pytest
from msgspec.structs import replace

from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.events import Received
from fusiond.messages import EventMessage, HealthMessage, InnovationMessage, Message, SettledMessage, StateMessage
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


# --- Receipts that step back


HOUR = 3600 * 10**9


def split(events: list[Received]) -> int:
    """Where 2.2 s have passed: the filter runs, and GNSS comes for another 2.3 s."""
    return next(n for n, event in enumerate(events) if event.t_receive_ns > events[0].t_receive_ns + 2_200 * 10**6)


def moved(events: list[Received], by_ns: int) -> list[Received]:
    """The same later events, on a host's clock that was set back."""
    return [replace(event, t_receive_ns=event.t_receive_ns - by_ns, sequence=event.sequence + 10**6) for event in events]


def run(setup: Config, events: list[Received]) -> tuple[Engine, list[Message]]:
    sent: list[Message] = []
    engine = Engine(setup, sent.append, rate_hz=RATE)
    for event in events:
        engine.feed(event)
    engine.finish()
    return engine, sent


def states(messages: list[Message]) -> list[StateMessage]:
    return [message for message in messages if isinstance(message, StateMessage)]


@pytest.mark.parametrize("by_ns", [300 * 10**6, 20 * 10**9, HOUR])
def test_a_new_session_loses_nothing_and_is_told_once(setup: Config, events: list[Received], by_ns: int) -> None:
    """The drive goes on while the host's clock is set back."""
    part = split(events)
    engine, sent = run(setup, events[:part] + moved(events[part:], by_ns))
    plain, _ = run(setup, events)
    totals, expected = engine.fusion.totals(), plain.fusion.totals()
    assert totals["TOO_OLD"] == totals["DUPLICATE"] == 0
    assert sum(totals.values()) == sum(expected.values())
    last = {event.source: event.t_receive_ns for event in events[:part]}
    step = max(last.values()) - events[part].t_receive_ns + by_ns
    assert [(one.since_ns, one.by_ns) for one in engine.steps_back] == [(max(last.values()) - events[0].t_receive_ns, step)]
    told = [message for message in sent if isinstance(message, EventMessage) and message.kind == "reset"]
    assert [message.text for message in told] == ["state reset: receipt stamps stepped back, a new session; aligning again"]
    final = states(sent)[-1]
    assert (final.resets, final.mode) == (1, states(run(setup, events)[1])[-1].mode)


def test_ticks_and_time_since_the_first_event_go_on(setup: Config, events: list[Received]) -> None:
    part = split(events)
    engine, sent = run(setup, events[:part] + moved(events[part:], HOUR))
    stamps = [state.t_ns for state in states(sent)]
    back = [n for n, (before, after) in enumerate(pairwise(stamps)) if after < before]
    assert len(back) == 1
    gap = engine.steps_back[0].by_ns
    joined = stamps[: back[0] + 1] + [t_ns + gap for t_ns in stamps[back[0] + 1 :]]
    assert joined == [events[0].t_receive_ns + n * 20 * 10**6 for n in range(len(joined))]
    assert engine.elapsed_ns == events[-1].t_receive_ns - events[0].t_receive_ns - HOUR + gap
    health = [message for message in sent if isinstance(message, HealthMessage)]
    assert all(rate >= 0 for message in health for rate in (source.rate_hz for source in message.sources.values()))
    assert [message.uptime_s for message in health] == sorted(message.uptime_s for message in health)
    settled = [message.t_ns for message in sent if isinstance(message, SettledMessage)]
    assert settled[-1] < settled[0]


def test_every_innovation_of_both_sessions_is_told(setup: Config, events: list[Received]) -> None:
    part = split(events)
    _, sent = run(setup, events[:part] + moved(events[part:], HOUR))
    _, plain = run(setup, events)
    told, expected = ([one for one in messages if isinstance(one, InnovationMessage)] for messages in (sent, plain))
    assert len(told) == len(expected)
    assert sum(one.outcome == "waiting" for one in told) <= 16  # the newest of each source, at both ends


def test_sources_that_fall_silent_with_the_step_are_lost(setup: Config, events: list[Received]) -> None:
    part = split(events)
    rest = [event for event in events[part:] if event.source != "rear_left"]
    _, sent = run(setup, events[:part] + moved(rest, HOUR))
    lost = [one for one in sent if isinstance(one, EventMessage) and one.kind == "source_lost"]
    assert [one.subject for one in lost] == ["rear_left", "gps0.position", "gps0.velocity"]  # GNSS has its outage
    assert lost[0].t_ns - (events[part].t_receive_ns - HOUR) == pytest.approx(2 * 10**9, abs=50 * 10**6)


def test_the_second_session_is_that_of_a_drive_of_its_own(setup: Config, events: list[Received]) -> None:
    """But for what the first one has learnt: here it never had a state, so nothing."""
    few = [event for event in events[:2000] if event.source == "rear_left"]
    engine, sent = run(setup, few + moved(events, HOUR))
    _, own = run(setup, moved(events, HOUR))
    assert not any(state.state for state in states(sent)[: engine.ticks - len(states(own))])
    alone = engine.fusion.solution_at(engine.now_ns).state
    again, _ = run(setup, moved(events, HOUR))
    expected = again.fusion.solution_at(again.now_ns).state
    assert alone is not None and expected is not None
    assert (alone.latitude, alone.longitude, alone.height) == (expected.latitude, expected.longitude, expected.height)
    assert alone.covariance.tobytes() == expected.covariance.tobytes()
