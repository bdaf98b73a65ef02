"""The offset between the host's clock and a remote one, from round trips (MAVLink TIMESYNC)."""

from __future__ import annotations

from fusiond.timeline.least_offset import OffsetFloor
from fusiond.units import MILLISECOND

MAX_TRIP = 10 * MILLISECOND  # a longer round trip is too inaccurate (as in PX4)
MAX_DEVIATION = 20 * MILLISECOND  # two good round trips of steady clocks differ by less
DEVIATIONS = 5  # after this many deviating trips in a row the clock has moved, and learning restarts (as in PX4)


class RoundTrips:
    """Offset host less remote [ns], from round trips: the request left when the host's clock read `sent`, the reply has
    the reading of the remote clock, and arrived when the host's clock read `receive`.

    So the offset is at most receive - remote, and at least sent - remote. Latency only ever loosens these bounds. The
    tightest of each, as a line with drift, is an `OffsetFloor`. The offset is the middle between the two.
    """

    def __init__(self) -> None:
        self.taken = self.slow = self.deviating = 0
        self._bounds: tuple[OffsetFloor, OffsetFloor] | None = None  # of the offset from above, of its negative
        self._consecutive = 0  # deviating trips in a row

    def add(self, remote: int, sent: int, receive: int) -> None:
        """Learn from a round trip, unless it is slow or deviates."""
        if not 0 <= receive - sent <= MAX_TRIP:
            self.slow += 1
            return
        known = self.at(receive)
        if known is not None and abs((sent + receive) // 2 - remote - known) > MAX_DEVIATION:
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

    def at(self, receive: int) -> int | None:
        """The offset when the host's clock reads `receive`; None before the first good round trip."""
        if self._bounds is None:
            return None
        above, below = self._bounds
        return (above.at(receive) - below.at(receive)) // 2
