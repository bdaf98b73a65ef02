"""The messages of a tick besides the state: the settled state, innovations, events and the health, when they are due.

Everything but the latencies and the health of inputs and outputs depends only on the events and their receive stamps, so a
replay makes the same messages as the live run. The reason of a reset is in the filter's state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from typing import Any, NamedTuple, cast

import numpy as np

from fusiond import __version__
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.estimator.solution import Mode
from fusiond.events import Received
from fusiond.filter.calibration import calibrations
from fusiond.filter.source_health import STATUSES
from fusiond.filter.state import LAST_RATIO, NEVER, RESET_REASON, RESET_SOURCE, T_FUSED, T_REJECTED, ResetReason
from fusiond.messages.from_solution import settled_message
from fusiond.messages.innovations import Innovations
from fusiond.messages.outcomes import outcome_counts, totals
from fusiond.messages.types import (
    Calibration,
    ClockHealth,
    EventMessage,
    HealthMessage,
    InputHealth,
    LatencyHealth,
    Message,
    OutputHealth,
    Probabilities,
    Severity,
    SourceHealth,
    SourceStatus,
    StateMessage,
)
from fusiond.timeline.aligner import ClockReport
from fusiond.units import MILLISECOND, SECOND

RATE_DENOMINATOR = 1_000_000  # a rate is converted to a fraction with at most this denominator, so that ticks never drift
HEALTH_NS = SECOND  # between two health messages, when nothing changes
STATUS_NS = SECOND // 10  # between two checks of the status of the sources
ABSENT_NS = 2 * SECOND  # a source from which nothing came for this long is absent
SEVERITY: Mapping[Mode, Severity] = {
    Mode.ALIGNING: "notice",
    Mode.NOMINAL: "info",
    Mode.DEAD_RECKONING: "warning",
    Mode.LOST: "critical",
}


class IoHealth(NamedTuple):
    """Health of inputs and outputs, and the latencies."""

    latency: LatencyHealth = LatencyHealth()
    inputs: Mapping[str, InputHealth] = {}
    outputs: Mapping[str, OutputHealth] = {}


class Publication:
    """The messages besides the states. `io_health` is called whenever a health message is made."""

    def __init__(self, config: Config, fusion: Fusion, io_health: Callable[[], IoHealth] = IoHealth) -> None:
        self._vehicle, self._fusion, self._io_health = config.vehicle.name, fusion, io_health
        settled = config.publish.settled_hz
        self._settled_ns = SECOND / Fraction(settled).limit_denominator(RATE_DENOMINATOR) if settled else None
        self._next_settled_ns = self._next_health_ns = 0  # from the first event
        self._last_settled_ns: int = NEVER
        self._innovations = Innovations(self._vehicle, fusion) if config.publish.innovations else None
        self._sources = Sources(fusion)
        self._changes = Changes(config, fusion)

    def add(self, event: Received, receipt: Receipt) -> None:
        """Add a measurement and its receipt."""
        self._sources.add(event)
        if self._innovations:
            self._innovations.add(receipt)

    def after_state(self, since_start_ns: int, state: StateMessage) -> Iterator[Message]:
        """The messages of a tick after its state, in order. Consume all of them before anything else is done."""
        if self._settled_ns is not None and since_start_ns >= self._next_settled_ns:
            self._next_settled_ns = int((since_start_ns // self._settled_ns + 1) * self._settled_ns)
            yield from self._settled()
        if self._innovations:
            yield from self._innovations.published()
        events = list(self._changes.since(state, self._sources.present(state.t_ns)))
        yield from events
        if events or since_start_ns >= self._next_health_ns:
            if since_start_ns >= self._next_health_ns:
                self._next_health_ns = (since_start_ns // HEALTH_NS + 1) * HEALTH_NS
                self._sources.measure_rates(state.t_ns)
            yield self.health(since_start_ns, state)

    def begin_session(self, t_receive_ns: int) -> None:
        """Go on with a time line that has stepped back, to a receipt."""
        self._last_settled_ns = NEVER
        if self._innovations:
            self._innovations.begin_session()
        self._sources.begin_session(t_receive_ns)
        self._changes.begin_session()

    def _settled(self) -> Iterator[Message]:
        estimate = self._fusion.settled()
        if estimate.t_ns > self._last_settled_ns:  # each only once
            self._last_settled_ns = estimate.t_ns
            yield settled_message(estimate, self._vehicle, totals(self._fusion))

    def health(self, since_start_ns: int, state: StateMessage) -> HealthMessage:
        """The health message of the instant of a state."""
        around = self._io_health()
        return HealthMessage(
            vehicle=self._vehicle,
            t_ns=state.t_ns,
            version=__version__,
            uptime_s=since_start_ns / SECOND,
            mode=state.mode,
            resets=state.resets,
            reset_reason=self._changes.reset_reason,
            outcomes=state.outcomes,
            latency_ms=around.latency,
            sources=self._sources.health(state.t_ns),
            inputs=dict(around.inputs),
            outputs=dict(around.outputs),
            calibration={
                name: Calibration(value=value, sigma=sigma)
                for name, (value, sigma) in calibrations(self._fusion.params, self._fusion.history.head).items()
            },
        )


class Sources:
    """The health of every source of measurements."""

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self._received: dict[str, int] = {}  # last receipt [ns]
        self._clocks: dict[str, str] = {}
        self._rates = dict.fromkeys(fusion.params.sources, 0.0)
        self._counted, self._counted_ns = fusion.history.counts.sum(axis=1), 0

    def add(self, event: Received) -> None:
        self._received[event.source] = event.t_receive_ns
        self._clocks[event.source] = event.clock

    def begin_session(self, t_receive_ns: int) -> None:
        """Count every source as heard just now: one that falls silent is lost as always."""
        self._received = dict.fromkeys(self._received, t_receive_ns)
        self._counted_ns = 0

    def present(self, t_ns: int) -> frozenset[str]:
        """The sources from which something was received recently."""
        return frozenset(source for source, last in self._received.items() if t_ns - last < ABSENT_NS)

    def measure_rates(self, t_ns: int) -> None:
        """Update the receipts per second since the last call."""
        counted = self._fusion.history.counts.sum(axis=1)
        if self._counted_ns:
            rates = (counted - self._counted) * (SECOND / (t_ns - self._counted_ns))
            self._rates = dict(zip(self._fusion.params.sources, rates.tolist(), strict=True))
        self._counted, self._counted_ns = counted, t_ns

    def health(self, t_ns: int) -> dict[str, SourceHealth]:
        fusion, present = self._fusion, self.present(t_ns)
        healths = fusion.health(t_ns)
        clocks, nis, counts = fusion.clock.report(), nis_means(fusion), fusion.history.counts.tolist()
        found = {}
        for i, source in enumerate(fusion.params.sources):
            last = self._received.get(source)
            found[source] = SourceHealth(
                outcomes=outcome_counts(counts[i]),
                present=source in present,
                age_ms=None if last is None else (t_ns - last) / MILLISECOND,
                rate_hz=self._rates[source],
                test_ratio=_last_ratio(fusion, i),
                nis_mean=nis.get(source),
                clock=_clock_health(self._clocks.get(source), clocks),
                probabilities=Probabilities(**dict(zip(STATUSES, healths[source].probabilities, strict=True))),
                status=cast(SourceStatus, healths[source].status),
                reason=healths[source].reason or None,
            )
        return found


class Changes:
    """Changes from one tick to the next: mode, resets, sources that appear, disappear or change their status, clocks that
    are of no use, and of use again."""

    def __init__(self, config: Config, fusion: Fusion) -> None:
        self.reset_reason: str | None = None
        self._config, self._fusion = config, fusion
        self._mode: Mode | None = None
        self._resets = 0
        self._present: frozenset[str] = frozenset()
        self._awaited = set(fusion.params.sources)  # never present yet
        self._statuses = dict.fromkeys(fusion.params.sources, "nominal")
        self._unusable: frozenset[str] = frozenset()
        self._clock_faults: dict[str, int] = {}
        self._next_status_ns: int = NEVER

    def begin_session(self) -> None:
        """Go on with a time line that has stepped back."""
        self._next_status_ns = NEVER

    def since(self, state: StateMessage, present: frozenset[str]) -> Iterator[EventMessage]:
        """The events since the previous tick."""

        def event(**fields: Any) -> EventMessage:
            return EventMessage(vehicle=state.vehicle, t_ns=state.t_ns, **fields)

        if state.resets != self._resets:
            if state.resets > self._resets:
                self.reset_reason = self._reason()
                yield event(kind="reset", severity="warning", subject="", text=f"state reset: {self.reset_reason}")
            self._resets = state.resets
        if state.mode is not self._mode:
            text = state.mode.value if self._mode is None else f"{self._mode.value} -> {state.mode.value}"
            yield event(kind="mode", severity=SEVERITY[state.mode], subject=state.mode.value, text=f"mode: {text}")
            self._mode = state.mode
        for source in sorted(present - self._present):
            yield event(kind="source_found", severity="info", subject=source, text=f"{source}: receiving")
        for source in sorted(self._present - present):
            text = f"{source}: nothing received for {ABSENT_NS / SECOND:g} s"
            yield event(kind="source_lost", severity="warning", subject=source, text=text)
        self._present = present
        self._awaited -= present
        if state.t_ns >= self._next_status_ns:
            self._next_status_ns = state.t_ns + STATUS_NS
            for source, health in self._fusion.health(state.t_ns).items():
                if health.status == "absent" and source in self._awaited:
                    self._awaited.discard(source)
                    yield event(kind="source_lost", severity="warning", subject=source, text=f"{source}: {health.reason}")
                elif health.status not in ("absent", self._statuses[source]):  # source_lost reports an absent source
                    self._statuses[source] = health.status
                    good = health.status == "nominal"
                    text = f"{source}: {health.status}" + (f": {health.reason}" if health.reason else "")
                    yield event(kind="source_status", severity="info" if good else "warning", subject=source, text=text)
            clocks = self._fusion.clock.report()
            unusable = frozenset(name for name, report in clocks.items() if not report.usable)
            for name in sorted(unusable - self._unusable):
                yield event(kind="clock", severity="critical", subject=name, text=f"clock {name}: {clocks[name].note}")
            for name in sorted(self._unusable - unusable):
                yield event(kind="clock", severity="info", subject=name, text=f"clock {name}: of use again")
            self._unusable = unusable
            for name in sorted(name for name, report in clocks.items() if report.faults > self._clock_faults.get(name, 0)):
                text = f"clock {name}: {clocks[name].note or 'the bounds of its offset contradicted each other'}"
                yield event(kind="clock", severity="warning", subject=name, text=text)
            self._clock_faults = {name: report.faults for name, report in clocks.items()}

    def _reason(self) -> str:
        """The reason of the last reset, in words."""
        stamps = self._fusion.history.head.stamps
        source = self._fusion.params.sources[int(stamps[RESET_SOURCE])]
        return {
            ResetReason.NONE: "",
            ResetReason.DATA_GAP: f"no data for more than {self._config.filter.restart_gap_s:g} s; aligning again",
            ResetReason.HEADING_LOST: "the heading was lost without the IMU; aligning again",
            ResetReason.NOT_FINITE: "the state had lost all meaning; aligning again",
            ResetReason.SOURCE_RETURNED: f"{source}: the state contradicted it and was likelier to be wrong; set to it",
            ResetReason.INERTIAL_LIED: "the inertial sensor contradicted all others; its part was taken back",
            ResetReason.TIME_STEPPED_BACK: "receipt stamps stepped back, a new session; aligning again",
            ResetReason.HEADING_DECIDED: "the drive decided on the stored or given heading",
        }[ResetReason(int(stamps[RESET_REASON]))]


def nis_means(fusion: Fusion) -> dict[str, float]:
    """By source: the mean over the horizon of the squared innovations per axis, in sigmas."""
    rows = fusion.history.rows
    axes = np.count_nonzero(rows["variance"] > 0, axis=1)
    tested = (axes > 0) & np.isfinite(rows["ratio"])
    squares = rows["ratio"][tested] * np.array(fusion.params.gates)[axes[tested]] / axes[tested]
    number = len(fusion.params.sources)
    counts = np.bincount(rows["source"][tested], minlength=number)
    sums = np.bincount(rows["source"][tested], weights=squares, minlength=number)
    return {name: float(sums[i] / counts[i]) for i, name in enumerate(fusion.params.sources) if counts[i]}


def _last_ratio(fusion: Fusion, source: int) -> float | None:
    head = fusion.history.head
    stamps = head.source_stamps[source]
    ratio = float(head.memory[source, LAST_RATIO])
    tested = stamps[T_FUSED] != NEVER or stamps[T_REJECTED] != NEVER
    return ratio if tested and math.isfinite(ratio) else None


def _clock_health(name: str | None, clocks: Mapping[str, ClockReport]) -> ClockHealth | None:
    report = clocks.get(name or "arrival") if name is not None else None
    if report is None:
        return None
    return ClockHealth(
        name=name or "arrival",
        method=report.method,
        offset_ms=float(report.offset_ns) / MILLISECOND,
        drift_ppm=report.drift_ppm,
        jitter_ms=report.jitter_ns / MILLISECOND,
        resets=report.resets,
        strays=report.strays,
        note=report.note,
        bounds_ms=None if report.bounds_ns is None else _milliseconds(report.bounds_ns),
        faults=report.faults,
    )


def _milliseconds(bounds_ns: tuple[int, int]) -> tuple[float, float]:
    return bounds_ns[0] / MILLISECOND, bounds_ns[1] / MILLISECOND
