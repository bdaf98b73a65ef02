"""Replay: recorded events go through the engine in their order of receipt; its messages to files, statistics, outputs.

A tick is a publication, see `fusiond.engine`: it has the messages that the live daemon published at that instant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from fusiond import __version__
from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.replay.comparison import Comparison, Errors, Window, errors_of
from fusiond.app.replay.intervals import Withheld
from fusiond.app.replay.summary import (
    DeadReckoningLog,
    Latencies,
    Publications,
    SourceReport,
    Span,
    StepBack,
    Summary,
    TooOld,
    source_report,
)
from fusiond.app.replay.truth import Truth
from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.estimator.fusion import Receipt
from fusiond.estimator.solution import Mode
from fusiond.events import ClockPair, Received
from fusiond.filter.rows import Outcome
from fusiond.filter.source_health import misreading
from fusiond.filter.stored_state import StoredState
from fusiond.messages import Message, StateMessage
from fusiond.messages.schedule import IoHealth
from fusiond.units import SECOND

WHOLE = Window()

TickSink = Callable[[StateMessage, Errors | None], None]
ReceiptSink = Callable[[Receipt], None]
MessageSink = Callable[[Message], None]
Pace = Callable[[int], None]


@dataclass
class ReplayTask:
    """What a replay does besides fusing. Without a sink for ticks or messages there are no ticks."""

    rate_hz: float
    withheld: Sequence[Withheld] = ()
    truth: Truth | None = None
    pace: Pace | None = None  # called with the time of the next event or tick [ns from the first event]; may sleep
    on_tick: list[TickSink] = field(default_factory=list)
    on_receipt: list[ReceiptSink] = field(default_factory=list)
    on_message: list[MessageSink] = field(default_factory=list)  # everything that a live run would publish
    window: Window = WHOLE  # of the comparison with the truth
    stored_state: StoredState | None = None  # that the run started with
    io_health: Callable[[], IoHealth] = IoHealth  # health of the attached outputs


class Replay:
    """One run of recorded events through an engine."""

    def __init__(self, config: Config, task: ReplayTask) -> None:
        self.config = config
        self.events = self.clock_pairs = 0
        self.first_nominal_s: float | None = None  # of the first nominal state, from the first event
        self._task = task
        self._ticking = bool(task.on_tick or task.on_message) or task.truth is not None
        self.engine = Engine(
            config,
            self._receive if self._ticking else None,
            rate_hz=task.rate_hz,
            only_states=not task.on_message,
            io_health=task.io_health,
            pace=task.pace,
            stored_state=task.stored_state,
        )
        self.fusion = self.engine.fusion
        self._withheld: Counter[str] = Counter()
        self._sessions = 0  # that followed the first
        self._modes: Counter[str] = Counter()
        self._latencies = {source: Latencies() for source in config.sources()}
        self._lateness: dict[str, TooOld] = {}  # by source
        self._comparison = Comparison(task.window)
        self._reckoning = DeadReckoningLog(config.filter.position_timeout_s)
        self.evidence = Evidence(config)

    def run(self, events: Iterable[Received]) -> None:
        """Feed all events, in order of receipt."""
        for event in events:
            self.events += 1
            if self._task.withheld and self._is_withheld(event):
                self._withheld[event.source] += 1
                self.engine.advance(event.t_receive_ns)
            else:
                self._count(event, self.engine.feed(event))
        self.engine.finish()

    @property
    def first_ns(self) -> int | None:
        """Receipt of the first event."""
        return self.engine.first_ns

    @property
    def elapsed_ns(self) -> int:
        """Time from the first receipt to the latest."""
        return self.engine.elapsed_ns

    def _is_withheld(self, event: Received) -> bool:
        engine = self.engine
        since_ns = max(event.t_receive_ns, engine.now_ns) - engine.origin_ns if engine.first_ns is not None else 0
        return any(
            event.source in held.sources and held.start_ns <= since_ns < held.stop_ns for held in self._task.withheld
        )

    def _count(self, event: Received, receipt: Receipt | None) -> None:
        if receipt is None:
            self.clock_pairs += isinstance(event.payload, ClockPair)
            return
        if len(self.engine.steps_back) > self._sessions:
            self._sessions = len(self.engine.steps_back)
            self.evidence.begin_session(event.t_receive_ns)
        self.evidence.add(receipt)
        if receipt.refusal is Outcome.TOO_OLD:
            self._note_lateness(event, receipt)
        if receipt.refusal is not Outcome.INVALID:
            measurement = receipt.measurement
            self._latencies[measurement.source].add(measurement.t_receive_ns - measurement.t_ns)
        for sink in self._task.on_receipt:
            sink(receipt)

    def _note_lateness(self, event: Received, receipt: Receipt) -> None:
        found, measurement = self._lateness.setdefault(event.source, TooOld(clock=event.clock)), receipt.measurement
        found.late_s = max(found.late_s, (measurement.t_receive_ns - measurement.t_ns) / SECOND)
        found.beyond_s = max(found.beyond_s, (receipt.history.settled_ns - measurement.t_ns) / SECOND)

    def _receive(self, message: Message) -> None:
        if isinstance(message, StateMessage):
            self._add_state(message)
        for sink in self._task.on_message:
            sink(message)

    def _add_state(self, state: StateMessage) -> None:
        since_start_ns = state.t_ns - self.engine.origin_ns
        errors = errors_of(state, self._task.truth.at(state.t_ns)) if self._task.truth else None
        self._modes[state.mode.value] += 1
        if self.first_nominal_s is None and state.mode is Mode.NOMINAL:
            self.first_nominal_s = since_start_ns / SECOND
        self._reckoning.add(since_start_ns, state, errors)
        if errors:
            self._comparison.add(since_start_ns, errors)
        for sink in self._task.on_tick:
            sink(state, errors)

    def summary(self, config_name: str, logs: dict[str, dict[str, int]], warnings: list[str]) -> Summary:
        """The summary. There must have been an event."""
        engine = self.engine
        assert engine.first_ns is not None
        published = None
        if self._ticking:
            modes = dict(self._modes)
            published = Publications(rate_hz=self._task.rate_hz, rows=engine.ticks, skipped=engine.skipped, modes=modes)
        return Summary(
            fusiond=__version__,
            config=config_name,
            vehicle=self.config.vehicle.name,
            logs=logs,
            warnings=warnings,
            steps_back=[StepBack(at_s=one.since_ns / SECOND, by_s=one.by_ns / SECOND) for one in engine.steps_back],
            span=Span(first_ns=engine.first_ns, last_ns=engine.now_ns, seconds=self.elapsed_ns / SECOND),
            events=self.events,
            clock_pairs=self.clock_pairs,
            rerun=self.fusion.history.rerun,
            sources=self.sources(),
            clocks=self.fusion.clock.report(),
            final=engine.message(engine.now_ns),
            published=published,
            dead_reckoning=self._reckoning.report() if self._ticking else None,
            truth=self._comparison.report(),
        )

    def sources(self) -> dict[str, SourceReport]:
        """What came of each source, and its outcomes."""
        outcomes, fusion = self.fusion.outcomes(), self.fusion
        health = fusion.health(self.engine.now_ns)
        return {
            name: source_report(
                self._withheld[name],
                outcomes[name],
                fusion.invalid[name],
                self._latencies[name].report(),
                self._lateness.get(name),
                self._remark(name, outcomes[name]),
                health[name],
            )
            for name in self.config.sources()
        }

    def _remark(self, name: str, outcomes: Mapping[str, int]) -> str:
        """What is wrong with a wheel most of whose readings were rejected."""
        if outcomes[Outcome.REJECTED.name] <= outcomes[Outcome.FUSED.name]:
            return ""
        return misreading(self.fusion.history.head.memory[self.fusion.history.index[name]])
