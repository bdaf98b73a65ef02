"""The estimator's thread: it processes everything received before its end, makes ticks, and answers calls between steps."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import pytest

from fusiond.app.live.estimator_thread import PREPARE_NS, STALLED_NS, Estimator
from fusiond.app.live.live_engine import LiveEngine
from fusiond.ports.inputs import Inbox
from fusiond.units import MILLISECOND as MS
from fusiond_adapters.host.clock import HostClock

DEADLINE = 10.0  # s


class Live:
    """Stands in for the engine: processes two frames a step, and ticks every 20 ms once a tick is set."""

    def __init__(self, clock: HostClock) -> None:
        self.processed: list[int] = []
        self.threads: set[int] = set()
        self.ticks: list[int] = []  # when they were made
        self.next_tick_ns: int | None = None
        self.unfinished = False
        self.engine = self
        self.prepared: list[int] = []  # how long before a tick [ns]
        self.before_step: Callable[[], None] = lambda: None
        self._clock, self._frames = clock, list[int]()

    def step(self, inputs: Mapping[str, Any], *, give_way: bool = False) -> bool:
        assert not self.unfinished, "the last tick was not finished"
        self.before_step()
        self.threads.add(threading.get_ident())
        self._frames += [item for one in inputs.values() for _, item in one.inbox.take()]
        self.processed += self._frames[:2]
        self._frames = self._frames[2:]
        if self.next_tick_ns is not None and self._clock.now_ns() >= self.next_tick_ns:
            self.ticks.append(self._clock.now_ns())
            self.next_tick_ns += 20 * MS
            self.unfinished = give_way
        return bool(self._frames)

    def flush(self) -> None:
        self.unfinished = False

    def prepare(self) -> None:
        assert self.next_tick_ns is not None
        self.prepared.append(self.next_tick_ns - self._clock.now_ns())


class FrameInput:
    def __init__(self, wake: Callable[[], None]) -> None:
        self.inbox: Inbox[int] = Inbox(1000, wake, hash)


class Rig:
    def __init__(self) -> None:
        clock, wake = HostClock(), threading.Event()
        self.clock, self.live, self.input, self.steps = clock, Live(clock), FrameInput(wake.set), 0
        self.estimator = Estimator(cast(LiveEngine, self.live), {"one": cast(Any, self.input)}, clock, wake, self._count)
        self.errors: list[BaseException] = []

    def _count(self) -> None:
        self.steps += 1

    def run(self) -> None:
        try:
            self.estimator.run()
        except ZeroDivisionError as error:
            self.errors.append(error)

    @contextmanager
    def running(self) -> Iterator[threading.Thread]:
        thread = threading.Thread(target=self.run)
        thread.start()
        try:
            yield thread
        finally:
            self.estimator.finish()
            thread.join(DEADLINE)
            assert not thread.is_alive()


def test_everything_received_before_the_end_is_processed() -> None:
    for _ in range(20):
        rig = Rig()
        with rig.running():
            for number in range(200):
                rig.input.inbox.put(number, number)
        assert rig.live.processed == list(range(200))


def test_it_sleeps_while_there_is_nothing_to_do_and_wakes_for_a_frame() -> None:
    rig = Rig()
    with rig.running():
        time.sleep(0.1)
        assert rig.steps <= 2
        rig.input.inbox.put(0, 7)
        ends = time.monotonic() + DEADLINE
        while not rig.live.processed and time.monotonic() < ends:
            time.sleep(0.001)
    assert rig.live.processed == [7]


def test_ticks_are_made_without_input() -> None:
    rig = Rig()
    first_ns = rig.live.next_tick_ns = rig.clock.now_ns() + 20 * MS
    with rig.running():
        ends = time.monotonic() + DEADLINE
        while len(rig.live.ticks) < 10 and time.monotonic() < ends:
            time.sleep(0.01)
    assert len(rig.live.ticks) >= 10
    assert all(made >= first_ns + number * 20 * MS for number, made in enumerate(rig.live.ticks))  # none before its time
    assert not rig.live.unfinished
    assert rig.live.prepared  # not each of them, on a machine that is busy
    assert max(rig.live.prepared) <= PREPARE_NS


def test_garbage_is_collected_while_there_is_time() -> None:
    """And at no other time, if Python's own collection is off."""
    rig, left = Rig(), []

    def collecting(phase: str, _: dict[str, int]) -> None:
        due = rig.live.next_tick_ns
        if phase == "start" and due is not None:
            left.append(due - rig.clock.now_ns())

    def litter() -> None:
        kept = [[number] for number in range(300)]
        kept.append(kept)  # type: ignore[arg-type]

    rig.live.before_step = litter
    rig.live.next_tick_ns = rig.clock.now_ns() + 20 * MS
    gc.disable()
    gc.callbacks.append(collecting)
    try:
        with rig.running():
            ends = time.monotonic() + DEADLINE
            while len(rig.live.ticks) < 20 and time.monotonic() < ends:
                time.sleep(0.01)
    finally:
        gc.callbacks.remove(collecting)
        gc.enable()
    assert left
    assert min(left) > 0


def test_calls_run_in_its_thread_and_after_its_end_in_the_caller() -> None:
    rig = Rig()
    with rig.running() as thread:
        assert rig.estimator.ask(threading.get_ident).result(DEADLINE) == thread.ident
        with pytest.raises(KeyError):
            rig.estimator.ask(lambda: {}["nothing"]).result(DEADLINE)
        assert rig.estimator.ask(lambda: 3).result(DEADLINE) == 3  # it continues
        assert rig.live.threads == {thread.ident}
    assert rig.estimator.ask(threading.get_ident).result(0) == threading.get_ident()


def test_a_fault_ends_it_and_leaves_no_caller_waiting() -> None:
    rig = Rig()
    asked, may_fail = threading.Event(), threading.Event()

    def fail() -> None:
        asked.set()
        may_fail.wait(DEADLINE)
        raise ZeroDivisionError

    rig.live.before_step = fail
    with rig.running():
        rig.input.inbox.put(0, 1)
        assert asked.wait(DEADLINE)
        answer = rig.estimator.ask(lambda: 5)
        may_fail.set()
        assert answer.result(DEADLINE) == 5
    assert len(rig.errors) == 1


def test_it_is_alive_while_it_finishes_steps() -> None:
    rig, entered, may_go = Rig(), threading.Event(), threading.Event()

    def hang() -> None:
        entered.set()
        may_go.wait(DEADLINE)

    assert not rig.estimator.is_alive()
    with rig.running():
        rig.input.inbox.put(0, 1)
        ends = time.monotonic() + DEADLINE
        while not rig.estimator.is_alive() and time.monotonic() < ends:
            time.sleep(0.001)
        assert rig.estimator.is_alive()
        rig.live.before_step = hang
        rig.input.inbox.put(0, 2)
        assert entered.wait(DEADLINE)
        rig.estimator._step_ns -= STALLED_NS  # as if that had lasted
        assert not rig.estimator.is_alive()
        may_go.set()
    assert rig.estimator.is_alive()
    assert rig.live.processed == [1, 2]
