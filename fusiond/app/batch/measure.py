"""Measuring one drive: its files are fetched, replayed, compared with the reference, and told as a row.

Everything in a row follows from the files, the configuration and the version: no clock of this machine is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from fusiond.app.batch.job import Drive, DriveFile, Job
from fusiond.app.batch.row import CalibrationRow, FindingRow, Row, SourceRow
from fusiond.app.diagnosis.diagnose import diagnose, missing
from fusiond.app.replay.comparison import Errors
from fusiond.app.replay.files import short_names, stored_state, truth_of, with_short_names
from fusiond.app.replay.job import Options as ReplayOptions
from fusiond.app.replay.job import replay
from fusiond.app.replay.outages import RECOVERY_S, OutageLog, OutageReport, course, parse_length, plan, report, withheld
from fusiond.app.replay.replay import WHOLE, Replay, ReplayTask
from fusiond.app.replay.smoothed import Smoothing
from fusiond.app.replay.summary import Summary
from fusiond.app.replay.truth import Truth, TruthSample
from fusiond.app.tuning.tune import Finding, tune
from fusiond.config import load
from fusiond.config.schema import Config
from fusiond.errors import UnusableError, UsageError
from fusiond.estimator.solution import Mode
from fusiond.filter.calibration import calibrations
from fusiond.messages import StateMessage
from fusiond.units import SECOND
from fusiond_adapters.logs.merge import LogSet, open_logs


class NoTrack(UnusableError):
    """The logs were read, and gave no state; the message says why."""


def tell(job: Job) -> list[Finding]:
    """What a drive says of the configuration; nothing if it cannot be used."""
    try:
        with _at_hand(job.drive) as files:
            return _Measurement(job, files, job.known()).told()
    except (UnusableError, UsageError, OSError):
        return []  # the row of the drive says why


def measure(job: Job) -> Row:
    """The row of a job; what cannot be used is told in it. Other exceptions are faults of the program."""
    known = job.known()
    with ExitStack() as stack:
        folders: dict[str, str] = {}
        try:
            files = stack.enter_context(_at_hand(job.drive))
            folders = {f"{path.parent}/": "" for path in files.values()}
            measurement = _Measurement(job, files, known)
            return measurement.reported() if job.report else measurement.row()
        except (UnusableError, UsageError) as error:
            return Row(status="failed", reason=with_short_names(str(error), folders), **known)
        except OSError as error:
            return Row(status="failed", reason=with_short_names(_in_words(error), folders), **known)


def _in_words(error: OSError) -> str:
    return f"{Path(error.filename).name}: {error.strerror}" if error.filename else str(error) or type(error).__name__


# --- Files


@contextmanager
def _at_hand(drive: Drive) -> Iterator[dict[str, Path]]:
    """Inside the block: where each file of a drive can be read, by its name. Remote files are fetched into a folder of their
    own; so is a configuration whose files lie under other names than it says."""
    with TemporaryDirectory(prefix="fusiond-") as name:
        folder = Path(name)
        yield {file.name: _fetched(file, folder, together=bool(drive.beside)) for file in drive.files()}


def _fetched(file: DriveFile, folder: Path, *, together: bool) -> Path:
    if file.is_remote:
        from fusiond.app.batch.storage import fetch  # noqa: PLC0415 - needs the extra `batch`

        return fetch(file.where, folder / file.name)
    path = Path(file.where)
    if together:
        (folder / file.name).symlink_to(path.absolute())
        return folder / file.name
    return path


# --- The replays of one drive


class Course:
    """How many states a replay gave, how far the vehicle came, and if it `keeps` them, where they were: a reference for a
    replay without GNSS. Of sessions that step back only what is later than all before counts."""

    def __init__(self, *, keeps: bool) -> None:
        self.states = 0
        self.distance_m = 0.0  # by the published velocities
        self.samples: list[TruthSample] = []
        self._keeps, self._last_ns = keeps, 0

    def add(self, message: StateMessage, _: Errors | None) -> None:
        """Add a published state."""
        state = message.state
        if state is None or message.t_ns <= self._last_ns:
            return
        north, east, _down = state.velocity_ned_mps
        if self.states:
            self.distance_m += math.hypot(north, east) * (message.t_ns - self._last_ns) / SECOND
        self.states += 1
        self._last_ns = message.t_ns
        if self._keeps:
            place = state.lat_deg, state.lon_deg, state.height_m
            self.samples.append(TruthSample(message.t_ns, *place, north, east, state.yaw_deg))


class _Measurement:
    def __init__(self, job: Job, files: dict[str, Path], known: dict[str, Any]) -> None:
        self._job, self._files, self._known = job, files, known
        self._logs = job.drive.logs
        self._config = self._loaded(job.config)
        self._truth_file = files[job.drive.truth.name] if job.drive.truth else None
        self._smoothed: list[TruthSample] = []  # the reference where there is no truth, if it is wanted

    def _loaded(self, path: str) -> Config:
        """A configuration; of an empty path the drive's own."""
        own = self._job.drive.config
        if not path and own is None:
            raise UnusableError("no configuration lies beside the logs, and none was given")
        return load.load(path or self._files[own.name if own else ""])

    def told(self) -> list[Finding]:
        """What the drive says of the configuration."""
        found = tune(Path(self._job.config), self._paths()).findings
        return [one for one in found if math.isfinite(one.found) and math.isfinite(one.sigma)]  # an answer is JSON

    def reported(self) -> Row:
        """Write the report of the drive."""
        job, truth = self._job, self._truth_file
        stored = self._files[job.drive.stored.name] if job.drive.stored else None
        options = ReplayOptions(
            self._config, str(self._known["config"]), self._paths(), truth=truth, stored=stored, report=Path(job.report),
            rate_hz=job.options.rate_hz, bar=False,
        )  # fmt: skip
        replay(options)
        return Row(status="ok", **self._known)

    def row(self) -> Row:
        if self._job.smoothed_by is not None and self._truth_file is None:
            self._smoothed = self._smooth(self._loaded(self._job.smoothed_by))
        first, track = Course(keeps=bool(self._job.options.outage)), None
        task = self._task()
        task.on_tick.append(first.add)
        with ExitStack() as stack:
            if self._job.track:
                from fusiond.app.batch.track import TrackFile  # noqa: PLC0415 - needs the extra `batch`

                track = stack.enter_context(TrackFile(Path(self._job.track)))
                task.on_tick.append(track.add)
            run, logs = self._run(task)
            if run.first_ns is None:
                why = "; ".join(one.text for one in missing(self._config, run.sources(), logs))
                raise NoTrack(f"nothing in the logs that the configuration asks for: {why}")
            names = short_names(logs.counts)
            counts = {names[path]: count for path, count in logs.counts.items()}
            warnings = [with_short_names(warning, names) for warning in logs.warnings]
            summary = run.summary(str(self._known["config"]), counts, warnings)
            has_state = summary.final.state is not None
            findings = diagnose(run.evidence, run.fusion, run.sources(), logs, has_state=has_state)
            if not first.states:
                reasons = "; ".join(one.text for one in findings if one.weight == "no_state")
                why = summary.final.fault or reasons or "the filter never had enough data to start"
                raise NoTrack(f"no state: {why}")
        outages = self._outages(run, first) if self._job.options.outage else None
        row = self._told(summary, run, first, outages, Path(self._job.track).name)
        found = [FindingRow(kind=one.kind, weight=one.weight, text=one.text, key=one.key) for one in findings]
        return msgspec.structs.replace(row, findings=found)

    def _smooth(self, config: Config) -> list[TruthSample]:
        """The smoothed track by a configuration; empty where the logs give none."""
        course = Course(keeps=True)
        with ExitStack() as stack:
            smoothing = Smoothing([course.add], stack)
            task = self._task()
            task.on_tick.append(smoothing.add_tick)
            run = Replay(config, task)
            smoothing.attach(run)
            run.run(open_logs(self._paths(), config))
            if run.first_ns is not None:
                smoothing.finish(None, WHOLE)
        return course.samples

    def _paths(self) -> list[str]:
        """The logs, as `replay` is given them."""
        return [f"{log.link}={self._files[log.name]}" if log.link else str(self._files[log.name]) for log in self._logs]

    def _task(self) -> ReplayTask:
        truth = truth_of(self._truth_file) if self._truth_file else Truth(self._smoothed) if self._smoothed else None
        stored = self._job.drive.stored
        return ReplayTask(
            self._job.options.rate_hz,
            truth=truth,
            stored_state=stored_state(self._files[stored.name], self._config) if stored else None,
        )

    def _run(self, task: ReplayTask) -> tuple[Replay, LogSet]:
        logs = open_logs(self._paths(), self._config)
        run = Replay(self._config, task)
        run.run(logs)
        return run, logs

    def _outages(self, run: Replay, first: Course) -> OutageReport | None:
        """A second replay, with GNSS withheld again and again; None if the drive is too short for one outage."""
        length, task = parse_length(self._job.options.outage), self._task()
        task.truth = task.truth or Truth(first.samples)
        begin_s = (run.first_nominal_s if run.first_nominal_s is not None else math.inf) + RECOVERY_S
        stretches = next(iter(plan(course(task.truth, run.engine.origin_ns), length, begin_s)), [])
        if not stretches or run.engine.steps_back:
            return None
        log = OutageLog(stretches)
        task.withheld = withheld(stretches, self._config)
        task.on_tick.append(lambda state, errors: log.add(state.t_ns - run.engine.origin_ns, state, errors))
        self._run(task)
        return report(length, log.ends())

    def _told(self, summary: Summary, run: Replay, first: Course, outages: OutageReport | None, track: str) -> Row:
        truth, published = summary.truth, summary.published
        position = truth.position if truth else None
        rows = published.rows if published else 0
        modes = {mode: published.modes.get(mode.value, 0) / rows if published and rows else None for mode in Mode}
        late = [source.latency_ms.p99 for source in summary.sources.values() if source.latency_ms]
        return Row(
            status="ok",
            **self._known,
            vehicle=summary.vehicle,
            seconds=summary.span.seconds,
            distance_m=truth.distance_m if truth else first.distance_m,
            events=summary.events,
            warnings=summary.warnings,
            reference=("smoother" if self._smoothed else "truth") if truth else "",
            position_rmse_m=position.rmse_m if position else None,
            position_p95_m=position.p95_m if position else None,
            position_max_m=position.max_m if position else None,
            position_end_m=position.end_m if position else None,
            inside_95=position.inside_95 if position else None,
            nees=position.nees if position else None,
            height_rmse_m=truth.height_rmse_m if truth else None,
            velocity_rmse_mps=truth.velocity_rmse_mps if truth else None,
            heading_rmse_deg=truth.heading.rmse_deg if truth else None,
            outages=outages.outages if outages else [],
            outage_68_percent=outages.p68_percent if outages else None,
            outage_max_percent=outages.max_percent if outages else None,
            states=rows,
            aligning=modes[Mode.ALIGNING],
            nominal=modes[Mode.NOMINAL],
            dead_reckoning=modes[Mode.DEAD_RECKONING],
            lost=modes[Mode.LOST],
            resets=summary.final.resets,
            latency_p99_ms=max(late, default=None),
            sources=_sources(summary, run),
            calibration=_calibration(run),
            track=track,
        )


def _sources(summary: Summary, run: Replay) -> list[SourceRow]:
    beliefs = run.fusion.health(run.engine.now_ns)
    return [
        SourceRow(
            name=name,
            events=one.events,
            fused=one.fused,
            rejected=one.rejected,
            too_old=one.too_old,
            invalid=one.invalid,
            latency_p50_ms=one.latency_ms.p50 if one.latency_ms else None,
            latency_p99_ms=one.latency_ms.p99 if one.latency_ms else None,
            status=beliefs[name].status,
            remark=one.remark or beliefs[name].reason,
        )
        for name, one in summary.sources.items()
    ]


def _calibration(run: Replay) -> list[CalibrationRow]:
    found = calibrations(run.fusion.params, run.fusion.history.head)
    return [
        CalibrationRow(name=name, value=value, sigma=sigma)
        for name, (value, sigma) in found.items()
        if math.isfinite(value) and math.isfinite(sigma)
    ]
