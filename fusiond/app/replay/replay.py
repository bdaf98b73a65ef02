"""Replay: recorded events through the fusion in their order of receipt, ticks in between, and what is made of it.

A tick is a publication, see `fusiond.engine`: it tells what the live daemon told at that instant.
"""

from __future__ import annotations

import gzip
import importlib.util
import re
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from fusiond import __version__
from fusiond.app.progress import shown
from fusiond.app.replay.comparison import Comparison, Errors, Truth, TruthError, TruthRow, Window, errors_of, parse_truth
from fusiond.app.replay.summary import DeadReckoningLog, Latencies, Publications, Span, Summary, source_report, to_json
from fusiond.app.replay.trace import Trace
from fusiond.app.state_file import read_state
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.engine import SECOND, Engine
from fusiond.errors import UnusableError, UsageError
from fusiond.estimator.fusion import Receipt
from fusiond.events import ClockPair, Received
from fusiond.filter.hot_start import WORDS, Verdict
from fusiond.filter.step import Outcome
from fusiond.filter.stored_state import StoredState, StoredStateError, check
from fusiond.messages.schedule import Publication
from fusiond.messages.types import Message, StateMessage, csv_header, csv_row
from fusiond_adapters.logs import LogError
from fusiond_adapters.logs.merge import open_logs

WHOLE = Window()


class OutputError(UnusableError):
    """A result cannot be delivered; the message says where and why."""


# --- The run


class Withheld(NamedTuple):
    """Sources kept out from `start_ns` to before `stop_ns`, counted from the first event's receipt."""

    sources: frozenset[str]
    start_ns: int
    stop_ns: int


TickSink = Callable[[StateMessage, Errors | None], None]
ReceiptSink = Callable[[Receipt], None]
MessageSink = Callable[[Message], None]
Pace = Callable[[int], None]


@dataclass
class Wants:
    """What a replay is to do besides fusing. Without a tick sink there are no ticks."""

    rate_hz: float
    withheld: Sequence[Withheld] = ()
    truth: Truth | None = None
    pace: Pace | None = None  # called with the time of what comes next [ns from the first event]; may sleep
    on_tick: list[TickSink] = field(default_factory=list)
    on_receipt: list[ReceiptSink] = field(default_factory=list)
    on_message: list[MessageSink] = field(default_factory=list)  # everything that a live run would publish at a tick
    window: Window = WHOLE  # of the comparison with the truth
    stored: StoredState | None = None  # that the run began with


class Replay:
    """One run of recorded events through a fusion."""

    def __init__(self, config: Config, wants: Wants) -> None:
        self.config = config
        self.events = self.clock_pairs = 0
        self._wants = wants
        self._ticking = bool(wants.on_tick or wants.on_message) or wants.truth is not None
        self.engine = Engine(config, wants.rate_hz, self._publish if self._ticking else None, wants.pace, wants.stored)
        self.fusion = self.engine.fusion
        self._publication = Publication(config, self.engine) if wants.on_message else None
        self._withheld: Counter[str] = Counter()
        self._modes: Counter[str] = Counter()
        self._latencies = {source: Latencies() for source in config.sources()}
        self._comparison = Comparison(wants.window)
        self._reckoning = DeadReckoningLog(config.filter.position_timeout_s)

    def run(self, events: Iterable[Received]) -> None:
        """Take all events, in order of receipt."""
        advance, take, pace = self.engine.advance, self._take, self._wants.pace
        for event in events:
            advance(event.t_receive_ns)
            if pace:
                pace(self.elapsed_ns)
            take(event)
        self.engine.finish()

    @property
    def first_ns(self) -> int | None:
        """Receipt of the first event."""
        return self.engine.first_ns

    @property
    def elapsed_ns(self) -> int:
        """How much of the drive has passed."""
        return self.engine.elapsed_ns

    def _take(self, event: Received) -> None:
        self.events += 1
        for held in self._wants.withheld:
            if event.source in held.sources and held.start_ns <= self.elapsed_ns < held.stop_ns:
                self._withheld[event.source] += 1
                return
        receipt = self.engine.take(event)
        if receipt is None:
            self.clock_pairs += isinstance(event.payload, ClockPair)
            return
        if self._publication:
            self._publication.add(event, receipt)
        self.engine.taken(event)
        if receipt.refusal is not Outcome.INVALID:
            measurement = receipt.measurement
            self._latencies[measurement.source].add(measurement.t_receive_ns - measurement.t_ns)
        for sink in self._wants.on_receipt:
            sink(receipt)

    def _publish(self, since_start_ns: int, message: StateMessage) -> None:
        errors = errors_of(message, self._wants.truth.at(message.t_ns)) if self._wants.truth else None
        self._modes[message.mode.value] += 1
        self._reckoning.add(since_start_ns, message, errors)
        if errors:
            self._comparison.add(since_start_ns, errors)
        for sink in self._wants.on_tick:
            sink(message, errors)
        if self._publication:
            for told in self._publication.at(since_start_ns, message):
                for take in self._wants.on_message:
                    take(told)

    def summary(self, config_name: str, logs: dict[str, dict[str, int]], warnings: list[str]) -> Summary:
        """What came out. There must have been an event."""
        engine = self.engine
        assert engine.first_ns is not None
        outcomes = self.fusion.outcomes()
        sources = {
            name: source_report(
                self._withheld[name], outcomes[name], self.fusion.invalid[name], self._latencies[name].report()
            )
            for name in self.config.sources()
        }
        published = None
        if self._ticking:
            published = Publications(
                rate_hz=self._wants.rate_hz,
                rows=engine.rows,
                skipped=engine.skipped,
                modes=dict(self._modes),
            )
        return Summary(
            fusiond=__version__,
            config=config_name,
            vehicle=self.config.vehicle.name,
            logs=logs,
            warnings=warnings,
            span=Span(first_ns=engine.first_ns, last_ns=engine.now_ns, seconds=self.elapsed_ns / SECOND),
            events=self.events,
            clock_pairs=self.clock_pairs,
            rerun=self.fusion.history.rerun,
            sources=sources,
            clocks=self.fusion.clock.report(),
            final=engine.message(engine.now_ns),
            published=published,
            dead_reckoning=self._reckoning.report() if self._ticking else None,
            truth=self._comparison.report(),
        )


class Pacer:
    """Sleeps so that recorded time passes `speed` times as fast as real time."""

    def __init__(
        self, speed: float, clock: Callable[[], int] = time.monotonic_ns, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._speed, self._clock, self._sleep = speed, clock, sleep
        self._start_ns: int | None = None

    def __call__(self, since_start_ns: int) -> None:
        if self._start_ns is None:
            self._start_ns = self._clock()
        ahead_ns = self._start_ns + since_start_ns / self._speed - self._clock()
        if ahead_ns > 0:
            self._sleep(ahead_ns / 1e9)


# --- Arguments

INTERVAL = re.compile(r"(\d+(?:\.\d*)?)-(\d+(?:\.\d*)?)")


def parse_interval(text: str) -> tuple[float, float]:
    """`START-STOP` in seconds. Raises UsageError."""
    found = INTERVAL.fullmatch(text)
    if not found or not float(found[1]) < float(found[2]):
        raise UsageError(f"'{text}' is no interval; give START-STOP in seconds from the first event, such as 12-22")
    return float(found[1]), float(found[2])


def parse_withheld(text: str, config: Config) -> Withheld:
    """`SOURCE:START-STOP`; the source is a stream by its full name, or a receiver with all its streams. Raises
    UsageError."""
    name, colon, interval = text.partition(":")
    if not colon:
        raise UsageError(f"--withhold {text}: give SOURCE:START-STOP, such as gps0:12-22")
    sources = frozenset(source for source in config.sources() if name in (source, source.partition(".")[0]))
    if not sources:
        known = ", ".join(dict.fromkeys([*config.gnss, *config.sources()]))
        raise UsageError(f"--withhold {text}: there is no source '{name}'; configured: {known}")
    start_s, stop_s = parse_interval(interval)
    return Withheld(sources, round(start_s * SECOND), round(stop_s * SECOND))


# --- Files


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of one replay."""

    config: Config
    config_name: str
    logs: Sequence[str]
    csv: Path | None = None
    json: Path | None = None
    truth: Path | None = None
    plot: Path | None = None
    mcap: Path | None = None
    stored: Path | None = None
    withheld: Sequence[Withheld] = ()
    window: Window = WHOLE
    rate_hz: float | None = None  # default: the configuration's
    speed: float | None = None  # default: as fast as possible
    publish: bool = False
    share: Callable[[int], float] | None = None  # part done by the time passed [ns], for the bar; default: bytes read


def replay(options: Options) -> Summary:
    """Replay logs as asked for, and write what was asked for.

    Raises ConfigError, LogError, TruthError, UsageError, OutputError.
    """
    config = options.config
    logs = open_logs(options.logs, config)
    wants = Wants(options.rate_hz or config.publish.rate_hz, options.withheld, window=options.window)
    wants.stored = _stored(options.stored, config) if options.stored else None
    trace = Trace() if options.plot else None
    if trace:
        wants.on_tick.append(trace.add_tick)
        wants.on_receipt.append(trace.add_receipt)
    if options.truth:
        wants.truth = Truth(_checked_truth(options.truth))
    if options.speed:
        wants.pace = Pacer(options.speed)
    with ExitStack() as stack:
        _add_outputs(options, wants, stack)
        run = Replay(config, wants)
        share = options.share or (lambda _: logs.bytes_read / logs.bytes_total)
        run.run(shown(logs, lambda: share(run.elapsed_ns), lambda: run.elapsed_ns, sys.stderr))
    if trace:
        trace.read_outcomes()
    names = _names(logs.counts)
    if run.first_ns is None:
        met = "; ".join(f"{names[path]}: {counts}" for path, counts in logs.counts.items())
        raise LogError(f"nothing in the logs that the configuration asks for ({met})")
    warnings = [_renamed(warning, names) for warning in logs.warnings]
    summary = run.summary(options.config_name, {names[path]: counts for path, counts in logs.counts.items()}, warnings)
    if wants.stored and (verdict := run.fusion.hot_start()) is not Verdict.BELIEVED:
        warnings.append(f"stored state: {WORDS[verdict]}")
    if options.truth and summary.truth is None:
        warnings.append(f"{options.truth.name}: no published state to compare with it; is it of this drive?")
    if options.json:
        with _delivering(options.json):
            options.json.write_bytes(to_json(summary))
    if trace and options.plot:
        from fusiond.app.replay.picture import draw  # noqa: PLC0415 - needs the extra `plot`, slow to import

        with _delivering(options.plot):
            draw(trace, summary, options.plot)
    return summary


def _stored(path: Path, config: Config) -> StoredState:
    """The stored state that a recording began with. Raises LogError."""
    try:
        stored = read_state(path)
        if stored is None:
            raise StoredStateError("there is no such file")
        check(stored, config)
    except StoredStateError as error:
        raise LogError(f"{path}: {error}") from error
    return stored


def _checked_truth(path: Path) -> Iterator[TruthRow]:
    """The rows of a truth file, after a first pass in which every fault would show."""
    for _ in _read_truth(path):
        pass
    return _read_truth(path)


def _read_truth(path: Path) -> Iterator[TruthRow]:
    opener = gzip.open if path.suffix.lower() == ".gz" else open
    try:
        with opener(path, "rt", encoding="utf-8") as file:
            yield from parse_truth(file, str(path))
    except UnicodeDecodeError as error:
        raise TruthError(f"{path}: is not UTF-8 text") from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TruthError(f"{path}: is no sound gzip file: {error}") from error
    except OSError as error:
        raise TruthError(f"{path}: cannot be read: {error.strerror}") from error


def _add_outputs(options: Options, wants: Wants, stack: ExitStack) -> None:
    """Open what every tick goes to; what cannot be written is found before the work begins."""
    outputs = [path for path in (options.csv, options.json, options.plot, options.mcap) if path]
    inputs = {Path(log).resolve() for log in options.logs}
    inputs |= {path.resolve() for path in (options.truth, options.stored) if path}
    for path in outputs:
        if path.resolve() in inputs:
            raise UsageError(f"{path}: is an input, and would be overwritten")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: cannot be written: there is no folder {path.parent}")
    if options.plot and importlib.util.find_spec("matplotlib") is None:
        raise UsageError("--plot needs the extra plot: pip install 'fusiond[plot]'")
    if options.csv:
        with _delivering(options.csv):
            file = stack.enter_context(options.csv.open("w", encoding="ascii", newline="\n"))
            file.write(csv_header() + "\n")

        def write_row(message: StateMessage, _: Errors | None) -> None:
            file.write(csv_row(message) + "\n")

        wants.on_tick.append(write_row)
    if options.mcap:
        wants.on_message.append(_mcap_file(options.mcap, options.config, stack))
    if options.publish:
        wants.on_tick.append(_publisher(options.config, stack))


def _mcap_file(path: Path, config: Config, stack: ExitStack) -> MessageSink:
    try:
        from fusiond_adapters.foxglove.converter import Converter  # noqa: PLC0415 - needs the extra `mcap`
        from fusiond_adapters.mcap import McapFile  # noqa: PLC0415
    except ConfigError as error:
        raise UsageError(f"--mcap: {error}") from error

    with _delivering(path):
        file = stack.enter_context(McapFile(path, config))
    converter = Converter()

    def write(message: Message) -> None:
        for record in converter.records(message):
            file.add(record)

    return write


def _publisher(config: Config, stack: ExitStack) -> TickSink:
    from fusiond_adapters.zenoh.session import PublishError, ZenohPublisher, open_session  # noqa: PLC0415 - slow to import

    try:
        session = stack.enter_context(open_session(config.zenoh, config.directory))
        publisher = stack.enter_context(ZenohPublisher(session, config.vehicle.name, config.publish.encoding))
    except PublishError as error:
        raise OutputError(str(error)) from error

    def publish(message: StateMessage, _: Errors | None) -> None:
        publisher.publish(message)

    return publish


@contextmanager
def _delivering(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _names(paths: Iterable[str]) -> dict[str, str]:
    """File names that stand for paths in the summary; alike ones are numbered."""
    names: dict[str, str] = {}
    for path in paths:
        name = Path(path).name
        alike = sum(Path(other).name == name for other in names)
        names[path] = f"{name} ({alike + 1})" if alike else name
    return names


def _renamed(warning: str, names: dict[str, str]) -> str:
    for path, name in names.items():
        warning = warning.replace(path, name)
    return warning
