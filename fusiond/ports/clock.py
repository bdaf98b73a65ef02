"""The clock that stamps receipts: the host's in a live run; a played drive has its own."""

from __future__ import annotations

from typing import Protocol


class Clock(Protocol):
    """The time line of all stamps of a run, in integer nanoseconds."""

    @property
    def speed(self) -> float:
        """Its speed relative to real time."""

    def now_ns(self) -> int:
        """The present instant."""

    def from_wall_ns(self, wall_ns: int) -> int:
        """The instant of a recent stamp of the wall clock."""
