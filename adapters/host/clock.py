"""The host's time line of a live run: Unix time at the start, continued by the monotonic clock.

A step of the wall clock (by NTP or a GNSS receiver) does not change the stamps. But the time line keeps the error that the
wall clock had at the start; the clock alignment sees it as an offset of Unix stamps.
"""

from __future__ import annotations

import time

from fusiond.units import SECOND

MAX_AGE_NS = 2 * SECOND  # a kernel stamp older than this when it is read is rejected


class HostClock:
    """Receive stamps for all inputs of a run. `start_ns` sets another time, for a played drive."""

    speed = 1.0  # relative to real time

    def __init__(self, start_ns: int | None = None) -> None:
        self._offset_ns = (time.time_ns() if start_ns is None else start_ns) - time.monotonic_ns()

    def now_ns(self) -> int:
        """The present instant."""
        return time.monotonic_ns() + self._offset_ns

    def from_wall_ns(self, wall_ns: int) -> int:
        """The instant of a recent stamp of the wall clock, by its age; the present instant if the age is implausible: the
        wall clock was set since, or the stamp is of another clock."""
        age_ns = time.time_ns() - wall_ns
        return self.now_ns() - (age_ns if 0 <= age_ns <= MAX_AGE_NS else 0)
