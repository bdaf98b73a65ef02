"""The offset between the host's clock and a remote one, from round trips (MAVLink TIMESYNC)."""

from __future__ import annotations

from fusiond.timeline.least_offset import OffsetFloor
from fusiond.units import MILLISECOND

MAX_DEVIATION = 20 * MILLISECOND  # a steady clock's offset lies between a round trip's bounds, or off them by less
DEVIATIONS = 5  # after this many deviating trips in a row the clock has moved, and learning restarts (as in PX4)


class RoundTrips:
    """Offset host less remote [ns], from round trips: the request left when the host's clock read `sent`, the reply has
    the reading of the remote clock, and arrived when the host's clock read `receive`.

    So the offset is at most receive - remote, and at least sent - remote. Latency only ever loosens these bounds, so a slow
    trip does no harm. The tightest of each, as a line with drift, is an `OffsetFloor`. Receipts of samples bound the offset
    from above as well. It is the middle between the bounds, and half the distance between them is its uncertainty.
    """

    def __init__(self) -> None:
        self.taken = self.deviating = 0
        self._bounds: tuple[OffsetFloor, OffsetFloor] | None = None  # of the offset from above, of its negative
        self._consecutive = 0  # deviating trips in a row

    def add(self, remote: int, sent: int, receive: int) -> None:
        """Learn from a round trip, unless it deviates."""
        if receive < sent:
            self.deviating += 1
            return
        if self._bounds is not None:
            above, below = self._bounds
            known = (above.at(receive) - below.at(receive)) // 2
            if not sent - remote - MAX_DEVIATION <= known <= receive - remote + MAX_DEVIATION:
                self.deviating += 1
                self._consecutive += 1
                if self._consecutive < DEVIATIONS:
                    return
                self._bounds = None
        self._consecutive = 0
        self.taken += 1
        if self._bounds is None:
            self._bounds = OffsetFloor(receive, receive - remote), OffsetFloor(receive, remote - sent)
        else:
            above, below = self._bounds
            above.add(receive, receive - remote)
            below.add(receive, remote - sent)

    def bounds(self, receive: int, most: int) -> tuple[int, int] | None:
        """The least and the largest offset when the host's clock reads `receive`, where receipts of samples say it is at
        most `most`; None before the first round trip. Their intersection is empty where the two contradict each other: the
        least is then the larger one (THEORY A6)."""
        if self._bounds is None:
            return None
        above, below = self._bounds
        return -below.at(receive), min(above.at(receive), most)
