"""The estimator's thread: it processes the frames of the inputs, makes ticks when they are due, and reports that it works.

It has a thread of its own so that nothing else in the daemon delays a state. It wakes when a frame comes into an empty
inbox, shortly before a tick, and when a tick is due. The tick's state is prepared before it; other messages and garbage
collection wait until after it.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from threading import Event, Lock
from typing import Any, TypeVar

from fusiond.app.live.live_engine import FrameInput, LiveEngine
from fusiond.units import MICROSECOND, MILLISECOND, SECOND
from fusiond_adapters.host.clock import HostClock

IDLE_S = 0.25  # longest time between two steps
LATE_NS = 5 * MILLISECOND  # a tick later than this waits for the inputs, which were delayed too
CATCH_UP_S = 0.002  # how long it waits
STALLED_NS = 2 * SECOND  # an estimator that has not finished a step for this long is not alive
PREPARE_NS = 800 * MICROSECOND  # how long before a tick its state is prepared
GIVE_WAY_S = 0.001  # how long it leaves the processor to the outputs after a state
FREE_NS = 3 * MILLISECOND  # garbage is collected if there is this much time until the next tick
YOUNG, MIDDLE, OLD = 700, 10, 10  # Python's own thresholds for collection

Result = TypeVar("Result")


class Estimator:
    """Runs `live` on the inboxes of `inputs`, which set `wake` when frames come. `on_step` is called after each step."""

    def __init__(
        self,
        live: LiveEngine,
        inputs: Mapping[str, FrameInput],
        clock: HostClock,
        wake: Event,
        on_step: Callable[[], None],
    ) -> None:
        self._live, self._inputs, self._clock, self._wake, self._on_step = live, inputs, clock, wake, on_step
        self._step_ns = 0  # when the last step ended
        self._finishing = False
        self._asked: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._asking = Lock()  # guards `_asked` and `_over`
        self._over = False

    def run(self) -> None:
        """Run until `finish` is called and everything received before that is processed."""
        try:
            more = False
            while more or not self._finishing:
                if not more:
                    self._wake.wait(self._time_to_step())
                self._wake.clear()
                more = self._step()
            while self._step():  # frames that came between the last step and the end of the inputs
                pass
        finally:
            with self._asking:
                self._over = True
            self._answer_all()

    def finish(self) -> None:
        """No more frames will come. From any thread."""
        self._finishing = True
        self._wake.set()

    def ask(self, call: Callable[[], Result]) -> Future[Result]:
        """Call a function between two steps in the estimator's thread; after its end, here. From any thread."""
        future: Future[Result] = Future()
        with self._asking:
            if not self._over:
                self._asked.append((call, future))
                self._wake.set()
                return future
        _answer(call, future)
        return future

    def is_alive(self) -> bool:
        """Whether it has finished a step recently. From any thread."""
        return self._clock.now_ns() - self._step_ns < STALLED_NS

    def _step(self) -> bool:
        """Process the frames in the inboxes, and make the ticks that are due. Returns whether frames are left."""
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
        self._step_ns = self._clock.now_ns()
        self._on_step()
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
        """Time until the next tick is due."""
        due = self._live.next_tick_ns
        return None if due is None else due - self._clock.now_ns()

    def _time_to_step(self) -> float:
        """Time until the next step without input [s]: to make a tick, to prepare one, or to check for the end."""
        left_ns = self._time_left_ns()
        if left_ns is None:
            return IDLE_S
        if left_ns > PREPARE_NS:
            left_ns -= PREPARE_NS
        return min(IDLE_S, max(0.0, left_ns / SECOND / self._clock.speed))


def _answer(call: Callable[[], Any], future: Future[Any]) -> None:
    try:
        future.set_result(call())
    except Exception as error:  # raised where the result is read
        future.set_exception(error)


def _collect_garbage() -> None:
    """If Python's own garbage collection is turned off: collect as it would, at a time when nothing waits."""
    young, middle, old = gc.get_count()
    if young > YOUNG and not gc.isenabled():
        gc.collect(0 if middle < MIDDLE else 1 if old < OLD else 2)
