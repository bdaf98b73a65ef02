"""The summary of a replay: what arrived, how late, what became of it, how good the result is; as struct and as text."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime

import msgspec
from msgspec import Struct

from fusiond.app.replay.comparison import Errors, TruthReport
from fusiond.app.replay.statistics import Histogram
from fusiond.estimator.solution import Mode
from fusiond.messages.types import StateMessage
from fusiond.timeline.clock import ClockReport

LATENCY_STEP_MS, LATENCY_LIMIT_MS = 0.1, 10_000.0  # bins of the latency histograms and where they end
BATCH = 1024
MAX_STRETCHES = 50  # stretches of dead reckoning that are told one by one


class Latency(Struct, frozen=True, kw_only=True):
    """Receipt less the instant measured [ms], configured delays included. Quantiles are right to 0.05 ms."""

    min: float
    p50: float
    p90: float
    p99: float
    max: float


class SourceReport(Struct, frozen=True, kw_only=True):
    """What became of the events of one source, by the last word on each. The outcomes and `withheld` add up to
    `events`."""

    events: int
    fused: int
    rejected: int
    too_old: int
    duplicate: int
    invalid: int
    waiting: int
    withheld: int
    invalid_reasons: dict[str, int]
    latency_ms: Latency | None  # None where no event was usable


class Span(Struct, frozen=True, kw_only=True):
    """From the first event's receipt to the last one's."""

    first_ns: int
    last_ns: int
    seconds: float


class Publications(Struct, frozen=True, kw_only=True):
    """The ticks of a replay. In a hole of the recording ticks stop after a minute; those left out are counted."""

    rate_hz: float
    rows: int
    skipped: int
    modes: dict[str, int]  # rows by mode


class Stretch(Struct, frozen=True, kw_only=True):
    """A stretch of dead reckoning: from the last position fix before it to the first after it."""

    start_s: float  # from the first event
    stop_s: float
    distance_m: float  # travelled, by the published velocity
    sigma_m: float  # horizontal, root sum of squares of the north and east sigma, at its end
    error_m: float | None  # horizontal, at its end; None without a truth


class DeadReckoning(Struct, frozen=True, kw_only=True):
    """All the stretches; `stretches` are the first of them."""

    count: int
    seconds: float
    stretches: list[Stretch]


class Summary(Struct, frozen=True, kw_only=True):
    """Everything a replay tells at its end. The same inputs give the same bytes: no clock and no path is in it."""

    fusiond: str  # version
    config: str  # name of the file
    vehicle: str
    logs: dict[str, dict[str, int]]  # what the readers met, by file name
    warnings: list[str]
    span: Span
    events: int
    clock_pairs: int  # events that only teach the clock
    rerun: int  # events run again because another came late
    sources: dict[str, SourceReport]
    clocks: dict[str, ClockReport]
    final: StateMessage
    published: Publications | None = None
    dead_reckoning: DeadReckoning | None = None
    truth: TruthReport | None = None


def to_json(summary: Summary) -> bytes:
    """The summary as indented JSON, with a line's end."""
    return msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n"


# --- Gathering


class Latencies:
    """The latencies of one source."""

    def __init__(self) -> None:
        self._histogram = Histogram(LATENCY_STEP_MS, LATENCY_LIMIT_MS)
        self._new: list[int] = []  # ns, not in the histogram yet

    def add(self, latency_ns: int) -> None:
        new = self._new
        new.append(latency_ns)
        if len(new) == BATCH:
            self._gather()

    def _gather(self) -> None:
        """Alike ones, as all of a stream without stamps are, go into the histogram together."""
        for latency_ns, count in Counter(self._new).items():
            self._histogram.add(latency_ns / 1e6, count)
        self._new.clear()

    def report(self) -> Latency | None:
        self._gather()
        histogram = self._histogram
        if not histogram.count:
            return None
        p50, p90, p99 = (round(histogram.quantile(share), 2) for share in (0.5, 0.9, 0.99))
        return Latency(min=histogram.minimum, p50=p50, p90=p90, p99=p99, max=histogram.maximum)


class DeadReckoningLog:
    """Watches the publications for stretches of dead reckoning."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s  # the mode changes so long after the last fix
        self._stretches: list[Stretch] = []
        self._count = 0
        self._seconds = 0.0
        self._path: deque[tuple[float, float]] = deque()  # (second, distance so far) of the last `timeout_s`
        self._begun: tuple[float, float] | None = None  # second, distance so far
        self._last: tuple[float, float, float, float | None] | None = None  # second, distance, sigma, error

    def add(self, since_start_ns: int, message: StateMessage, errors: Errors | None) -> None:
        """Take one publication; they must come in order of time."""
        state, second = message.state, since_start_ns / 1e9
        reckoned = message.mode is Mode.DEAD_RECKONING and state is not None
        if self._begun is not None and not reckoned:
            self._close(second)
        if state is None:
            self._path.clear()
            return
        before = self._path[-1] if self._path else (second, 0.0)
        distance = before[1] + math.hypot(*state.velocity_ned_mps[:2]) * (second - before[0])
        self._path.append((second, distance))
        while self._path[0][0] < second - self._timeout_s:
            self._path.popleft()
        if reckoned:
            if self._begun is None:
                self._begun = self._path[0]
            sigma = math.hypot(*state.sigma_position_ned_m[:2])
            self._last = second, distance, sigma, errors.horizontal_m if errors else None

    def _close(self, stop_s: float) -> None:
        assert self._begun is not None and self._last is not None
        start_s, start_m = self._begun
        _, stop_m, sigma, error = self._last
        self._count += 1
        self._seconds += stop_s - start_s
        if len(self._stretches) < MAX_STRETCHES:
            stretch = Stretch(start_s=start_s, stop_s=stop_s, distance_m=stop_m - start_m, sigma_m=sigma, error_m=error)
            self._stretches.append(stretch)
        self._begun = self._last = None

    def report(self) -> DeadReckoning:
        """The stretches; one that is still open ends with the last publication."""
        if self._last is not None:
            self._close(self._last[0])
        return DeadReckoning(count=self._count, seconds=self._seconds, stretches=list(self._stretches))


def source_report(
    withheld: int, outcomes: Mapping[str, int], reasons: Mapping[str, int], latency: Latency | None
) -> SourceReport:
    """`outcomes`: counts by Outcome's names."""
    counts = {name.lower(): count for name, count in outcomes.items()}
    return SourceReport(
        events=sum(counts.values()) + withheld,
        withheld=withheld,
        invalid_reasons=dict(sorted(reasons.items())),
        latency_ms=latency,
        **counts,
    )


# --- Telling


def text(summary: Summary) -> str:
    """The summary for a reader at a terminal."""
    return "\n".join(_lines(summary))


def _lines(summary: Summary) -> Iterator[str]:
    span = summary.span
    first = datetime.fromtimestamp(span.first_ns // 10**9, UTC)
    logs = ", ".join(summary.logs)
    yield f"{summary.vehicle}: {span.seconds:.1f} s from {first:%Y-%m-%d %H:%M:%S} UTC out of {logs}"
    for warning in summary.warnings:
        yield f"warning: {warning}"
    yield ""
    yield from _source_table(summary.sources)
    yield from _remarks(summary)
    yield ""
    yield from _state(summary)
    if summary.published:
        yield from _published(summary.published)
    if summary.dead_reckoning:
        yield from _dead_reckoning(summary.dead_reckoning)
    if summary.truth:
        yield ""
        yield from _truth(summary.truth)


def _source_table(sources: Mapping[str, SourceReport]) -> Iterator[str]:
    """One line per source; columns of nothing but zeros are left out, except the first three."""
    names = ["events", "fused", "rejected", "too_old", "duplicate", "invalid", "waiting", "withheld"]
    shown = [n for n in names if n in names[:3] or any(getattr(source, n) for source in sources.values())]
    rows = [["source", *(name.replace("_", " ") for name in shown), "late by [ms]: median", "99 %", "most"]]
    for name, source in sources.items():
        late = source.latency_ms
        times = [f"{late.p50:.1f}", f"{late.p99:.1f}", f"{late.max:.1f}"] if late else ["-"] * 3
        rows.append([name, *(str(getattr(source, column)) for column in shown), *times])
    yield from table(rows)


def table(rows: list[list[str]]) -> Iterator[str]:
    """Rows as aligned lines: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(others, widths[1:], strict=True))]
        yield "  ".join(cells).rstrip()


def _remarks(summary: Summary) -> Iterator[str]:
    for name, source in summary.sources.items():
        if source.invalid_reasons:
            reasons = ", ".join(f"{reason} ({count})" for reason, count in source.invalid_reasons.items())
            yield f"  invalid of {name}: {reasons}"
        if source.too_old:
            yield f"  {name}: {source.too_old} came later than filter.horizon_s allows; a longer one would take them"
    if summary.rerun:
        yield f"  late events were put where they belong in time: {summary.rerun} events were run again after them"
    for name, clock in summary.clocks.items():
        if clock.note:
            yield f"  clock {name}: {clock.method.replace('_', ' ')}, because {clock.note}"
        if clock.resets or clock.strays:
            yield f"  clock {name}: {clock.resets} re-alignments after jumps, {clock.strays} stray stamps"


def _state(summary: Summary) -> Iterator[str]:
    message = summary.final
    state = message.state
    if state is None:
        yield f"final state    none: {message.fault or 'the filter never had enough data to start'}"
        return
    north, east, down = state.sigma_position_ned_m
    vn, ve, _ = state.velocity_ned_mps
    yield f"final state    {message.mode.value.replace('_', ' ')}, with one standard deviation:"
    yield f"  position     {state.lat_deg:.7f}, {state.lon_deg:.7f} deg, {state.height_m:.2f} m"
    yield f"               +- {north:.2f} m north, {east:.2f} m east, {down:.2f} m in height"
    yield f"  speed        {math.hypot(vn, ve):.2f} +- {state.sigma_velocity_mps:.2f} m/s"
    yield f"  heading      {state.yaw_deg % 360:.2f} +- {state.sigma_yaw_deg:.2f} deg"
    yield f"  wheel scale  {100 * state.wheel_scale:+.2f} +- {100 * state.sigma_wheel_scale:.2f} %"


def _published(published: Publications) -> Iterator[str]:
    modes = ", ".join(f"{count} {mode.replace('_', ' ')}" for mode, count in published.modes.items())
    skipped = f"; {published.skipped} left out in holes of the recording" if published.skipped else ""
    yield f"published      {published.rows} states at {published.rate_hz:g} Hz: {modes or 'none'}{skipped}"


def _dead_reckoning(found: DeadReckoning) -> Iterator[str]:
    for stretch in found.stretches[:5]:
        off = "" if stretch.error_m is None else f", {stretch.error_m:.2f} m off the truth"
        yield (
            f"dead reckoning from {stretch.start_s:.1f} to {stretch.stop_s:.1f} s, over {stretch.distance_m:.0f} m:"
            f" ended with a sigma of {stretch.sigma_m:.2f} m{off}"
        )
    if found.count > 5:
        yield f"               and {found.count - 5} more times; {found.seconds:.0f} s in all"


def _truth(truth: TruthReport) -> Iterator[str]:
    position, heading = truth.position, truth.heading
    offset = math.hypot(position.offset_north_m, position.offset_east_m)
    yield (
        f"against the truth, seconds {truth.start_s:.1f} to {truth.stop_s:.1f}:"
        f" {truth.rows} states over {truth.distance_m:.0f} m"
    )
    yield from table(
        [
            ["", "RMSE", "95 % below", "unit", ""],
            ["  horizontal position", f"{position.rmse_m:.3f}", f"{position.p95_m:.3f}", "m", ""],
            ["    mean offset removed", f"{position.rmse_offset_removed_m:.3f}", "", "m", f"offset {offset:.3f} m"],
            ["  height", f"{truth.height_rmse_m:.3f}", "", "m", ""],
            ["  horizontal velocity", f"{truth.velocity_rmse_mps:.3f}", f"{truth.velocity_p95_mps:.3f}", "m/s", ""],
            [
                "  heading, mean offset removed",
                f"{heading.rmse_deg:.3f}",
                f"{heading.p95_deg:.3f}",
                "deg",
                f"offset {heading.offset_deg:.3f} deg",
            ],
        ]
    )
    share = position.end_m / truth.distance_m if truth.distance_m else 0.0
    yield f"  {position.end_m:.2f} m off at the end, {100 * share:.2f} % of the way; {position.max_m:.2f} m at most"
    yield f"  {100 * position.inside_95:.1f} % of the states lie inside their own 95 % ellipse (95 or more is honest)"
