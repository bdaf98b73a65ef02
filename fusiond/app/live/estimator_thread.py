"""The estimator's thread: it takes what the inputs bring, makes ticks when they are due, and shows that it lives.

A thread of its own, for nothing else that the daemon does may come between an instant and its state. It wakes when an
empty inbox fills, when a tick is near, and when it is due. What can be done before a tick is done then, what can wait
(other messages, collecting garbage) is done after it.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from threading import Event, Lock
from typing import Any, TypeVar

from fusiond.app.live.live_engine import LiveEngine, Source
from fusiond_adapters.host.clock import HostClock

SECOND = 1_000_000_000  # ns
IDLE_S = 0.25  # it looks around at least this often
LATE_NS = 5_000_000  # a tick later than this waits for the inputs, which were held up as well
CATCH_UP_S = 0.002  # so long
STALLED_NS = 2 * SECOND  # an estimator that has not come round for so long is not alive
PREPARE_NS = 800_000  # before a tick its state is made, so that it can go out at once
GIVE_WAY_S = 0.001  # it leaves the processor to the outputs for so long once they have a state
FREE_NS = 3_000_000  # with so much time until the next tick, garbage may be collected
YOUNG, MIDDLE, OLD = 700, 10, 10  # from when on: Python's own thresholds

Result = TypeVar("Result")


class Estimator:
    """Runs `live` on the inboxes of `inputs`, which set `wake` when they fill. `on_turn` is called after each turn."""

    def __init__(
        self,
        live: LiveEngine,
        inputs: Mapping[str, Source],
        clock: HostClock,
        wake: Event,
        on_turn: Callable[[], None],
    ) -> None:
        self._live, self._inputs, self._clock, self._wake, self._on_turn = live, inputs, clock, wake, on_turn
        self._beat_ns = 0  # when it last came round
        self._finishing = False
        self._asked: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._asking = Lock()  # guards the two below
        self._over = False

    def run(self) -> None:
        """Until `finish` is called and everything received before that is taken."""
        try:
            more = False
            while more or not self._finishing:
                if not more:
                    self._wake.wait(self._time_to_turn())
                self._wake.clear()
                more = self._turn()
            while self._turn():  # what came between the last look and the end of the inputs
                pass
        finally:
            with self._asking:
                self._over = True
            self._answer_all()

    def finish(self) -> None:
        """There will be no more input. From any thread."""
        self._finishing = True
        self._wake.set()

    def ask(self, call: Callable[[], Result]) -> Future[Result]:
        """Have something done between two turns; after the end, right here. From any thread."""
        future: Future[Result] = Future()
        with self._asking:
            if not self._over:
                self._asked.append((call, future))
                self._wake.set()
                return future
        _answer(call, future)
        return future

    def is_alive(self) -> bool:
        """Whether it has come round lately. From any thread."""
        return self._clock.now_ns() - self._beat_ns < STALLED_NS

    def _turn(self) -> bool:
        """Take what is there, and make the ticks that are due. Returns whether frames are left."""
        live, speed = self._live, self._clock.speed
        due = live.next_tick_ns
        late = due is not None and self._clock.now_ns() - due > LATE_NS * speed
        if late:
            time.sleep(CATCH_UP_S)
        more = live.step(self._inputs, give_way=not late and speed == 1.0)
        if live.engine.unfinished:
            time.sleep(GIVE_WAY_S)
            live.engine.flush()
        self._answer_all()
        self._beat_ns = self._clock.now_ns()
        self._on_turn()
        left_ns = self._time_left_ns()
        if not more and left_ns is not None and 0 < left_ns <= PREPARE_NS and speed == 1.0:
            live.engine.prepare()
        elif left_ns is None or left_ns > FREE_NS:
            _collect_garbage()
        return more

    def _answer_all(self) -> None:
        while self._asked:
            _answer(*self._asked.popleft())

    def _time_left_ns(self) -> int | None:
        """Until the next tick is due."""
        due = self._live.next_tick_ns
        return None if due is None else due - self._clock.now_ns()

    def _time_to_turn(self) -> float:
        """Until there is something to do without input [s]: a tick to make or to prepare, or a look around."""
        left_ns = self._time_left_ns()
        if left_ns is None:
            return IDLE_S
        if left_ns > PREPARE_NS:
            left_ns -= PREPARE_NS
        return min(IDLE_S, max(0.0, left_ns / SECOND / self._clock.speed))


def _answer(call: Callable[[], Any], future: Future[Any]) -> None:
    try:
        future.set_result(call())
    except Exception as error:  # it is the asker's
        future.set_exception(error)


def _collect_garbage() -> None:
    """Where Python's own collections are turned off: the same, but at a time when nothing waits for them."""
    young, middle, old = gc.get_count()
    if young > YOUNG and not gc.isenabled():
        gc.collect(0 if middle < MIDDLE else 1 if old < OLD else 2)
