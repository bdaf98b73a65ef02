"""A whole batch: drives are found, planned, measured, and summed up. A killed batch goes on where it was."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from msgspec.structs import replace

from fusiond.app.batch import keys
from fusiond.app.batch.drives import find
from fusiond.app.batch.engines import Engine
from fusiond.app.batch.findings import Findings, Keyed, gather
from fusiond.app.batch.job import OWN, Answer, Job, Limits, Options
from fusiond.app.batch.page import page
from fusiond.app.batch.row import Row
from fusiond.app.batch.store import Cost, Store
from fusiond.app.batch.table import read_rows, write_rows
from fusiond.app.batch.tune import (
    FOLDS,
    SHARED,
    FleetFinding,
    by_vehicle,
    joined,
    text_with,
    write_fold,
    write_vehicles,
)
from fusiond.app.replay.files import delivering
from fusiond.app.tuning.tune import Finding
from fusiond.config.toml import read_text
from fusiond.errors import UnusableError, UsageError

NEW, BASELINE, TUNED = "new", "baseline", "tuned"  # roles
VEHICLES = "vehicles.parquet"  # what is each vehicle's own
DRAWN_S = 0.2  # between two drawings of the progress
ROWS, SUMMARY, TRACKS, REPORTS = "rows.parquet", "summary.html", "tracks", "reports"


@dataclass(frozen=True, slots=True)
class Order:
    """The arguments of a batch."""

    drives: Sequence[str]
    folder: Path
    config: str = OWN
    baseline: str | None = None  # a configuration, OWN, or the rows of another batch
    options: Options = field(default_factory=Options)
    limits: Limits = field(default_factory=Limits)
    reports: int = 0  # of the worst drives


@dataclass(frozen=True, slots=True)
class Result:
    """What a batch gives besides its files."""

    findings: Findings
    made: int  # rows that were made by this run; the others were there
    cost: Cost


def run(order: Order, engine: Engine, progress: TextIO = sys.stderr) -> Result:
    """Run a batch to its end. Raises UsageError, UnusableError, OutputError."""
    with Store(order.folder) as store:
        plan(order, store)
        left = store.left()
        _measure(store, engine, left, progress)
        with delivering(order.folder / ROWS):
            write_rows(order.folder / ROWS, store.rows(NEW))
            if _of_rows(order.baseline) is None and order.baseline is not None:
                write_rows(order.folder / f"{BASELINE}.parquet", store.rows(BASELINE))
        findings = gather(store.rows(NEW), _baseline(order, store))
        links = _report(order, store, engine, findings)
        with delivering(order.folder / SUMMARY):
            text = page(findings, _title(order), links)
            (order.folder / SUMMARY).write_text(text, encoding="utf-8")
        return Result(findings, left, store.cost())


def plan(order: Order, store: Store) -> None:
    """Find the drives and the keys of their rows. Raises UsageError, UnusableError."""
    roles = [(NEW, order.config)]
    if order.baseline is not None and _of_rows(order.baseline) is None:
        roles.append((BASELINE, order.baseline))
    configurations = {config: None if config == OWN else keys.of_configuration(config) for _, config in roles}
    store.begin_plan()
    smoothed_by = roles[-1][1]  # the baseline if there is one: the reference is the same for both
    for drive in find(order.drives):
        smooths = order.options.smooth and drive.truth is None
        for role, config in roles:
            key = keys.of_row(drive, configurations[config], order.options, configurations[smoothed_by] if smooths else "")
            track = str((order.folder / TRACKS / f"{key}.parquet").absolute()) if order.options.tracks else ""
            job = Job(
                drive=drive, config=_path(config), options=order.options, limits=order.limits, track=track,
                smoothed_by=_path(smoothed_by) if smooths else None,
            )  # fmt: skip
            store.plan(role, drive.name, key, job)
    store.end_plan(order.limits)


def _path(config: str) -> str:
    """A configuration as a job has it."""
    return "" if config == OWN else str(Path(config).absolute())


def _of_rows(baseline: str | None) -> Path | None:
    """The file of rows that a baseline names, if it names one."""
    return Path(baseline) if baseline is not None and baseline.endswith(".parquet") else None


def _baseline(order: Order, store: Store) -> Iterator[Keyed] | None:
    if order.baseline is None:
        return None
    rows = _of_rows(order.baseline)
    return store.rows(BASELINE) if rows is None else read_rows(rows)


def _measure(store: Store, engine: Engine, left: int, progress: TextIO) -> None:
    """Make the rows that are missing; each is kept as soon as it is there."""
    jobs: dict[str, Job] = {}  # that were taken by the engine

    def pending() -> Iterator[tuple[str, Job]]:
        for key, job in store.pending():
            jobs[key] = job
            yield key, job

    with _Progress(left, progress) as shown:
        for key, answer in engine.answers(pending()):
            store.put(key, _row(jobs.pop(key), answer), answer.cpu_s, answer.peak_mb)
            shown.step()


@dataclass(frozen=True, slots=True)
class Tuned:
    """What a fleet tells of its configuration, and how that does on drives that did not tell it."""

    drives: int
    asked: int  # of these, that told something
    findings: list[FleetFinding]
    dropped: dict[str, Findings]  # groups that made other drives worse, and how; they are not taken
    judged: Findings  # of those that are taken, against the configuration given
    text: str  # of the new configuration


def tune(order: Order, engine: Engine, progress: TextIO = sys.stderr) -> Tuned:
    """Tune a configuration by all drives, judged by others than told it. Raises UsageError, UnusableError, OutputError."""
    with Store(order.folder) as store:
        plan(order, store)
        _ask(store, engine, progress)
        told = [(drive, store.told(key) or []) for drive, key, _ in store.jobs(NEW)]
        _measure(store, engine, store.left(), progress)
        best, taken, dropped = NEW, list[str](), dict[str, Findings]()
        for group in SHARED:
            if not any(one.differs for one in joined((found for _, found in told), [group])):
                continue
            role = f"{TUNED} {group}"
            _plan_folds(order, store, role, told, [*taken, group])
            _measure(store, engine, store.left(), progress)
            judged = gather(store.rows(role), store.rows(best))
            if judged.comparison is not None and judged.comparison.is_worse:
                dropped[group] = judged
            else:
                best, taken = role, [*taken, group]
        vehicles = {drive: row.vehicle for drive, _, row in store.rows(NEW)}
        own = by_vehicle((vehicles.get(drive, ""), found) for drive, found in told)
        with delivering(order.folder / VEHICLES):
            write_vehicles(order.folder / VEHICLES, own)
        text = text_with(read_text(Path(order.config)), joined((found for _, found in told), taken))
        findings = joined(found for _, found in told)
        asked = sum(bool(found) for _, found in told)
        return Tuned(len(told), asked, findings, dropped, gather(store.rows(best), store.rows(NEW)), text)


def _plan_folds(
    order: Order, store: Store, role: str, told: Sequence[tuple[str, list[Finding]]], groups: Sequence[str]
) -> None:
    """Plan each drive by a configuration with what the drives of the other folds tell of some groups."""
    files, digests = list[Path](), list[str]()
    for fold in range(FOLDS):
        others = (found for number, (_, found) in enumerate(told) if number % FOLDS != fold)
        files.append(order.folder / "folds" / f"{role.replace(' ', '-')}-{fold}.toml")
        with delivering(files[-1]):
            write_fold(order.config, joined(others, groups), files[-1])
        digests.append(keys.of_configuration(str(files[-1])))
    for number, (drive, _, job) in enumerate(list(store.jobs(NEW))):
        fold = number % FOLDS
        key = keys.of_row(job.drive, digests[fold], order.options)
        store.plan(role, drive, key, replace(job, config=str(files[fold].absolute())))


def _ask(store: Store, engine: Engine, progress: TextIO) -> None:
    """Ask every drive that was not asked yet what it says of the configuration."""
    left = [key for _, key, _ in store.jobs(NEW) if store.told(key) is None]
    wanted = set(left)
    jobs = ((key, replace(job, tune=True)) for _, key, job in list(store.jobs(NEW)) if key in wanted)
    with _Progress(len(left), progress) as shown:
        for key, answer in engine.answers(jobs):
            if answer.status == "ok":
                store.put_told(key, answer.told)
            shown.step()


def _report(order: Order, store: Store, engine: Engine, findings: Findings) -> dict[str, str]:
    """Write the reports of the worst drives; returns where they are, by drive. One that fails has none."""
    worst = [one.drive for one in findings.worst[: order.reports]]
    if not worst or importlib.util.find_spec("bokeh") is None:
        return {}
    folder = order.folder / REPORTS
    with delivering(folder):
        folder.mkdir(exist_ok=True)

    def jobs() -> Iterator[tuple[str, Job]]:
        for number, drive in enumerate(worst):
            job = store.job(NEW, drive)
            yield drive, replace(job, report=str((folder / f"{number:02d}.html").absolute()))

    written = {drive for drive, answer in engine.answers(jobs()) if answer.row is not None and answer.row.status == "ok"}
    return {drive: f"{REPORTS}/{number:02d}.html" for number, drive in enumerate(worst) if drive in written}


def _row(job: Job, answer: Answer) -> Row:
    return answer.row or Row(status=answer.status, reason=answer.reason, **job.known())


def _title(order: Order) -> str:
    new = "each drive's own configuration" if order.config == OWN else Path(order.config).name
    if order.baseline is None:
        return f"fusiond batch: {new}"
    old = "each drive's own configuration" if order.baseline == OWN else Path(order.baseline).name
    return f"fusiond batch: {new} against {old}"


class _Progress:
    """The number of finished rows, on a terminal."""

    def __init__(self, total: int, stream: TextIO) -> None:
        self._total, self._stream = total, stream
        self._done, self._begun, self._drawn = 0, time.monotonic(), 0.0

    def step(self) -> None:
        self._done += 1
        now = time.monotonic()
        if self._stream.isatty() and now - self._drawn >= DRAWN_S:
            self._drawn = now
            left_s = (self._total - self._done) * (now - self._begun) / self._done
            self._stream.write(f"\r\x1b[K{self._done} of {self._total} rows, {left_s / 60:.0f} min left")
            self._stream.flush()

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream.isatty():
            self._stream.write("\r\x1b[K")
            self._stream.flush()


def dry(order: Order) -> str:
    """What a batch would do, in words; nothing is written but the plan."""
    with ExitStack() as stack:
        store = stack.enter_context(Store(order.folder))
        plan(order, store)
        drives, left = store.planned(NEW), store.left()
        return f"{drives} drives; {left} rows to be made, the others are there"


def check(order: Order) -> None:
    """Check what can be checked before the work begins. Raises UsageError, UnusableError."""
    rows = _of_rows(order.baseline)
    if rows is not None:
        if not rows.is_file():
            raise UnusableError(f"{rows}: there is no such file")
        if rows.resolve() == (order.folder / ROWS).resolve():
            raise UsageError(f"{rows}: would be overwritten; give another folder by -o")
        next(read_rows(rows), None)
