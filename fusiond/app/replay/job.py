"""One `fusiond replay`: a replay with its logs, files and outputs."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from fusiond.app.diagnosis.diagnose import diagnose, missing
from fusiond.app.diagnosis.finding import NothingAskedFor, exit_code, lines, located
from fusiond.app.kernel import slow_kernel
from fusiond.app.progress import shown
from fusiond.app.replay.comparison import Window
from fusiond.app.replay.files import (
    check_outputs,
    check_suffix,
    csv_file,
    delivering,
    mcap_file,
    short_names,
    stored_state,
    truth_of,
    with_short_names,
)
from fusiond.app.replay.intervals import Withheld
from fusiond.app.replay.outages import (
    RECOVERY_S,
    Length,
    Outage,
    OutageLog,
    OutageReport,
    Stretch,
    course,
    plan,
    report,
    withheld,
)
from fusiond.app.replay.pacer import Pacer
from fusiond.app.replay.replay import WHOLE, Replay, ReplayTask
from fusiond.app.replay.smoothed import Smoothing
from fusiond.app.replay.summary import Summary, to_json
from fusiond.app.replay.trace import Trace
from fusiond.app.report.gathered import Gathered
from fusiond.config.explain import oddities
from fusiond.config.schema import Config
from fusiond.errors import UsageError
from fusiond.filter.hot_start import WORDS
from fusiond.filter.state import Verdict
from fusiond.messages.info import info_message
from fusiond_adapters.logs.merge import LogSet, open_logs


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
    report: Path | None = None
    tiles: str | None = None  # address of the tiles of the report's map
    mcap: Path | None = None
    stored: Path | None = None
    withheld: Sequence[Withheld] = ()
    window: Window = WHOLE
    rate_hz: float | None = None  # default: the configuration's
    outage_length: Length | None = None  # replay again with GNSS outages of this length; needs a truth
    smooth: bool = False  # smooth the drive as well
    smooth_csv: Path | None = None  # file of the smoothed track
    speed: float | None = None  # default: as fast as possible
    publish: bool = False  # over Zenoh
    outputs: bool = False  # to every output that the configuration turns on
    bar: bool = True  # draw a progress bar, on a terminal
    share: Callable[[int], float] | None = None  # part done by the time passed [ns], for the bar; default: bytes read


def replay(options: Options) -> Summary:
    """Replay logs, and write the requested files.

    Raises ConfigError, LogError, TruthError, UsageError, OutputError.
    """
    if slow := slow_kernel():
        print(f"warning: {slow}", file=sys.stderr)  # at once: a long replay takes hours then
    config, logs = options.config, open_logs(options.logs, options.config)
    if options.report:
        config = replace(config, publish=replace(config.publish, innovations=True))
    pacer = Pacer(options.speed) if options.speed else None
    task = ReplayTask(options.rate_hz or config.publish.rate_hz, options.withheld, pace=pacer, window=options.window)
    task.stored_state = stored_state(options.stored, config) if options.stored else None
    task.truth = truth_of(options.truth) if options.truth else None
    drawings = _Drawings(options, task, lambda: run.engine.origin_ns)
    attached_warnings: list[str] = []
    with ExitStack() as stack:
        _open_files(options, task, stack)
        smoothing = _smoothing(options, task, stack) if options.smooth else None
        if options.publish or options.outputs:
            from fusiond.app.replay.attached import Attached  # noqa: PLC0415 - Zenoh is slow to import

            attached = Attached(config, pacer, everything=options.outputs)
            attached_warnings = attached.warnings
            task.on_message.append(attached.put)
            task.io_health = attached.io_health
            run = Replay(config, task)
            stack.enter_context(attached.opened(run.engine))
        else:
            run = Replay(config, task)
        if smoothing:
            smoothing.attach(run)
        share = options.share or (lambda _: logs.bytes_read / logs.bytes_total)
        run.run(shown(logs, lambda: share(run.elapsed_ns), lambda: run.elapsed_ns, sys.stderr) if options.bar else logs)
        summary = _summary(options, run, logs, attached_warnings)
        if smoothing:
            summary = replace(summary, smoothed=smoothing.finish(task.truth, options.window))
    if options.outage_length:
        summary = _with_outages(options, options.outage_length, run, task, summary)
    if options.json:
        with delivering(options.json):
            options.json.write_bytes(to_json(summary))
    drawings.draw(run, summary)
    return summary


class _Drawings:
    """The picture and the report of a replay, where they are wanted."""

    def __init__(self, options: Options, task: ReplayTask, origin_ns: Callable[[], int]) -> None:
        self._options = options
        self._trace = Trace(origin_ns) if options.plot or options.report else None
        self._gathered = Gathered(options.config, origin_ns) if options.report else None
        if self._gathered:
            task.on_tick.append(self._gathered.add_tick)
            task.on_receipt.append(self._gathered.add_receipt)
            task.on_message.append(self._gathered.add_message)
        if self._trace:
            task.on_tick.append(self._trace.add_tick)
            task.on_receipt.append(self._trace.add_receipt)

    def draw(self, run: Replay, summary: Summary) -> None:
        """Write them. Raises OutputError."""
        options = self._options
        if self._trace:
            self._trace.read_outcomes()
        if self._trace and options.plot:
            from fusiond.app.replay.picture import draw  # noqa: PLC0415 - needs the extra `plot`, slow to import

            with delivering(options.plot):
                draw(self._trace, summary, options.plot)
        if self._trace and self._gathered and options.report:
            from fusiond.app.report.page import Report, html  # noqa: PLC0415 - needs the extra `report`, slow to import

            self._gathered.finish(run.elapsed_ns, info_message(options.config, run.fusion).sources)
            page = html(Report(options.config, summary, self._gathered, self._trace, options.tiles))
            with delivering(options.report):
                options.report.write_text(page, encoding="utf-8")


def _with_outages(options: Options, length: Length, run: Replay, task: ReplayTask, summary: Summary) -> Summary:
    """The summary with the errors after outages, for which the logs are replayed several times more."""
    assert task.truth is not None
    begin_s = (run.first_nominal_s if run.first_nominal_s is not None else math.inf) + RECOVERY_S
    passes = plan(course(task.truth, run.engine.origin_ns), length, begin_s)
    ends: list[Outage | None] = []
    for stretches in passes:
        ends += _replay_outages(options, stretches, task)
    found: OutageReport | None = report(length, ends)
    if found is None:
        summary.warnings.append(
            f"--outage-length: the drive has no stretch of {length} with a truth after {RECOVERY_S:g} s with GNSS"
        )
    return replace(summary, outages=found)


def _replay_outages(options: Options, stretches: Sequence[Stretch], task: ReplayTask) -> list[Outage | None]:
    """One replay with GNSS withheld over the stretches: the last state of each."""
    logs, log = open_logs(options.logs, options.config), OutageLog(stretches)
    held = [*task.withheld, *withheld(stretches, options.config)]
    again = ReplayTask(task.rate_hz, held, task.truth, stored_state=task.stored_state)
    run = Replay(options.config, again)
    again.on_tick.append(lambda state, errors: log.add(state.t_ns - run.engine.origin_ns, state, errors))
    run.run(shown(logs, lambda: logs.bytes_read / logs.bytes_total, lambda: run.elapsed_ns, sys.stderr))
    return log.ends()


def _smoothing(options: Options, task: ReplayTask, stack: ExitStack) -> Smoothing:
    """What smooths the drive at the instants of its states, into the file that is asked for."""
    smoothing = Smoothing([csv_file(options.smooth_csv, stack)] if options.smooth_csv else [], stack)
    task.on_tick.append(smoothing.add_tick)
    return smoothing


def _open_files(options: Options, task: ReplayTask, stack: ExitStack) -> None:
    """Open the files of the ticks. A file that cannot be written is detected before the work begins."""
    check_suffix("--plot", options.plot, ".png")
    check_suffix("--mcap", options.mcap, ".mcap")
    check_suffix("--out", options.report, ".html")
    files = (options.csv, options.json, options.plot, options.report, options.mcap, options.smooth_csv)
    outputs = [path for path in files if path]
    inputs = [Path(log) for log in options.logs] + [path for path in (options.truth, options.stored) if path]
    check_outputs(outputs, inputs)
    if options.plot and importlib.util.find_spec("matplotlib") is None:
        raise UsageError("--plot needs the extra plot: pip install 'fusiond[plot]'")
    if options.report and importlib.util.find_spec("bokeh") is None:
        raise UsageError("a report needs the extra report: pip install 'fusiond[report]'")
    if options.csv:
        task.on_tick.append(csv_file(options.csv, stack))
    if options.mcap:
        task.on_message.append(mcap_file(options.mcap, options.config, stack))


def _summary(options: Options, run: Replay, logs: LogSet, attached_warnings: Sequence[str]) -> Summary:
    """The summary, with findings. Raises NothingAskedFor if no event was read."""
    names, sources, file = short_names(logs.counts), run.sources(), options.config.path(options.config_name)
    if run.first_ns is None:
        found = "; ".join(f"{names[path]}: {counts}" for path, counts in logs.counts.items())
        why = "\n".join(lines(located(missing(options.config, sources, logs), file)))
        raise NothingAskedFor(f"nothing in the logs that the configuration asks for ({found})\n{why}")
    warnings = [with_short_names(warning, names) for warning in logs.warnings]
    summary = run.summary(options.config_name, {names[path]: counts for path, counts in logs.counts.items()}, warnings)
    if options.stored and (verdict := run.fusion.hot_start()) is not Verdict.USED:
        warnings.append(f"stored state: {WORDS[verdict]}")
    if options.truth and summary.truth is None:
        warnings.append(f"{options.truth.name}: no published state to compare with it; is it of this drive?")
    has_state = summary.final.state is not None
    findings = located(diagnose(run.evidence, run.fusion, sources, logs, has_state=has_state), file)
    if exit_code(findings):
        warnings += oddities(options.config)
    warnings += attached_warnings
    return replace(summary, findings=findings)
