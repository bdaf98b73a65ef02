"""Arguments of the command line: intervals in seconds from the first event, and sources withheld in them."""

from __future__ import annotations

import re
from typing import NamedTuple

from fusiond.config.schema import Config
from fusiond.errors import UsageError
from fusiond.units import nanoseconds

INTERVAL = re.compile(r"(\d+(?:\.\d*)?)-(\d+(?:\.\d*)?)")


class Withheld(NamedTuple):
    """Sources withheld from `start_ns` until before `stop_ns`, counted from the first event's receipt."""

    sources: frozenset[str]
    start_ns: int
    stop_ns: int


def parse_interval(text: str) -> tuple[float, float]:
    """`START-STOP` in seconds. Raises UsageError."""
    found = INTERVAL.fullmatch(text)
    if not found or not float(found[1]) < float(found[2]):
        raise UsageError(f"'{text}' is not an interval; give START-STOP in seconds from the first event, such as 12-22")
    return float(found[1]), float(found[2])


def parse_withheld(text: str, config: Config) -> Withheld:
    """`SOURCE:START-STOP`; SOURCE is the full name of a source, or of a sensor with all its sources. Raises UsageError."""
    name, colon, interval = text.partition(":")
    if not colon:
        raise UsageError(f"--withhold {text}: give SOURCE:START-STOP, such as gps0:12-22")
    sources = frozenset(source for source in config.sources() if name in (source, source.partition(".")[0]))
    if not sources:
        known = ", ".join(dict.fromkeys([*config.gnss, *config.sources()]))
        raise UsageError(f"--withhold {text}: there is no source '{name}'; configured: {known}")
    start_s, stop_s = parse_interval(interval)
    return Withheld(sources, nanoseconds(start_s), nanoseconds(stop_s))
