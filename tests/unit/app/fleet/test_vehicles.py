"""A fleet by a clock of the test: ages, rates, what is decoded, and when which alarm begins and ends."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fusiond.app.fleet.vehicles import PATIENCE_S, SILENT_S, Changes, Fleet
from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, StateMessage
from tests.helpers.vehicles import health, state


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def fleet(clock: Clock) -> Fleet:
    return Fleet(clock)


def hear(fleet: Fleet, *messages: StateMessage | HealthMessage) -> None:
    for message in messages:
        if isinstance(message, StateMessage):
            fleet.hear_state(message.vehicle, lambda one=message: one)  # type: ignore[misc]
        else:
            fleet.hear_health(message.vehicle, lambda one=message: one)  # type: ignore[misc]


def kinds(fleet: Fleet, name: str = "a") -> list[tuple[str, str]]:
    return [(alarm.kind, alarm.urgency) for alarm in fleet.look().alarms[name]]


def test_only_the_latest_state_is_decoded(fleet: Fleet, clock: Clock) -> None:
    decoded: list[int] = []

    def decoding(number: int) -> Callable[[], StateMessage]:
        return lambda: decoded.append(number) or state("a")  # type: ignore[func-returns-value]

    for number in range(100):
        clock.now_s += 0.01
        fleet.hear_state("a", decoding(number))
    clock.now_s += 0.5
    (vehicle,) = fleet.look().vehicles
    assert (decoded, vehicle.states, vehicle.age_s) == ([99], 100, pytest.approx(0.5))
    fleet.look()
    assert decoded == [99]


def test_the_rate_is_that_of_the_last_seconds(fleet: Fleet, clock: Clock) -> None:
    rates = []
    for number in range(80):
        clock.now_s += 0.1
        if number < 40:
            hear(fleet, state("a"))
        rates.append(fleet.look().vehicles[0].rate_hz)
    assert rates[39] == pytest.approx(10.0) and rates[79] == 0.0


def test_silence_and_departure(fleet: Fleet, clock: Clock) -> None:
    fleet.hear_presence("a", True)
    hear(fleet, state("a"))
    assert kinds(fleet) == []
    clock.now_s += SILENT_S + 0.1
    assert kinds(fleet) == [("silent", "critical")]
    fleet.hear_presence("a", False)
    assert kinds(fleet) == [("gone", "critical")]
    fleet.hear_presence("a", True)
    hear(fleet, state("a"))
    assert kinds(fleet) == []
    fleet.hear_presence("b", True)  # it never says anything
    clock.now_s += SILENT_S + 0.1
    assert kinds(fleet, "b") == [("silent", "critical")]


@pytest.mark.parametrize(
    ("message", "at_once", "after_a_minute"),
    [
        (state("a", Mode.LOST), [("lost", "critical")], [("lost", "critical")]),
        (state("a", fault="not finite"), [("withheld", "critical")], [("withheld", "critical")]),
        (state("a", Mode.DEAD_RECKONING), [], [("not nominal", "warning")]),
        (state("a", Mode.ALIGNING), [], [("not nominal", "warning")]),
        (state("a"), [], []),
    ],
)
def test_alarms_of_a_state(
    message: StateMessage, at_once: list[object], after_a_minute: list[object], fleet: Fleet, clock: Clock
) -> None:
    hear(fleet, message)
    assert kinds(fleet) == at_once
    clock.now_s += PATIENCE_S + 0.1
    hear(fleet, message)
    assert kinds(fleet) == after_a_minute


def test_a_reset_is_an_alarm_for_a_while(fleet: Fleet, clock: Clock) -> None:
    hear(fleet, state("a", resets=7), health("a"))
    assert kinds(fleet) == []  # it was before we listened
    hear(fleet, state("a", resets=8))
    (alarm,) = fleet.look().alarms["a"]
    assert (alarm.kind, alarm.text) == ("reset", "the state has jumped: a jump of the clock")
    clock.now_s += PATIENCE_S + 0.1
    hear(fleet, state("a", resets=8))
    assert kinds(fleet) == []


def test_sources_are_told_and_the_worst_vehicle_is_first(fleet: Fleet) -> None:
    hear(fleet, state("a"), health("a", gps0="nominal"), state("b"), health("b", gps0="silent", left="frozen"))
    hear(fleet, state("c", Mode.LOST))
    picture = fleet.look()
    assert [vehicle.name for vehicle in picture.vehicles] == ["c", "b", "a"]
    assert [alarm.text for alarm in picture.alarms["b"]] == ["nothing from gps0", "left frozen: it repeats one value"]


def test_an_alarm_begins_once_and_ends_once(fleet: Fleet, clock: Clock) -> None:
    changes, found = Changes(), []
    for number in range(12):
        clock.now_s += 1.0
        if number < 2 or number >= 8:
            hear(fleet, state("a"))
        found += [(number, begun, alarm.kind) for begun, alarm in changes.since(fleet.look())]
    assert found == [(4, True, "silent"), (8, False, "silent")]


def test_what_cannot_be_decoded_changes_nothing(fleet: Fleet) -> None:
    hear(fleet, state("a"), health("a", gps0="silent"))
    fleet.look()
    fleet.hear_state("a", lambda: None)
    fleet.hear_health("a", lambda: None)
    (vehicle,) = fleet.look().vehicles
    assert vehicle.state == state("a") and kinds(fleet) == [("source", "warning")]
