"""Innovations: each measurement once, with its outcome at the tick; their cost; what has none."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from msgspec.structs import replace

from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.estimator.history import History
from fusiond.events import ImuSample, Invalid, Received
from fusiond.messages import InnovationMessage, Message
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.drive import LOGS, folder, settings


@pytest.fixture(scope="module")
def events() -> list[Received]:
    return list(open_logs([str(folder() / log) for log in LOGS], settings()))


def run(setup: Config, events: Iterable[Received], rate_hz: float = 50.0) -> tuple[Engine, list[InnovationMessage]]:
    sent: list[Message] = []
    engine = Engine(setup, sent.append, rate_hz=rate_hz)
    for event in events:
        engine.feed(event)
    engine.finish()
    return engine, [message for message in sent if isinstance(message, InnovationMessage)]


def test_they_cause_no_rewind(events: list[Received], monkeypatch: pytest.MonkeyPatch) -> None:
    """The fixes of this drive are late, position and velocity together: one rewind is enough for both."""
    rewinds, rewind = 0, History._rewind

    def counted(history: History, first_changed: int) -> None:
        nonlocal rewinds
        rewinds += 1
        rewind(history, first_changed)

    monkeypatch.setattr(History, "_rewind", counted)
    found = []
    for enabled in (False, True):
        setup = replace(settings(), publish=replace(settings().publish, innovations=enabled))
        rewinds = 0
        engine, _ = run(setup, events)
        found.append((rewinds, engine.fusion.history.rerun))
    assert found[0] == found[1]
    assert found[0][0] > 10


def test_every_measurement_has_one_and_outcomes_add_up(events: list[Received]) -> None:
    engine, innovations = run(settings(), events)
    for source, counts in engine.fusion.outcomes().items():
        mine = [message for message in innovations if message.source == source]
        if source == "imu0":
            assert not mine
        else:
            assert len(mine) == sum(counts.values()) - counts["WAITING"] > 10


def test_of_the_imu_only_a_rejected_sample_has_one(events: list[Received]) -> None:
    imu = [i for i, event in enumerate(events) if event.source == "imu0"]
    spoiled = list(events)
    bad = events[imu[len(imu) // 2]]
    assert isinstance(bad.payload, ImuSample)
    spoiled[imu[len(imu) // 2]] = replace(bad, payload=replace(bad.payload, angular_rate_b=(0.0, 20.0, 0.0)))
    (message,) = (message for message in run(settings(), spoiled)[1] if message.source == "imu0")
    assert message.outcome == "rejected"
    assert message.t_receive_ns == bad.t_receive_ns
    assert message.test_ratio is not None
    assert message.test_ratio > 10
    assert message.innovation[1] == pytest.approx(20.0, abs=0.3)


@pytest.mark.parametrize("rate_hz", [0.2, 1.0])
def test_rare_ticks_lose_no_outcome(events: list[Received], rate_hz: float) -> None:
    """The history drops rows after a second; here a second or five lie between two ticks."""
    _, often = run(settings(), events)
    _, rarely = run(settings(), events, rate_hz)
    last_ns = max(message.t_receive_ns for message in rarely)
    judged = {(message.source, message.t_ns) for message in often if message.test_ratio is not None}
    published = {(message.source, message.t_ns) for message in rarely if message.test_ratio is not None}
    expected = {(m.source, m.t_ns) for m in often if m.t_receive_ns <= last_ns} & judged
    assert len(expected) > 500
    assert expected <= published  # and some that had no state before a late fix
    assert {message.outcome for message in rarely} <= {"gathered", "fused", "rejected"}


@pytest.mark.parametrize(
    "payload",
    [ImuSample((math.nan, 0.0, -9.8), (0.0, 0.0, 0.0)), Invalid("stamped in the future"), ImuSample((1e6,) * 3, (0.0,) * 3)],
)
def test_an_unusable_inertial_sample_has_none(events: list[Received], payload: ImuSample | Invalid) -> None:
    at = len(events) // 2
    bad = replace(events[at], source="imu0", sequence=10**6, clock="", t_sensor_ns=None, payload=payload)
    engine, innovations = run(settings(), [*events[:at], bad, *events[at:]])
    assert engine.fusion.outcomes()["imu0"]["INVALID"] == 1
    assert {message.source for message in innovations} == set(settings().sources()) - {"imu0"}


def test_an_unusable_fix_is_published_with_its_reason(events: list[Received]) -> None:
    at = next(n for n, event in enumerate(events) if event.source == "gps0.position")
    bad = replace(events[at], sequence=10**6, payload=Invalid("no fix"))
    _, innovations = run(settings(), [*events[:at], bad, *events[at:]])
    (message,) = (message for message in innovations if message.outcome == "invalid")
    assert (message.source, message.reason, message.test_ratio, message.innovation) == ("gps0.position", "no fix", None, ())
