"""The summary of a replay: events, latencies, outcomes and errors, as a struct and as text."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime

import msgspec
from msgspec import Struct

from fusiond.app.diagnosis.finding import Finding, lines
from fusiond.app.replay.comparison import AngleReport, Errors, TruthReport
from fusiond.app.replay.outages import OutageReport
from fusiond.app.replay.statistics import Histogram
from fusiond.estimator.solution import Mode
from fusiond.filter.source_health import Belief
from fusiond.messages.types import StateMessage
from fusiond.timeline.aligner import PLAUSIBLE_LATENCY, ClockReport
from fusiond.units import MILLISECOND, SECOND

LATENCY_STEP_MS, LATENCY_LIMIT_MS = 0.1, 10_000.0  # width and limit of the histogram's bins
BATCH = 1024  # latencies added to the histogram together
LONG_S = 5.0  # an event later than the horizon by more than this is not a matter of the horizon
MAX_STEPS = 5  # steps back that the text lists
MAX_STRETCHES = 50  # stretches of dead reckoning that are listed


class Latency(Struct, frozen=True, kw_only=True):
    """Receipt less the instant measured [ms], configured delays included. Quantiles are accurate to 0.05 ms."""

    min: float
    p50: float
    p90: float
    p99: float
    max: float


class TooOld(Struct, kw_only=True):
    """How late the events of a source were that came after the horizon, at the most."""

    late_s: float = 0.0  # receipt less the instant measured
    beyond_s: float = 0.0  # by how much the horizon was too short
    clock: str = ""  # that stamped them; empty if none did


class SourceReport(Struct, frozen=True, kw_only=True):
    """Counts of the events of one source by their last outcome. The outcomes and `withheld` add up to `events`."""

    events: int
    fused: int
    rejected: int
    too_old: int
    duplicate: int
    invalid: int
    waiting: int
    gathered: int
    withheld: int
    invalid_reasons: dict[str, int]
    latency_ms: Latency | None  # None if no event was usable
    lateness: TooOld | None = None  # of those that were too old
    remark: str = ""  # what is wrong with a wheel most of whose readings were rejected
    status: str = "nominal"  # what the filter believes of its health at the end: nominal, noisy, biased, frozen, absent
    reason: str = ""  # why, where it is not nominal


class Span(Struct, frozen=True, kw_only=True):
    """From the receipt of the first event to that of the last. `seconds` leaves out what the stamps stepped back."""

    first_ns: int
    last_ns: int
    seconds: float


class StepBack(Struct, frozen=True, kw_only=True):
    """Where the receipt stamps step back, and a new session begins."""

    at_s: float  # from the first event
    by_s: float


class Publications(Struct, frozen=True, kw_only=True):
    """The ticks of a replay. In a gap of the recording they stop after a minute; those skipped are counted."""

    rate_hz: float
    rows: int  # states
    skipped: int
    modes: dict[str, int]  # states by mode


class Stretch(Struct, frozen=True, kw_only=True):
    """A stretch of dead reckoning: from the last position fix before it to the first after it."""

    start_s: float  # from the first event
    stop_s: float
    distance_m: float  # travelled, by the published velocity
    sigma_m: float  # horizontal, root sum of squares of the north and east sigma, at its end
    error_m: float | None  # horizontal, at its end; None without a truth


class DeadReckoning(Struct, frozen=True, kw_only=True):
    """Number and total time of all stretches, and the first of them."""

    count: int
    seconds: float
    stretches: list[Stretch]


class JudgedSource(Struct, kw_only=True):
    """How the measurements of a source were judged by all others, before and after each."""

    used: int = 0
    left_out: int = 0
    dropped: int = 0  # of those left out: which the filter had fused, because it knew no better yet
    taken_back: int = 0  # of those used: which the filter had rejected


class SmoothedReport(Struct, frozen=True, kw_only=True):
    """What the smoother gave."""

    states: int  # smoothed
    runs: int  # times from an alignment to the next
    lost: int  # runs without a smoothed state: their numbers were no longer finite
    sigma_m: float | None  # horizontal, root mean square; None without a state
    filter_sigma_m: float | None  # the same of the filter's states at the same instants
    sources: dict[str, JudgedSource]
    truth: TruthReport | None = None  # how far the smoothed states lie from the truth


class Summary(Struct, frozen=True, kw_only=True):
    """The report of a replay. The same inputs give the same bytes: it has no wall-clock time and no path."""

    fusiond: str  # version
    config: str  # name of the file
    vehicle: str
    logs: dict[str, dict[str, int]]  # counts of the readers, by file name
    warnings: list[str]
    span: Span
    steps_back: list[StepBack] = []
    events: int
    clock_pairs: int  # events that are only for the clock
    rerun: int  # events run again because another was late
    sources: dict[str, SourceReport]
    clocks: dict[str, ClockReport]
    final: StateMessage
    published: Publications | None = None
    dead_reckoning: DeadReckoning | None = None
    truth: TruthReport | None = None
    outages: OutageReport | None = None
    smoothed: SmoothedReport | None = None
    findings: list[Finding] = []  # what the data say against the configuration, see docs/doctor.md


def to_json(summary: Summary) -> bytes:
    """The summary as indented JSON, with a line's end."""
    return msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n"


# --- Collecting


class Latencies:
    """The latencies of one source."""

    def __init__(self) -> None:
        self._histogram = Histogram(LATENCY_STEP_MS, LATENCY_LIMIT_MS)
        self._new: list[int] = []  # ns, not in the histogram yet

    def add(self, latency_ns: int) -> None:
        new = self._new
        new.append(latency_ns)
        if len(new) == BATCH:
            self._add_batch()

    def _add_batch(self) -> None:
        """Equal latencies, such as all of a source without stamps, are added to the histogram together."""
        for latency_ns, count in Counter(self._new).items():
            self._histogram.add(latency_ns / MILLISECOND, count)
        self._new.clear()

    def report(self) -> Latency | None:
        self._add_batch()
        histogram = self._histogram
        if not histogram.count:
            return None
        p50, p90, p99 = (round(histogram.quantile(share), 2) for share in (0.5, 0.9, 0.99))
        return Latency(min=histogram.minimum, p50=p50, p90=p90, p99=p99, max=histogram.maximum)


class DeadReckoningLog:
    """Collects the stretches of dead reckoning from the publications."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s  # the mode changes this long after the last fix
        self._stretches: list[Stretch] = []
        self._count = 0
        self._seconds = 0.0
        self._path: deque[tuple[float, float]] = deque()  # (second, distance so far) of the last `timeout_s`
        self._begun: tuple[float, float] | None = None  # second, distance so far
        self._last: tuple[float, float, float, float | None] | None = None  # second, distance, sigma, error

    def add(self, since_start_ns: int, message: StateMessage, errors: Errors | None) -> None:
        """Add one publication; they must come in order of time."""
        state, second = message.state, since_start_ns / SECOND
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
        """The stretches. One that has not ended yet ends with the last publication."""
        if self._last is not None:
            self._close(self._last[0])
        return DeadReckoning(count=self._count, seconds=self._seconds, stretches=list(self._stretches))


def source_report(
    withheld: int,
    outcomes: Mapping[str, int],
    reasons: Mapping[str, int],
    latency: Latency | None,
    lateness: TooOld | None = None,
    remark: str = "",
    belief: Belief | None = None,
) -> SourceReport:
    """`outcomes`: counts by Outcome's names; `belief`: in its health at the end."""
    counts = {name.lower(): count for name, count in outcomes.items()}
    return SourceReport(
        events=sum(counts.values()) + withheld,
        withheld=withheld,
        invalid_reasons=dict(sorted(reasons.items())),
        latency_ms=latency,
        lateness=lateness,
        remark=remark,
        status=belief.status if belief else "nominal",
        reason=belief.reason if belief else "",
        **counts,
    )


# --- Text


def text(summary: Summary) -> str:
    """The summary for a reader at a terminal."""
    return "\n".join(_lines(summary))


def _lines(summary: Summary) -> Iterator[str]:
    span = summary.span
    first = datetime.fromtimestamp(span.first_ns // SECOND, UTC)
    logs = ", ".join(summary.logs)
    yield f"{summary.vehicle}: {span.seconds:.1f} s from {first:%Y-%m-%d %H:%M:%S} UTC out of {logs}"
    for warning in summary.warnings:
        yield f"warning: {warning}"
    for step in summary.steps_back[:MAX_STEPS]:
        yield (
            f"warning: at {step.at_s:.1f} s the receipt stamps step back by {step.by_s:.1f} s: a new session begins there,"
            " with clocks and state aligned again"
        )
    if len(summary.steps_back) > MAX_STEPS:
        yield f"warning: and {len(summary.steps_back) - MAX_STEPS} more times"
    yield ""
    yield from _source_table(summary.sources)
    yield from _remarks(summary)
    yield ""
    yield from _state(summary)
    if summary.findings:
        yield ""
        yield from lines(summary.findings)
    if summary.published:
        yield from _published(summary.published)
    if summary.dead_reckoning:
        yield from _dead_reckoning(summary.dead_reckoning)
    if summary.truth:
        yield ""
        yield from truth_lines(summary.truth)
    if summary.smoothed:
        yield ""
        yield from smoothed_lines(summary.smoothed)
    if summary.outages:
        yield ""
        yield from _outages(summary.outages)


def details(summary: Summary) -> Iterator[str]:
    """What was read of each log, and how each clock was aligned, in lines."""
    for name, counts in summary.logs.items():
        yield f"log {name}: {', '.join(f'{count} {what}' for what, count in counts.items())}"
    for name, clock in summary.clocks.items():
        yield f"clock {name}: {clock.method.replace('_', ' ')}, {clock.resets} re-alignments, {clock.strays} stray stamps"


def _source_table(sources: Mapping[str, SourceReport]) -> Iterator[str]:
    """One line per source; columns of zeros are left out, except the first three."""
    names = ["events", "fused", "rejected", "too_old", "duplicate", "invalid", "waiting", "gathered", "withheld"]
    shown = [n for n in names if n in names[:3] or any(getattr(source, n) for source in sources.values())]
    lines = [["source", *(name.replace("_", " ") for name in shown), "late by [ms]: median", "99 %", "max"]]
    for name, source in sources.items():
        late = source.latency_ms
        times = [f"{late.p50:.1f}", f"{late.p99:.1f}", f"{late.max:.1f}"] if late else ["-"] * 3
        lines.append([name, *(str(getattr(source, column)) for column in shown), *times])
    yield from table(lines)


def table(lines: list[list[str]]) -> Iterator[str]:
    """Cells as aligned lines: the first column aligned left, the others right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for first, *others in lines:
        cells = [first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(others, widths[1:], strict=True))]
        yield "  ".join(cells).rstrip()


def _remarks(summary: Summary) -> Iterator[str]:
    for name, source in summary.sources.items():
        if source.invalid_reasons:
            reasons = ", ".join(f"{reason} ({count})" for reason, count in source.invalid_reasons.items())
            yield f"  invalid of {name}: {reasons}"
        if source.remark:
            yield f"  {name} is of no use: {source.remark}"
        elif source.status != "nominal":
            yield f"  {name} is {source.status} at the end: {source.reason}"
        if source.too_old:
            why = _why(source.lateness, summary.clocks)
            yield f"  {name}: {source.too_old} came later than filter.horizon_s allows{why}"
    if summary.rerun:
        yield f"  late events were fused at their own time: {summary.rerun} events were run again after them"
    for name, clock in summary.clocks.items():
        if clock.note:
            yield f"  clock {name}: {clock.method.replace('_', ' ')}, because {clock.note}"
        if clock.resets or clock.strays:
            yield f"  clock {name}: {clock.resets} re-alignments after jumps, {clock.strays} stray stamps"


def _why(lateness: TooOld | None, clocks: Mapping[str, ClockReport]) -> str:
    """Why events were too old, as far as it can be told, and what helps."""
    if lateness is None:
        return ""
    by = f", by up to {lateness.beyond_s:.2f} s"
    if lateness.late_s * SECOND > PLAUSIBLE_LATENCY and lateness.clock in clocks and clocks[lateness.clock].resets:
        return f"{by}: clock {lateness.clock} had jumped, and was not re-aligned yet; no horizon helps"
    if lateness.beyond_s > LONG_S:
        return f"{by}: look for a link that stalls, or a delay that is configured wrongly"
    return f"{by}; a horizon longer by that would use them"


def _state(summary: Summary) -> Iterator[str]:
    message = summary.final
    state = message.state
    if state is None:
        reasons = [one.text for one in summary.findings if one.weight == "no_state"]
        yield f"final state    none: {message.fault or '; '.join(reasons) or 'the filter never had enough data to start'}"
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
    skipped = f"; {published.skipped} skipped in gaps of the recording" if published.skipped else ""
    yield f"published      {published.rows} states at {published.rate_hz:g} Hz: {modes or 'none'}{skipped}"


def _dead_reckoning(found: DeadReckoning) -> Iterator[str]:
    for stretch in found.stretches[:5]:
        error = "" if stretch.error_m is None else f", error {stretch.error_m:.2f} m"
        yield (
            f"dead reckoning from {stretch.start_s:.1f} to {stretch.stop_s:.1f} s, over {stretch.distance_m:.0f} m:"
            f" at the end sigma {stretch.sigma_m:.2f} m{error}"
        )
    if found.count > 5:
        yield f"               and {found.count - 5} more times; {found.seconds:.0f} s in all"


def smoothed_lines(report: SmoothedReport) -> Iterator[str]:
    """What the smoother gave, for a reader at a terminal."""
    if not report.states:
        yield "smoothed       nothing: there was no state"
        return
    runs = f" in {report.runs} runs" if report.runs > 1 else ""
    lost = f"; {report.lost} of the runs could not be smoothed: numbers were no longer finite" if report.lost else ""
    yield f"smoothed       {report.states} states{runs}{lost}"
    if report.sigma_m is not None and report.filter_sigma_m is not None:
        yield f"  horizontal sigma {report.sigma_m:.2f} m, the filter's {report.filter_sigma_m:.2f} m (root mean square)"
    for name, source in report.sources.items():
        if source.dropped or source.taken_back:
            yield (
                f"  {name}: judged by what came before and after, {source.dropped} that the filter had fused are left out,"
                f" and {source.taken_back} that it had rejected are used; {source.used} are used in all"
            )
    if report.truth:
        yield from truth_lines(report.truth, "the smoothed states ")


def truth_lines(truth: TruthReport, what: str = "") -> Iterator[str]:
    position, heading = truth.position, truth.heading
    offset = math.hypot(position.offset_north_m, position.offset_east_m)
    yield (
        f"{what}compared with the truth, seconds {truth.start_s:.1f} to {truth.stop_s:.1f}:"
        f" {truth.rows} states over {truth.distance_m:.0f} m"
    )
    angles = {"heading": heading, "pitch": truth.pitch, "roll": truth.roll}
    yield from table(
        [
            ["", "RMSE", "68 % below", "95 % below", "unit", ""],
            ["  horizontal position", *_cells(position.rmse_m, position.p68_m, position.p95_m), "m", ""],
            ["    mean offset removed", f"{position.rmse_offset_removed_m:.3f}", "", "", "m", f"offset {offset:.3f} m"],
            ["  height", f"{truth.height_rmse_m:.3f}", "", "", "m", ""],
            [
                "  horizontal velocity",
                *_cells(truth.velocity_rmse_mps, truth.velocity_p68_mps, truth.velocity_p95_mps),
                "m/s",
                "",
            ],
            *(_angle(name, angle) for name, angle in angles.items() if angle),
        ]
    )
    share = position.end_m / truth.distance_m if truth.distance_m else 0.0
    yield f"  error at the end {position.end_m:.2f} m, {100 * share:.2f} % of the distance; max {position.max_m:.2f} m"
    yield f"  {100 * position.inside_95:.1f} % of the states have the truth inside their 95 % ellipse (should be 95 or more)"


def _cells(*values: float) -> list[str]:
    return [f"{value:.3f}" for value in values]


def _angle(name: str, angle: AngleReport) -> list[str]:
    cells = _cells(angle.rmse_deg, angle.p68_deg, angle.p95_deg)
    return [f"  {name}, mean offset removed", *cells, "deg", f"offset {angle.offset_deg:.3f} deg"]


def _outages(found: OutageReport) -> Iterator[str]:
    yield (
        f"without GNSS for {found.length}, {found.count} times: 68 % of the errors at the end are at most"
        f" {found.p68_percent:.2f} % of the distance ({found.p68_m:.2f} m)"
    )
    yield f"  median {found.p50_percent:.2f} %, 95 % below {found.p95_percent:.2f} %, worst {found.max_percent:.2f} %"
    yield f"  {100 * found.inside_95:.0f} % of the ends have the truth inside their 95 % ellipse"
    if found.without_state:
        yield f"  {found.without_state} more outages ended without a state, or where no truth is known"
