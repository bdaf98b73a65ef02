"""Keeping an input or output open: growing pauses, one line for each reason, faults that are not passed on."""

from __future__ import annotations

import logging
from threading import Event

import pytest

from fusiond.app.supervisor import keep_open
from fusiond.ports.inputs import InputLost
from fusiond.ports.outputs import OutputLost


class Part:
    name, about = "part", "a part"


class Pauses(Event):
    """An event that records the waits and never waits."""

    def __init__(self) -> None:
        super().__init__()
        self.waited: list[float] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.waited.append(timeout or 0.0)
        return self.is_set()


def kept(over: Event, *ends: Exception | None) -> list[str]:
    """Sessions with these ends, one after the other; returns the reasons reported. None: it was asked to end."""
    left, reasons = list(ends), []

    def session() -> None:
        end = left.pop(0)
        if not left:
            over.set()
        if end:
            raise end

    keep_open(Part(), session, over, lambda: 0.3, reasons.append)
    assert not left
    return reasons


def test_pauses_grow_up_to_their_limit_and_start_again_after_a_session_that_was_asked_to_end() -> None:
    over = Pauses()
    lost = [InputLost("away")] * 4
    assert kept(over, *lost, None, OutputLost("gone"), None) == ["away"] * 4 + ["gone"]
    assert over.waited == [0.1, 0.2, 0.3, 0.3, 0.1]


def test_each_change_of_the_reason_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "fusiond"):
        kept(Pauses(), *[InputLost("away")] * 3, InputLost("refused"), InputLost("away"))
    assert [record.getMessage() for record in caplog.records] == [
        f"a part: {reason}; trying again" for reason in ("away", "refused", "away")
    ]


def test_a_fault_is_logged_with_its_traceback_and_not_passed_on(caplog: pytest.LogCaptureFixture) -> None:
    assert kept(Pauses(), ZeroDivisionError("a driver's"), None) == ["failed: ZeroDivisionError(\"a driver's\")"]
    assert caplog.records[0].exc_info is not None


def test_nothing_is_opened_once_it_is_over() -> None:
    over = Event()
    over.set()
    keep_open(Part(), lambda: pytest.fail("opened"), over, lambda: 1.0)
