"""The speed of a replay, and the clock of its outputs."""

from __future__ import annotations

import time
from collections.abc import Callable

from fusiond.units import SECOND
from fusiond_adapters.host.clock import HostClock


class Pacer:
    """Sleeps so that recorded time passes `speed` times as fast as real time, from the first call on."""

    def __init__(
        self, speed: float, clock: Callable[[], int] = time.monotonic_ns, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._speed, self._clock, self._sleep = speed, clock, sleep
        self._start_ns: int | None = None

    def __call__(self, since_start_ns: int) -> None:
        """Sleep until this time of the drive is due."""
        if self._start_ns is None:
            self._start_ns = self._clock()
        ahead_ns = self._start_ns + since_start_ns / self._speed - self._clock()
        if ahead_ns > 0:
            self._sleep(ahead_ns / SECOND)

    @property
    def elapsed_ns(self) -> int:
        """The time of the drive that is due now."""
        return 0 if self._start_ns is None else round((self._clock() - self._start_ns) * self._speed)


class ReplayClock(HostClock):
    """The time of a replayed drive: the time that is due by its pacer, or without one the time reached.

    `origin_ns` returns the instant of the first event on the time line of the present session, `now_ns` the receipt of the
    latest event.
    """

    def __init__(self, origin_ns: Callable[[], int], now_ns: Callable[[], int], pacer: Pacer | None) -> None:
        super().__init__()
        self._origin_ns, self._reached_ns, self._pacer = origin_ns, now_ns, pacer

    def now_ns(self) -> int:
        """The present instant of the drive."""
        return self._reached_ns() if self._pacer is None else self._origin_ns() + self._pacer.elapsed_ns

    def from_wall_ns(self, wall_ns: int) -> int:
        """The present instant: stamps of the wall clock have no meaning here."""
        return self.now_ns()
