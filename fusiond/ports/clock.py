"""The clock that stamps what is received: a live run's is the host's, a played drive has its own."""

from __future__ import annotations

from typing import Protocol


class Clock(Protocol):
    """The time line of all stamps of a run, in integer nanoseconds."""

    @property
    def speed(self) -> float:
        """How many times as fast as real time it runs."""

    def now_ns(self) -> int:
        """The present instant."""

    def from_wall_ns(self, wall_ns: int) -> int:
        """The instant that the wall clock called `wall_ns` a moment ago."""
