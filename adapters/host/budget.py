"""The share of time that a thread may work for its readers, so that no reader, however greedy, delays a state.

Python runs one thread at a time: whatever a thread does for a reader, the estimator may have to wait for. A thread that
sleeps after each small piece of work, for many times as long, is hardly ever in the estimator's way, and then only for the
rest of a piece.
"""

from __future__ import annotations

import time
from collections.abc import Callable

SHARE = 0.05


class Budget:
    """The budget of the thread that makes it. `worked_s` reads the processor time of that thread."""

    def __init__(
        self,
        share: float = SHARE,
        worked_s: Callable[[], float] = time.thread_time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._rest_per_work = 1 / share - 1
        self._worked_s, self._sleep = worked_s, sleep
        self._paid_s = worked_s()

    def rest(self) -> None:
        """Sleep for what the thread has worked since the last call, so that its share is kept."""
        now_s = self._worked_s()
        worked_s, self._paid_s = now_s - self._paid_s, now_s
        self._sleep(worked_s * self._rest_per_work)
