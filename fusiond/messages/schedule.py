"""What goes out at a tick: the state, and when they are due the settled state, innovations, events and the health.

All but the latencies and what is said of inputs and outputs depends on the events and their receive stamps alone, so a
replay makes the same messages as the live run did. The reason of a reset is in the filter's state.
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
from fusiond.timeline.clock import ClockReport

SECOND = 1_000_000_000  # ns
RATE_DENOMINATOR = 1_000_000  # a rate is taken as a fraction with at most this, so that ticks never drift
HEALTH_NS = SECOND  # between two of them, when nothing changes
LOOK_NS = SECOND // 10  # between two looks at what the sources are held to be
ABSENT_NS = 2 * SECOND  # a source that has brought nothing for so long is not present
SEVERITY: Mapping[Mode, Severity] = {
    Mode.ALIGNING: "notice",
    Mode.NOMINAL: "info",
    Mode.DEAD_RECKONING: "warning",
    Mode.LOST: "critical",
}


class IoHealth(NamedTuple):
    """What the health tells of the shell around the engine."""

    latency: LatencyHealth = LatencyHealth()
    inputs: Mapping[str, InputHealth] = {}
    outputs: Mapping[str, OutputHealth] = {}


class Publication:
    """What is published besides the states. `io_health` is asked whenever a health is made."""

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
        """Take note of a measurement and what became of it."""
        self._sources.add(event)
        if self._innovations:
            self._innovations.add(receipt)

    def after_state(self, since_start_ns: int, state: StateMessage) -> Iterator[Message]:
        """What goes out at a tick after its state, in order. To be taken whole, before anything else is done."""
        if self._settled_ns is not None and since_start_ns >= self._next_settled_ns:
            self._next_settled_ns = int((since_start_ns // self._settled_ns + 1) * self._settled_ns)
            yield from self._settled()
        if self._innovations:
            yield from self._innovations.judged()
        events = list(self._changes.since(state, self._sources.present(state.t_ns)))
        yield from events
        if events or since_start_ns >= self._next_health_ns:
            if since_start_ns >= self._next_health_ns:
                self._next_health_ns = (since_start_ns // HEALTH_NS + 1) * HEALTH_NS
                self._sources.measure_rates(state.t_ns)
            yield self.health(since_start_ns, state)

    def _settled(self) -> Iterator[Message]:
        estimate = self._fusion.settled()
        if estimate.t_ns > self._last_settled_ns:  # not before the first, and each but once
            self._last_settled_ns = estimate.t_ns
            yield settled_message(estimate, self._vehicle, totals(self._fusion))

    def health(self, since_start_ns: int, state: StateMessage) -> HealthMessage:
        """How everything is at the instant of a state."""
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
                for name, (value, sigma) in calibrations(self._fusion.plan, self._fusion.history.head).items()
            },
        )


class Sources:
    """The health of every source of measurements."""

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self._received: dict[str, int] = {}  # last receipt [ns]
        self._clocks: dict[str, str] = {}
        self._rates = dict.fromkeys(fusion.plan.sources, 0.0)
        self._counted, self._counted_ns = fusion.history.counts.sum(axis=1), 0

    def add(self, event: Received) -> None:
        self._received[event.source] = event.t_receive_ns
        self._clocks[event.source] = event.clock

    def present(self, t_ns: int) -> frozenset[str]:
        """The sources of which something was received lately."""
        return frozenset(source for source, last in self._received.items() if t_ns - last < ABSENT_NS)

    def measure_rates(self, t_ns: int) -> None:
        """Receipts a second since the last time."""
        counted = self._fusion.history.counts.sum(axis=1)
        if self._counted_ns:
            rates = (counted - self._counted) * (SECOND / (t_ns - self._counted_ns))
            self._rates = dict(zip(self._fusion.plan.sources, rates.tolist(), strict=True))
        self._counted, self._counted_ns = counted, t_ns

    def health(self, t_ns: int) -> dict[str, SourceHealth]:
        fusion, present = self._fusion, self.present(t_ns)
        beliefs = fusion.beliefs(t_ns)
        clocks, nis, counts = fusion.clock.report(), nis_means(fusion), fusion.history.counts.tolist()
        found = {}
        for i, source in enumerate(fusion.plan.sources):
            last = self._received.get(source)
            found[source] = SourceHealth(
                outcomes=outcome_counts(counts[i]),
                present=source in present,
                age_ms=None if last is None else (t_ns - last) / 1e6,
                rate_hz=self._rates[source],
                test_ratio=_last_ratio(fusion, i),
                nis_mean=nis.get(source),
                clock=_clock_health(self._clocks.get(source), clocks),
                probabilities=Probabilities(**dict(zip(STATUSES, beliefs[source].probabilities, strict=True))),
                status=cast(SourceStatus, beliefs[source].status),
                reason=beliefs[source].reason or None,
            )
        return found


class Changes:
    """What changed from one tick to the next: mode, resets, sources that come and go."""

    def __init__(self, config: Config, fusion: Fusion) -> None:
        self.reset_reason: str | None = None
        self._config, self._fusion = config, fusion
        self._mode: Mode | None = None
        self._resets = 0
        self._present: frozenset[str] = frozenset()
        self._statuses = dict.fromkeys(fusion.plan.sources, "nominal")
        self._look_ns: int = NEVER

    def since(self, state: StateMessage, present: frozenset[str]) -> Iterator[EventMessage]:
        """The events between the tick before and this one."""

        def event(**fields: Any) -> EventMessage:
            return EventMessage(vehicle=state.vehicle, t_ns=state.t_ns, **fields)

        if state.resets != self._resets:
            if state.resets > self._resets:
                self.reset_reason = self._why()
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
        if state.t_ns >= self._look_ns:
            self._look_ns = state.t_ns + LOOK_NS
            for source, belief in self._fusion.beliefs(state.t_ns).items():
                if belief.status not in ("absent", self._statuses[source]):  # that it is gone is told above
                    self._statuses[source] = belief.status
                    good = belief.status == "nominal"
                    text = f"{source}: {belief.status}" + (f": {belief.reason}" if belief.reason else "")
                    yield event(kind="source_status", severity="info" if good else "warning", subject=source, text=text)

    def _why(self) -> str:
        """Why the state was reset, in words."""
        stamps = self._fusion.history.head.stamps
        source = self._fusion.plan.sources[int(stamps[RESET_SOURCE])]
        return {
            ResetReason.NONE: "",
            ResetReason.DATA_GAP: f"no data for more than {self._config.filter.restart_gap_s:g} s; aligning again",
            ResetReason.HEADING_LOST: "the heading was lost without the IMU; aligning again",
            ResetReason.NOT_FINITE: "the state was not finite; aligning again",
            ResetReason.SOURCE_RETURNED: f"{source} was rejected too long with a constant error; the state was set to it",
            ResetReason.HEADING_DECIDED: "the drive contradicted or confirmed the stored heading; the heading is decided",
        }[ResetReason(int(stamps[RESET_REASON]))]


def nis_means(fusion: Fusion) -> dict[str, float]:
    """By source, over the horizon: the mean of the squared innovations per axis, in sigmas."""
    rows = fusion.history.rows
    axes = np.count_nonzero(rows["variance"] > 0, axis=1)
    judged = (axes > 0) & np.isfinite(rows["ratio"])
    squares = rows["ratio"][judged] * np.array(fusion.plan.gates)[axes[judged]] / axes[judged]
    number = len(fusion.plan.sources)
    counts = np.bincount(rows["source"][judged], minlength=number)
    sums = np.bincount(rows["source"][judged], weights=squares, minlength=number)
    return {name: float(sums[i] / counts[i]) for i, name in enumerate(fusion.plan.sources) if counts[i]}


def _last_ratio(fusion: Fusion, source: int) -> float | None:
    head = fusion.history.head
    stamps = head.source_stamps[source]
    ratio = float(head.memory[source, LAST_RATIO])
    judged = stamps[T_FUSED] != NEVER or stamps[T_REJECTED] != NEVER
    return ratio if judged and math.isfinite(ratio) else None


def _clock_health(name: str | None, clocks: Mapping[str, ClockReport]) -> ClockHealth | None:
    report = clocks.get(name or "arrival") if name is not None else None
    if report is None:
        return None
    return ClockHealth(
        name=name or "arrival",
        method=report.method,
        offset_ms=report.offset_ns / 1e6,
        drift_ppm=report.drift_ppm,
        jitter_ms=report.jitter_ns / 1e6,
        resets=report.resets,
        strays=report.strays,
        note=report.note,
    )
