"""The host's time line of a live run: Unix time at the start, carried on by the monotonic clock.

A step of the wall clock (NTP, a GNSS receiver that sets it) moves no stamp. In return the time line keeps the error that
the wall clock had at the start; the clock alignment sees it as an offset of the Unix stamps.
"""

from __future__ import annotations

import time

MAX_AGE_NS = 2_000_000_000  # a kernel stamp older than this when it is read is rejected


class HostClock:
    """Stamps of receipt. One for all the inputs of a run; `start_ns` lets a played drive have its own time."""

    speed = 1.0  # relative to real time

    def __init__(self, start_ns: int | None = None) -> None:
        self._offset_ns = (time.time_ns() if start_ns is None else start_ns) - time.monotonic_ns()

    def now_ns(self) -> int:
        """The present instant."""
        return time.monotonic_ns() + self._offset_ns

    def from_wall_ns(self, wall_ns: int) -> int:
        """The instant of a recent wall clock stamp: as long before now as the wall clock says. Now itself where that is
        implausible: the wall clock was set in between, or the stamp is of another clock."""
        age_ns = time.time_ns() - wall_ns
        return self.now_ns() - (age_ns if 0 <= age_ns <= MAX_AGE_NS else 0)
