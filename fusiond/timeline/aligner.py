"""The alignment of one clock: its stamps on the time line, a pure function of the stamps and receipts seen so far.

Each stamp is shifted: aligned = stamp + shift(stamp). The shift is steered towards an aim, which depends on the clock:

unix           trusted as it is (aim 0) while receipt - stamp is plausible: -FUTURE_TOLERANCE to PLAUSIBLE_LATENCY. The
               first stamp decides, so each has its result at once. Trust is lost only by three stamps in a row over
               TRUST_LOST_AFTER, and regained by a plausible re-alignment, or when the least offset creeps back. Without
               trust: least offset. A host ahead by less than PLAUSIBLE_LATENCY cannot be distinguished from a slow link.
boot + trips   (TIMESYNC) from boot to the host's clock by round trips, see `RoundTrips`, while that is plausible against
               the least offset and certain to STEP. With pairs it also gives the host's offset from Unix time, which is
               then the aim of Unix stamps, trusted or not: so stamps are right even if the host's clock is wrong.
boot + pairs   (SYSTEM_TIME) from boot to Unix by the least of Unix less boot, as boot is cut off to a millisecond, while
               Unix is trusted and the result is within STEP of the least offset: a pair that claims that the quickest
               sample of a link takes longer has a wrong Unix time. Else least offset. So a pair never steps a clock.
least offset   the least receipt - stamp of the clock, as a line with drift: see `OffsetFloor`.

The shift is a continuous, piecewise linear function of the sensor's stamp. It slews towards the aim by at most 1/20 of
elapsed sensor time (1/2 in the first second), and a piece is never altered. So order and intervals survive (for stamps
over 4 ns apart), a late fix is treated like the IMU sample of its own time, and a duplicate gets the very same t_ns.

A stamp that does not fit is judged by where it lies:
in the future  by more than FUTURE_TOLERANCE; latency cannot do that. Invalid, unless a second in a row agrees.
fallen         late by over PLAUSIBLE_LATENCY and FALL behind the newest stamp: a reboot, or a stray. Invalid, unless a
               second in a row agrees.
late           by as much, without a fall: a stalled link, or the host was set forward. Keeps its alignment; if it stays
               equally late for 2 s of both clocks (10 s where it is only SLOW), the clock has moved.
Consecutive stamps of one source that agree re-align the clock at once: a new epoch, counted, which may step either way. A
stamp of any source that fits ends every streak; but with a least offset not that of another source a little in the
future, which may just be the quicker one. A repeated stamp adds nothing.

A clock that drifts by more than a crystal can (see `DriftWatch`) is unusable: its stamps are invalid as long as it does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Literal

from fusiond.timeline.drift import LIMIT, DriftWatch
from fusiond.timeline.least_offset import BILLION, OffsetFloor
from fusiond.timeline.timesync import RoundTrips
from fusiond.units import MILLISECOND, SECOND

FUTURE_TOLERANCE = 50 * MILLISECOND  # an aligned stamp may lie this far after its receipt (host against GNSS time)
PLAUSIBLE_LATENCY = 2 * SECOND  # a stamp later than this (boot clock: beyond what is usual for its source) does not fit
FALL = SECOND  # a stamp this far behind the newest one is more than out of order
SLOW = 100 * MILLISECOND  # beyond the source's usual lateness: a congested link; if it lasts, the clock has moved
QUICKER = 500 * MILLISECOND  # one source may come this much sooner than another
CONSISTENT = 250 * MILLISECOND  # consecutive stamps agree on a new offset within this
PAIR_TOLERANCE = 20 * MILLISECOND  # a clock pair off by more is odd; two odd pairs that agree replace the estimate
TRUST_LOST_AFTER = 1_500 * MILLISECOND  # this span of stamps that do not fit, without one that does

PIECE = 50 * MILLISECOND  # minimum length of a linear piece of the shift
PIECES = 256  # pieces kept for old stamps: 6 s and more
STEP = 250 * MILLISECOND  # if the aim is farther off than this, and than slewing reaches, the shift steps: a re-alignment

EMPTY = 5 * MILLISECOND  # bounds that contradict each other by more are a fault; less is drift that was not learnt yet

UNUSABLE = "its clock drifts too fast"

Method = Literal["arrival", "unix", "timesync", "system_time", "least_offset"]


@dataclass(frozen=True, slots=True)
class ClockReport:
    """How one clock is aligned. `note` says why a better method is not in use."""

    method: Method
    offset_ns: int  # time line less the clock's stamp, latest
    drift_ppm: float  # how much faster the host's clock runs, by receipts
    jitter_ns: int  # mean of receipt less aligned stamp since the last re-alignment
    resets: int  # re-alignments after a jump or reboot
    strays: int  # stamps that were invalid
    samples: int
    note: str = ""
    bounds_ns: tuple[int, int] | None = None  # of the offset, by round trips and receipts, latest
    faults: int = 0  # how often these contradicted each other, so that nothing lay between them
    usable: bool = True  # False: it drifts by more than a crystal can, and its stamps are invalid


class _Verdict(Enum):
    FITS = auto()
    FUTURE = auto()
    FALLEN = auto()
    LATE = auto()
    SLOW = auto()


FITS = _Verdict.FITS  # nearly every stamp
_REASONS = {_Verdict.FUTURE: "stamped in the future", _Verdict.FALLEN: "clock jump"}
_CONFIRMATION = {  # number of consecutive stamps that agree, and the time that they span on both clocks
    _Verdict.FUTURE: (2, 0),
    _Verdict.FALLEN: (2, 0),
    _Verdict.LATE: (3, 2 * SECOND),
    _Verdict.SLOW: (3, 10 * SECOND),
}


@dataclass(slots=True)
class _Streak:
    """Consecutive stamps of one source that do not fit and agree on another offset."""

    verdict: _Verdict  # the first one's
    first_receive: int
    first_stamp: int
    last_stamp: int
    offset: int  # least receipt less stamp
    late: int  # least lateness
    count: int = 1

    def continued(self, verdict: _Verdict, receive: int, offset: int) -> bool:
        same = (verdict is _Verdict.FUTURE) == (self.verdict is _Verdict.FUTURE)
        return same and receive >= self.first_receive and abs(offset - self.offset) <= CONSISTENT


@dataclass(frozen=True, slots=True)
class _Piece:
    """A linear piece of the shift from stamp `start` to `end`, constant beyond."""

    start: int
    end: int
    shift: int  # at the start
    rate: int = 0  # ppb
    step: bool = False  # not joined to the piece before it

    def at(self, stamp: int) -> int:
        elapsed = (stamp if stamp < self.end else self.end) - self.start
        return self.shift + (elapsed * self.rate // BILLION if elapsed > 0 else 0)


class Aligner:
    """Places the stamps of one clock. `unix` is the aligner of the Unix clock; None for the Unix clock itself."""

    def __init__(self, unix: Aligner | None) -> None:
        self.samples = self.resets = self.strays = self.faults = 0
        self.complaint = ""  # why a better method is not in use
        self._unix = unix
        self._pieces: deque[_Piece] = deque(maxlen=PIECES)
        self._watch()

    def _watch(self) -> None:
        self._receipts = DriftWatch()  # of receipt less stamp, which rises where the host's clock is faster
        self._requests = DriftWatch()  # of stamp less request, which falls there

    def forget(self) -> None:
        """Forget all but the counts; the next stamp is like the first."""
        self.complaint = ""
        self._pieces.clear()
        self._watch()

    def _begin(self, stamp: int, receive: int, offset: int) -> None:
        """Forget everything; from here on, receipt less stamp is `offset` or more."""
        self._floor = OffsetFloor(receive, offset)
        self._streaks: dict[str, _Streak] = {}
        self._pairs: OffsetFloor | None = None  # unix less boot
        self._odd_pair: int | None = None
        self._trips = RoundTrips()
        self._bounds: tuple[int, int] | None = None  # of the offset, by the last round trip
        self._contradicted = False  # by the last round trip
        self.synchronised = False  # by round trips
        self.bridge: int | None = None  # for the Unix clock: its offset, by way of a synchronised boot clock
        self.bridge_half_width = 0  # ns, of the bounds of that offset
        self.trusted = self._unix is None and -FUTURE_TOLERANCE <= offset <= PLAUSIBLE_LATENCY  # boot: see learn_pair
        self._restart(_Piece(stamp, stamp, self._aim(receive)), stamp)

    def _restart(self, piece: _Piece, stamp: int) -> None:
        self._pieces.clear()
        self._pieces.append(piece)
        self._usual: dict[str, int] = {}  # least lateness of each source, where not 0
        self._epoch = self._newest = stamp
        self._latency = self._placed = 0

    @property
    def begun(self) -> bool:
        """Whether any stamp has come yet."""
        return bool(self._pieces)

    def floor_at(self, receive: int) -> int:
        """The least offset, where any stamp has come."""
        return self._floor.at(receive)

    @property
    def anchored(self) -> bool:
        """Whether the aim comes from round trips or Unix time, not from receipts."""
        if self.synchronised or self.bridge is not None:
            return True
        return self.trusted and (self._unix is None or self._unix.trusted)

    def _aim(self, receive: int) -> int:
        floor = self._floor.at(receive)
        if self._unix is None and not self.trusted:
            self.trusted = 0 <= floor <= PLAUSIBLE_LATENCY
        if not self.anchored:
            return floor
        aim = self._tripped(receive) if self.synchronised else self.bridge
        if aim is None:
            aim = self._pairs.at(receive) if self._pairs else 0
        return min(aim, floor + FUTURE_TOLERANCE)

    def _tripped(self, receive: int) -> int | None:
        """The offset by round trips, and by the receipts; None before the first trip."""
        bounds = self._trips.bounds(receive, self._floor.at(receive))
        return None if bounds is None else sum(bounds) // 2

    def place(self, source: str, stamp: int, receive: int) -> int | str:
        """Learn from a stamp. Returns it on the time line, or the reason why it is invalid."""
        offset = receive - stamp
        self.samples += 1
        self._receipts.add(receive, offset)
        if not self._pieces:
            self._begin(stamp, receive, offset)
        if self._receipts.drift or self._requests.drift:
            self.strays += 1
            return UNUSABLE
        last = self._pieces[-1]
        piece = last if last.start <= stamp <= last.end else self._piece(stamp, receive)
        aligned = stamp + piece.at(stamp)
        late = receive - aligned
        usual = self._usual.get(source, 0) if self._usual else 0
        verdict = FITS if -FUTURE_TOLERANCE <= late <= SLOW else self._judge(stamp, late, usual)
        if verdict is FITS:
            if self._streaks or late < usual:
                self._fits(source, late)
            self._floor.add(receive, offset)
        elif (agreed := self._agreed(verdict, source, stamp, receive, late)) is not None:
            self.resets += 1
            self._begin(stamp, receive, agreed)
            last = piece = self._pieces[-1]
            aligned = stamp + piece.shift
        elif verdict in _REASONS:
            self.strays += 1
            return _REASONS[verdict]
        if verdict is _Verdict.SLOW:
            self._floor.add(receive, offset)
        if piece.step:
            self.resets += 1
            self._restart(replace(piece, step=False), stamp)
        elif piece is not last and piece.end > last.end:
            self._pieces.append(piece)
        if stamp > self._newest:
            self._newest = stamp
        self._latency += receive - aligned
        self._placed += 1
        return aligned

    def peek(self, stamp: int, receive: int) -> int:
        """The stamp on the time line if it fits, else the receipt. Learns nothing."""
        if self._pieces:
            aligned = stamp + self._piece(stamp, receive).at(stamp)
            if -FUTURE_TOLERANCE <= receive - aligned <= PLAUSIBLE_LATENCY:
                return aligned
        return receive

    def _piece(self, stamp: int, receive: int) -> _Piece:
        """The piece that contains a stamp, or a new one that continues the last."""
        pieces = self._pieces
        last = pieces[-1]
        if stamp <= last.end:
            return last if stamp >= last.start else next((p for p in reversed(pieces) if stamp >= p.start), pieces[0])
        start, shift = self._newest, last.at(self._newest)  # none was placed after it
        end = max(stamp, start + PIECE)
        reach = (end - start) // (2 if start - self._epoch < SECOND else 20)
        gap = self._aim(receive) - shift
        if abs(gap) > max(reach, STEP):
            return _Piece(stamp, end, shift + gap, step=True)
        return _Piece(start, end, shift, max(-reach, min(reach, gap)) * BILLION // (end - start))

    def _judge(self, stamp: int, late: int, usual: int) -> _Verdict:
        if late < -FUTURE_TOLERANCE:
            return _Verdict.FUTURE
        anchored = self.anchored
        excess = late if anchored else late - usual
        if excess <= PLAUSIBLE_LATENCY:
            return FITS if anchored or excess <= SLOW else _Verdict.SLOW
        return _Verdict.FALLEN if stamp < self._newest - usual - FALL else _Verdict.LATE

    def _fits(self, source: str, late: int) -> None:
        """The clock has not moved: sources that were slow are usually slow."""
        if self._streaks:
            self._usual |= {name: streak.late for name, streak in self._streaks.items() if streak.verdict is _Verdict.SLOW}
            quicker = {n: s for n, s in self._streaks.items() if n != source and s.verdict is _Verdict.FUTURE}
            if self.anchored:
                quicker.clear()
            self._streaks = {n: s for n, s in quicker.items() if s.late >= -QUICKER}
        if late < self._usual.get(source, 0):
            self._usual[source] = max(0, late)

    def _agreed(self, verdict: _Verdict, source: str, stamp: int, receive: int, late: int) -> int | None:
        """The offset to re-align to, if enough consecutive stamps of a source agree on one."""
        offset = receive - stamp
        streak = self._streaks.get(source)
        if streak is None or not streak.continued(verdict, receive, offset):
            self._streaks[source] = _Streak(verdict, receive, stamp, stamp, offset, late)
            return None
        if stamp == streak.last_stamp:
            return None
        streak.count += 1
        streak.last_stamp = stamp
        streak.offset = min(streak.offset, offset)
        streak.late = min(streak.late, late)
        count, span = _CONFIRMATION[streak.verdict]
        if self._unix is None and self.trusted:
            count, span = max(count, 3), max(span, TRUST_LOST_AFTER)
        agreed = streak.count >= count and min(receive - streak.first_receive, abs(stamp - streak.first_stamp)) >= span
        return streak.offset if agreed else None

    def learn_pair(self, unix_less_boot: int, receive: int) -> None:
        """Learn the difference of the Unix clock and this one, read at one instant."""
        pairs, odd = self._pairs, self._odd_pair
        self._odd_pair = None
        if pairs is None:
            self._pairs = pairs = OffsetFloor(receive, unix_less_boot)
        elif abs(unix_less_boot - pairs.at(receive)) <= PAIR_TOLERANCE:
            pairs.add(receive, unix_less_boot)
        elif odd is not None and abs(unix_less_boot - odd) <= PAIR_TOLERANCE:
            self._pairs = pairs = OffsetFloor(receive, unix_less_boot)
        else:
            self._odd_pair = unix_less_boot
            return
        future = pairs.at(receive) - self._floor.at(receive)
        share = 1 if self.trusted else 2
        self.trusted = -STEP // share <= future <= FUTURE_TOLERANCE // share
        self.complaint = "" if self.trusted else "SYSTEM_TIME contradicts receipts"

    def learn_trip(self, stamp: int, sent: int, receive: int) -> None:
        """Learn from a reading of this clock made between `sent` and `receive`."""
        if not self._pieces:
            return
        self._requests.add(receive, stamp - sent)
        self._trips.add(stamp, sent, receive)
        floor = self._floor.at(receive)
        if (bounds := self._trips.bounds(receive, floor)) is not None:
            if bounds[0] - bounds[1] > EMPTY:
                bounds = self._begin_trips(bounds, stamp, sent, receive)
            else:
                self._contradicted = False
            least, most = self._bounds = bounds
            future, uncertainty = (least + most) // 2 - floor, (most - least) // 2
            plausible = -PLAUSIBLE_LATENCY <= future <= FUTURE_TOLERANCE // (1 if self.synchronised else 2)
            self.synchronised = plausible and uncertainty <= STEP
            if not plausible:
                self.complaint = "TIMESYNC contradicts receipts"
            elif not self.synchronised:
                self.complaint = f"TIMESYNC is uncertain by {uncertainty // MILLISECOND} ms"

    def _begin_trips(self, bounds: tuple[int, int], stamp: int, sent: int, receive: int) -> tuple[int, int]:
        """Count bounds that contradict each other as a fault, and begin anew with the last round trip: one of the two clocks
        has moved. Returns the new bounds; those of the trip alone, where receipts contradict even these."""
        self.faults += not self._contradicted
        self._contradicted = True
        self.complaint = f"the bounds of its offset contradict each other by {(bounds[0] - bounds[1]) / MILLISECOND:.0f} ms"
        self._trips = RoundTrips()
        self._trips.add(stamp, sent, receive)
        anew = self._trips.bounds(receive, self._floor.at(receive))
        return anew if anew is not None and anew[0] <= anew[1] else (sent - stamp, receive - stamp)

    @property
    def half_width(self) -> int:
        """Of the bounds between which the offset in use lies [ns]; 0 where there are none."""
        if not self._pieces:
            return 0
        if self.bridge is not None:
            return self.bridge_half_width
        if not self.synchronised or self._bounds is None:
            return 0
        return max(0, self._bounds[1] - self._bounds[0]) // 2

    def bridge_to(self, unix: Aligner, receive: int) -> None:
        """Set the Unix clock's offset from the host's, if this clock's offset from both is known."""
        offset = self._tripped(receive) if self._pieces and self.synchronised and self._pairs else None
        if offset is not None and self._pairs and unix.begun:
            bridge = offset - self._pairs.at(receive)
            plausible = -STEP <= bridge - unix.floor_at(receive) <= FUTURE_TOLERANCE
            unix.bridge = bridge if plausible else None
            unix.bridge_half_width = self.half_width

    @property
    def drift(self) -> int | None:
        """How much faster the host's clock runs [ppb], where that is beyond use."""
        requests = self._requests.drift
        return self._receipts.drift or (-requests if requests else None)

    def report(self) -> ClockReport:
        """How the clock is aligned at present."""
        offset = self._pieces[-1].at(self._newest) if self._pieces else 0
        method: Method = "least_offset"
        note = self.complaint
        if self._pieces and (self.synchronised or self.bridge is not None):
            method, note = "timesync", ""
        elif self.anchored:
            method = "unix" if self._unix is None else "system_time"
        elif self._unix is None:
            note = f"host clock and Unix stamps differ by {offset / SECOND:+.3f} s"
        elif self._pairs and not self._unix.trusted:
            note = "SYSTEM_TIME: Unix time is not trusted"
        jitter = self._latency // max(1, self._placed)
        drift, usable = self._floor.slope, self.drift is None
        if self.drift is not None:
            drift, speed = self.drift, 1 - self.drift / BILLION
            note = f"unusable: it runs {speed:.4f} times as fast as the host's; {LIMIT // 1000} ppm are possible"
        bounds = self._bounds if self._pieces and self.synchronised else None
        return ClockReport(
            method, offset, drift / 1e3, jitter, self.resets, self.strays, self.samples, note, bounds, self.faults, usable
        )
