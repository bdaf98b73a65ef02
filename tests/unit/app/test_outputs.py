"""The fan-out: what each output gets, waiting, failures, and an end that loses nothing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event

import pytest

from fusiond.app.outputs import Outputs
from fusiond.messages import ConfigMessage, EventMessage, Message
from fusiond.ports.outputs import Outbox, OutputLost

DEADLINE = 10.0  # s
HELLO = ConfigMessage(vehicle="v", config={})


class Slow:
    """An output that is slow, and may fail at first."""

    def __init__(self, name: str, size: int, pause_s: float = 0.0, fault: Exception | None = None) -> None:
        self.name = self.about = name
        self.outbox = Outbox(size, (Message,))
        self.got: list[Message] = []
        self.may_take = Event()
        self.may_take.set()
        self._pause_s, self._fault = pause_s, fault

    def session(self, stop: Event) -> None:
        if self._fault:
            raise self._fault
        stopping = False
        while not stopping:
            stopping = stop.is_set()
            self.may_take.wait(DEADLINE)
            self.got += self.outbox.take(0 if stopping else 0.05)
            time.sleep(self._pause_s)

    def counts(self) -> dict[str, int]:
        return {"got": len(self.got)}

    def notes(self) -> dict[str, str]:
        return {}


def event(number: int) -> EventMessage:
    return EventMessage(vehicle="v", t_ns=number, kind="mode", severity="info", subject="", text="")


@contextmanager
def running(*outputs: Slow, patience_s: float = 0.0) -> Iterator[Outputs]:
    made = Outputs(outputs, lambda: 0, lambda: [HELLO], lambda: 0.1, patience_s)
    made.start()
    made.wait_until_tried()
    try:
        yield made
    finally:
        made.stop()
        made.join()


def test_patience_loses_nothing_however_slow_the_output() -> None:
    """2000 messages through a box of 8, while another output keeps up by itself."""
    slow, quick = Slow("slow", 8, pause_s=0.001), Slow("quick", 5000)
    with running(slow, quick, patience_s=DEADLINE) as outputs:
        for number in range(2000):
            outputs.put(event(number))
    wanted = [HELLO, *map(event, range(2000))]
    assert slow.got == wanted and quick.got == wanted
    assert outputs.unsent() == {"slow": 0, "quick": 0}


def test_without_patience_nothing_waits() -> None:
    stalled, quick = Slow("stalled", 8), Slow("quick", 5000)
    with running(stalled, quick) as outputs:
        stalled.may_take.clear()
        began = time.monotonic()
        for number in range(2000):
            outputs.put(event(number))
        assert time.monotonic() - began < 5.0
        assert outputs.dropped()["stalled"] > 1000
        stalled.may_take.set()
    assert quick.got == [HELLO, *map(event, range(2000))]
    assert stalled.got[-8:] == [event(number) for number in range(1992, 2000)]


def test_patience_has_an_end_and_comes_back() -> None:
    """It waits once for an output that takes nothing; later losses are counted; it waits again once messages are taken."""
    stalled = Slow("stalled", 4)
    with running(stalled, patience_s=0.3) as outputs:
        stalled.may_take.clear()
        deadline = time.monotonic() + DEADLINE
        while stalled.outbox.waiting < 4 and time.monotonic() < deadline:
            outputs.put(event(0))
            time.sleep(0.06)  # longer than it waits for messages: then it waits for the test
        began = time.monotonic()
        for number in range(100):
            outputs.put(event(number))
        assert 0.25 < time.monotonic() - began < 2 * 0.3 + 1.0
        assert outputs.dropped()["stalled"] == 100
        stalled.may_take.set()
        while stalled.outbox.waiting and time.monotonic() < deadline:
            time.sleep(0.01)
        for number in range(500):
            outputs.put(event(number))
        assert outputs.dropped()["stalled"] == 100
    assert stalled.got[-500:] == list(map(event, range(500)))


def test_what_cannot_be_opened_is_reported_and_tried_again() -> None:
    faulty = Slow("faulty", 4, fault=OutputLost("no consumer"))
    with running(faulty) as outputs:
        assert outputs.failures == {"faulty": "no consumer"}
        outputs.put(event(1))
        faulty._fault = None
        deadline = time.monotonic() + DEADLINE
        while outputs.failures and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not outputs.failures
    assert faulty.got == [event(1), HELLO]


def test_messages_left_with_a_closed_output_are_counted() -> None:
    faulty = Slow("faulty", 10, fault=OutputLost("no consumer"))
    with running(faulty) as outputs:
        for number in range(3):
            outputs.put(event(number))
    assert outputs.unsent() == {"faulty": 3}


def test_the_introduction_is_sent_again_on_request() -> None:
    one = Slow("one", 10)
    with running(one) as outputs:
        outputs.introduce()
    assert one.got == [HELLO, HELLO]


def test_stopped_before_it_began_it_ends_at_once() -> None:
    outputs = Outputs([Slow("one", 1)], lambda: 0, list, lambda: 0.1)
    outputs.stop()
    outputs.join()
    outputs.start()
    outputs.wait_until_tried()
    outputs.join()
    assert set(outputs) == {"one"} and len(outputs) == 1


@pytest.mark.parametrize("patience_s", [0.0, 5.0])
def test_a_reader_may_put_into_its_own_full_box(patience_s: float) -> None:
    """Only its own thread could make room: waiting would be useless."""
    box = Outbox(1, (Message,))
    box.patience_s = patience_s
    box.put(event(1))
    began = time.monotonic()
    box.put(event(2), may_wait=False)
    assert time.monotonic() - began < 2.0
    assert box.take(0) == [event(2)] and box.dropped == 1
