"""Outages on purpose: stretches of a drive in which GNSS is withheld, and how far off the state is at the end of each.

The first replay tells the course of the drive, and so where outages of a given length or duration begin and end. The second
one is without GNSS in them. The error is against the truth or, without one, against the first replay, which had GNSS.
"""

from __future__ import annotations

import math
import re
from array import array
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

from fusiond.app.batch.row import OutageRow
from fusiond.app.replay.comparison import Errors
from fusiond.app.replay.intervals import Withheld
from fusiond.app.replay.truth import displacement
from fusiond.config.schema import Config
from fusiond.errors import UsageError
from fusiond.messages import StateMessage
from fusiond.units import SECOND, nanoseconds

SPACING_S = 20.0  # with GNSS before the first outage and between two
LEAST_M = 50.0  # travelled in an outage; the share of a shorter distance says nothing
LENGTH = re.compile(r"(\d+(?:\.\d*)?)(s|m)")


class Length(NamedTuple):
    """Of an outage: one of the two is infinite."""

    seconds: float
    metres: float


def parse_length(text: str) -> Length:
    """`60s` or `1000m`. Raises UsageError."""
    found = LENGTH.fullmatch(text)
    if not found or not float(found[1]) > 0:
        raise UsageError(f"'{text}' is not the length of an outage; give seconds or metres, such as 60s or 1000m")
    value = float(found[1])
    return Length(value, math.inf) if found[2] == "s" else Length(math.inf, value)


class Course:
    """Where the states of a replay were, in their order of time; those of a session that steps back are left out."""

    def __init__(self) -> None:
        self.distance_m = 0.0  # by the published velocities
        self._stamps, self._places = array("q"), array("d")  # ns; lat, lon [deg], height, distance so far [m]

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, message: StateMessage, _: Errors | None) -> None:
        """Add a published state."""
        state = message.state
        if state is None or (self._stamps and message.t_ns <= self._stamps[-1]):
            return
        if self._stamps:
            self.distance_m += math.hypot(*state.velocity_ned_mps[:2]) * (message.t_ns - self._stamps[-1]) / SECOND
        self._stamps.append(message.t_ns)
        self._places.extend((state.lat_deg, state.lon_deg, state.height_m, self.distance_m))

    def t_ns(self, number: int) -> int:
        """The instant of a state."""
        return self._stamps[number]

    def place(self, number: int) -> tuple[float, float, float, float]:
        """Latitude, longitude [deg], height and distance so far [m] of a state."""
        lat, lon, height, distance = self._places[4 * number : 4 * number + 4]
        return lat, lon, height, distance

    def from_instant(self, t_ns: float) -> int:
        """The number of the first state that is not before an instant; their number if there is none."""
        return bisect_left(self._stamps, t_ns)


class Spell(NamedTuple):
    """An outage, from a state to another, by their numbers."""

    start: int
    stop: int


def intervals(course: Course, length: Length) -> list[Spell]:
    """As many outages as fit, each with SPACING_S before it."""
    found: list[Spell] = []
    if not len(course):
        return found
    start = course.from_instant(course.t_ns(0) + SPACING_S * SECOND)
    while start < len(course):
        until_ns, until_m = course.t_ns(start) + length.seconds * SECOND, course.place(start)[3] + length.metres
        stop = start
        while stop < len(course) and course.t_ns(stop) < until_ns and course.place(stop)[3] < until_m:
            stop += 1
        if stop == len(course):
            break
        found.append(Spell(start, stop))
        start = course.from_instant(course.t_ns(stop) + SPACING_S * SECOND)
    return found


class Outages:
    """Collects the errors at the ends of outages from the states of the second replay."""

    def __init__(self, spells: Sequence[Spell], course: Course, first_ns: int) -> None:
        self.rows: list[OutageRow] = []
        self._course, self._first_ns = course, first_ns
        self._ends = {course.t_ns(spell.stop): spell for spell in spells}

    def withheld(self, config: Config) -> tuple[Withheld, ...]:
        """What the second replay withholds: every source of every receiver."""
        names = {*config.gnss, *config.dual_antenna}
        sources = frozenset(source for source in config.sources() if source.partition(".")[0] in names)
        step = nanoseconds(1e-3)  # the state at the end of an outage is made before the next fix
        return tuple(
            Withheld(sources, self._course.t_ns(spell.start) - self._first_ns, end_ns - self._first_ns + step)
            for end_ns, spell in self._ends.items()
        )

    def add(self, message: StateMessage, errors: Errors | None) -> None:
        """Add a published state of the second replay."""
        spell = self._ends.get(message.t_ns)
        if spell is None or message.state is None or len(self.rows) == len(self._ends):
            return
        state, begin, end = message.state, self._course.place(spell.start), self._course.place(spell.stop)
        north, east = displacement(state.lat_deg, state.lon_deg, end[:2], end[2])
        self.rows.append(
            OutageRow(
                start_s=(self._course.t_ns(spell.start) - self._first_ns) / SECOND,
                stop_s=(message.t_ns - self._first_ns) / SECOND,
                distance_m=end[3] - begin[3],
                error_m=errors.horizontal_m if errors else math.hypot(north, east),
                sigma_m=math.hypot(*state.sigma_position_ned_m[:2]),
            )
        )


def shares(rows: Sequence[OutageRow]) -> list[float]:
    """The errors in percent of the distance, in rising order."""
    return sorted(100 * row.error_m / row.distance_m for row in rows if row.distance_m >= LEAST_M)


def percentile(rising: Sequence[float], share: float) -> float | None:
    """The smallest value that at least this share of all does not exceed; None of nothing."""
    return rising[max(0, math.ceil(share * len(rising)) - 1)] if rising else None
