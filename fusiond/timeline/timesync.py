"""The offset between the host's clock and a remote one, of questions asked and answered (MAVLink TIMESYNC)."""

from __future__ import annotations

from fusiond.timeline.least_offset import OffsetFloor

MILLISECOND = 1_000_000  # ns
LONGEST = 10 * MILLISECOND  # a round trip that takes longer is too inaccurate (as in PX4)
DEVIATION = 20 * MILLISECOND  # no two good round trips of steady clocks can differ by so much
DEVIATIONS = 5  # so many in a row that do: a clock has moved, and everything is learnt anew (as PX4)


class RoundTrips:
    """host less remote [ns], by round trips: asked when the host's clock read `sent`, answered with the remote clock's
    reading, heard when the host's read `receive`.

    So the offset is at most receive - remote, and at least sent - remote. Latency only ever loosens these bounds; the least
    of each, as a line with drift, is an `OffsetFloor`. The offset is the middle between the two.
    """

    def __init__(self) -> None:
        self.taken = self.slow = self.deviating = 0
        self._bounds: tuple[OffsetFloor, OffsetFloor] | None = None  # of the offset from above, of its negative
        self._row = 0  # deviations in a row

    def add(self, remote: int, sent: int, receive: int) -> None:
        """Take in a round trip, unless it was slow or deviates."""
        if not 0 <= receive - sent <= LONGEST:
            self.slow += 1
            return
        known = self.at(receive)
        if known is not None and abs((sent + receive) // 2 - remote - known) > DEVIATION:
            self.deviating += 1
            self._row += 1
            if self._row < DEVIATIONS:
                return
            self._bounds = None
        self._row = 0
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
