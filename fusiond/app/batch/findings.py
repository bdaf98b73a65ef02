"""What a finished batch says: counts, the comparison of two configurations, the worst drives. In one pass over the rows."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from fusiond.app.batch.row import Row
from fusiond.app.batch.significance import FIGURES, Comparison, Pairs

WORST = 20  # drives
SOME = 10  # drives that are not ok, and reasons, that are listed

Keyed = tuple[str, str, Row]  # drive, key, row


@dataclass(frozen=True, slots=True, order=True)
class Worst:
    """A drive among the worst: by the ratio to the baseline, or without one by the error."""

    badness: float
    drive: str
    figure: str  # by which it is
    baseline: float | None
    new: float | None


@dataclass(slots=True)
class Findings:
    """All that the summary tells."""

    drives: int = 0
    seconds: float = 0.0  # of all drives
    kilometres: float = 0.0
    statuses: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)  # why drives are not ok, without what differs from drive to drive
    examples: list[tuple[str, Row]] = field(default_factory=list)  # of them
    values: dict[str, dict[str, list[float]]] = field(default_factory=dict)  # by figure and role, for the distributions
    worst: list[Worst] = field(default_factory=list)  # the worst first
    comparison: Comparison | None = None
    unpaired: int = 0  # drives without a row in the baseline


def gather(rows: Iterable[Keyed], baseline: Iterable[Keyed] | None) -> Findings:
    """The findings of rows, both in the order of their drives."""
    found, pairs = Findings(), Pairs()
    worst: list[Worst] = []  # a heap
    for drive, row, old in _merged(rows, baseline):
        _count(found, drive, row)
        _keep_values(found, row, old)
        if baseline is not None and old is None:
            found.unpaired += 1
        if old is not None:
            pairs.add(old, row)
        bad = _regression(drive, row, old) if old is not None else _error(drive, row) if baseline is None else None
        if bad is not None:
            (heapq.heappush if len(worst) < WORST else heapq.heappushpop)(worst, bad)
    found.worst = sorted(worst, reverse=True)
    found.comparison = pairs.compared() if baseline is not None else None
    return found


def _merged(rows: Iterable[Keyed], baseline: Iterable[Keyed] | None) -> Iterator[tuple[str, Row, Row | None]]:
    """Each drive with its row in the baseline."""
    others = iter(baseline or ())
    other = next(others, None)
    for drive, _, row in rows:
        while other is not None and other[0] < drive:
            other = next(others, None)
        yield drive, row, other[2] if other is not None and other[0] == drive else None


def _count(found: Findings, drive: str, row: Row) -> None:
    found.drives += 1
    found.statuses[row.status] += 1
    found.seconds += row.seconds or 0.0
    found.kilometres += (row.distance_m or 0.0) / 1e3
    if row.status != "ok":
        found.reasons[_kind(row)] += 1
        if len(found.examples) < SOME:
            found.examples.append((drive, row))


def _kind(row: Row) -> str:
    """A reason without the file's name before it."""
    first, colon, rest = row.reason.partition(": ")
    return rest if colon and any(first.startswith(name) for name in (*row.logs, row.config)) else row.reason


def _keep_values(found: Findings, row: Row, old: Row | None) -> None:
    for role, one in (("new", row), ("baseline", old)):
        if one is not None and one.status == "ok":
            for figure in FIGURES:
                value = figure.of(one)
                if value is not None:
                    found.values.setdefault(figure.name, {}).setdefault(role, []).append(value)


def _regression(drive: str, row: Row, old: Row) -> Worst | None:
    """By how much the new configuration is worse, by the figure in which it is worst; None if it is nowhere."""
    if old.status != "ok":
        return None
    if row.status != "ok":
        return Worst(math.inf, drive, row.status, None, None)
    found = []
    for figure in FIGURES:
        before, after = figure.of(old), figure.of(row)
        if before is not None and after is not None and after > before:
            ratio = after / before if before > 0 else math.inf
            found.append(Worst(ratio, drive, figure.name, before, after))
    return max(found, default=None)


def _error(drive: str, row: Row) -> Worst | None:
    """How large the position error is, or what stands for it."""
    for figure in (FIGURES[0], FIGURES[-1]):
        value = figure.of(row)
        if value is not None:
            return Worst(value, drive, figure.name, None, value)
    return None
