"""Outages of GNSS in a replay: the drive is replayed several times, each time with GNSS withheld over stretches of one
length, and the errors at their ends are gathered.

Makers of dead-reckoning receivers give the 68th percentile of that error, in percent of the distance. The stretches of a
replay lie RECOVERY_S apart, so that the filter has learnt again what GNSS teaches; those of the next replay begin a part of
the length later. Where they overlap, their errors are alike.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from msgspec import Struct

from fusiond.app.replay.comparison import USUAL_SHARE, Errors
from fusiond.app.replay.intervals import Withheld
from fusiond.app.replay.truth import Truth, displacement
from fusiond.config.schema import Config
from fusiond.errors import UsageError
from fusiond.estimator.solution import Mode
from fusiond.messages.types import StateMessage
from fusiond.units import SECOND, nanoseconds

RECOVERY_S = 60.0  # with GNSS before an outage
PASSES = 8  # replays
LEAST_DISTANCE_M = 1.0  # of an outage that counts: a drift in percent needs motion

LENGTH = re.compile(r"(\d+(?:\.\d*)?)(m|s)")


class Length(NamedTuple):
    """How long outages are: metres driven, or seconds."""

    value: float
    unit: str  # m or s

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"


def parse_length(text: str) -> Length:
    """`1000m` or `60s`. Raises UsageError."""
    found = LENGTH.fullmatch(text)
    if not found or not float(found[1]) > 0:
        raise UsageError(f"'{text}' is not the length of an outage; give metres or seconds, such as 1000m or 60s")
    return Length(float(found[1]), found[2])


class Stretch(NamedTuple):
    """One outage: seconds from the first event, and metres driven."""

    start_s: float
    stop_s: float
    distance_m: float


class Waypoint(NamedTuple):
    """How far the vehicle has come at a time: seconds from the first event, metres."""

    second: float
    travelled_m: float


def course(truth: Truth, origin_ns: int) -> list[Waypoint]:
    """The reference track as waypoints, in order of time."""
    found, travelled = [], 0.0
    samples = iter(truth)
    before = next(samples, None)
    if before is None:
        return []
    found.append(Waypoint((before.t_ns - origin_ns) / SECOND, 0.0))
    for sample in samples:
        travelled += math.hypot(
            *displacement(sample.lat_deg, sample.lon_deg, (before.lat_deg, before.lon_deg), before.height_m)
        )
        found.append(Waypoint((sample.t_ns - origin_ns) / SECOND, travelled))
        before = sample
    return found


def plan(points: Sequence[Waypoint], length: Length, begin_s: float) -> list[list[Stretch]]:
    """The outages of each pass: none begins before `begin_s`, and each lies whole within the course. Passes without any are
    left out."""
    seconds = [point.second for point in points]
    progress = [point.travelled_m for point in points] if length.unit == "m" else seconds
    first = bisect_left(seconds, begin_s)
    if first == len(points):
        return []
    passes = []
    for number in range(PASSES):
        wanted, stretches = progress[first] + number / PASSES * length.value, []
        while (start := bisect_left(progress, wanted)) < len(points):
            stop = bisect_left(progress, progress[start] + length.value)
            if stop == len(points):
                break
            driven = points[stop].travelled_m - points[start].travelled_m
            if driven >= LEAST_DISTANCE_M:
                stretches.append(Stretch(seconds[start], seconds[stop], driven))
            following = bisect_left(seconds, seconds[stop] + RECOVERY_S)
            if following == len(points):
                break
            wanted = progress[following]
        if stretches:
            passes.append(stretches)
    return passes


def withheld(stretches: Iterable[Stretch], config: Config) -> list[Withheld]:
    """All sources of all receivers, withheld over the stretches."""
    receivers = {*config.gnss, *config.dual_antenna}
    sources = frozenset(source for source in config.sources() if source.partition(".")[0] in receivers)
    return [Withheld(sources, nanoseconds(one.start_s), nanoseconds(one.stop_s)) for one in stretches]


class Outage(Struct, frozen=True, kw_only=True):
    """One outage, and the last state published in it."""

    start_s: float  # from the first event
    stop_s: float
    distance_m: float  # driven, by the truth
    error_m: float  # horizontal
    sigma_m: float  # claimed for it: root sum of squares of the north and east sigma
    inside_95: bool  # the truth lies in the 95 % ellipse of the published covariance

    @property
    def percent(self) -> float:
        """The error in percent of the distance."""
        return 100 * self.error_m / self.distance_m


class OutageReport(Struct, frozen=True, kw_only=True):
    """The errors after outages of one length. Quantiles are the least error that so large a share does not exceed."""

    length: str
    count: int
    without_state: int  # outages at whose end no state was published, or no truth is known
    p50_percent: float  # of the distance driven in the outage
    p68_percent: float
    p95_percent: float
    max_percent: float
    p68_m: float
    inside_95: float  # share of the ends inside the 95 % ellipse of the published covariance
    outages: list[Outage]


class OutageLog:
    """Collects the last state of each outage of one pass."""

    def __init__(self, stretches: Sequence[Stretch]) -> None:
        self._ends: list[Outage | None] = [None] * len(stretches)
        self._stretches, self._next = stretches, 0

    def add(self, since_start_ns: int, message: StateMessage, errors: Errors | None) -> None:
        """Add one publication; they must come in order of time."""
        second = since_start_ns / SECOND
        while self._next < len(self._stretches) and self._stretches[self._next].stop_s <= second:
            self._next += 1
        if self._next == len(self._stretches) or second < self._stretches[self._next].start_s:
            return
        if errors is None or message.state is None or message.mode is Mode.ALIGNING:
            self._ends[self._next] = None
            return
        stretch = self._stretches[self._next]
        self._ends[self._next] = Outage(
            start_s=stretch.start_s,
            stop_s=stretch.stop_s,
            distance_m=stretch.distance_m,
            error_m=errors.horizontal_m,
            sigma_m=math.hypot(*message.state.sigma_position_ned_m[:2]),
            inside_95=errors.inside,
        )

    def ends(self) -> list[Outage | None]:
        """The last state of each; None where there was none, or no truth."""
        return self._ends


def quantile(values: Sequence[float], share: float) -> float:
    """The smallest value that at least this share of all does not exceed."""
    return sorted(values)[max(math.ceil(share * len(values) - 1e-9) - 1, 0)]


def report(length: Length, ends: Sequence[Outage | None]) -> OutageReport | None:
    """The errors of all passes; None if there is none."""
    found = [end for end in ends if end is not None]
    if not found:
        return None
    percents = [outage.percent for outage in found]
    return OutageReport(
        length=str(length),
        count=len(found),
        without_state=len(ends) - len(found),
        p50_percent=quantile(percents, 0.5),
        p68_percent=quantile(percents, USUAL_SHARE),
        p95_percent=quantile(percents, 0.95),
        max_percent=max(percents),
        p68_m=quantile([outage.error_m for outage in found], USUAL_SHARE),
        inside_95=sum(outage.inside_95 for outage in found) / len(found),
        outages=found,
    )
