"""What a batch has done so far: the plan and the finished rows in one SQLite file, so that a killed batch goes on.

A row is in it or not; nothing of a torn write is ever seen. The plan and the rows are read in the order of their drives,
so memory does not grow with the number of drives.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import msgspec

from fusiond.app.batch.job import Job, Limits
from fusiond.app.batch.row import Row
from fusiond.app.tuning.tune import Finding
from fusiond.errors import OutputError, UnusableError

NAME = "batch.sqlite"
TABLES = """
create table if not exists plan (
  role text, drive text, key text, size integer, job blob, primary key (role, drive)) without rowid;
create index if not exists plan_key on plan (key);
create table if not exists rows (
  key text primary key, status text, limits text, row blob, cpu_s real, peak_mb real) without rowid;
create table if not exists told (key text primary key, findings blob) without rowid;
create temp table todo (number integer primary key, key text);
"""
AT_ONCE = 256  # keys of the plan that are read together


class Cost(NamedTuple):
    """What the rows of a plan have cost, when they were made."""

    rows: int
    cpu_s: float
    peak_mb: float  # of the largest


class Store:
    """The file in the folder of a batch. Raises OutputError if it cannot be used. A context manager."""

    def __init__(self, folder: Path) -> None:
        path = folder / NAME
        self._limits = ""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._base = sqlite3.connect(path, isolation_level=None)
            self._base.execute("pragma journal_mode = wal")
            self._base.execute("pragma cache_size = -2000")
            self._base.executescript(TABLES)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
        except sqlite3.Error as error:
            raise OutputError(f"{path}: cannot be used: {error}") from error

    # --- The plan of this run

    def begin_plan(self) -> None:
        """Forget the plan of the last run; its rows stay."""
        self._base.execute("begin immediate")
        self._base.execute("delete from plan")

    def plan(self, role: str, drive: str, key: str, job: Job) -> None:
        """Add a job; one of the same drive and role is there once. Raises UnusableError if it is of another content."""
        added = self._base.execute(
            "insert or ignore into plan values (?, ?, ?, ?, ?)", (role, drive, key, job.drive.size, msgspec.json.encode(job))
        )
        if added.rowcount == 0:
            ((known,),) = self._base.execute("select key from plan where role = ? and drive = ?", (role, drive))
            if known != key:
                raise UnusableError(f"{drive}: two drives have this name")

    def end_plan(self, limits: Limits) -> None:
        """The plan is complete. What ran into other limits than these, or was killed from outside, is done again."""
        self._limits = _text(limits)
        self._base.execute(
            "delete from rows where key in (select key from plan)"
            " and (status = 'crashed' or status in ('timed out', 'out of memory') and limits <> ?)",
            (self._limits,),
        )
        self._base.execute("commit")

    def planned(self, role: str) -> int:
        """The number of drives of a role."""
        ((count,),) = self._base.execute("select count(*) from plan where role = ?", (role,))
        return int(count)

    def left(self) -> int:
        """The number of rows that are planned and not done."""
        ((count,),) = self._base.execute("select count(distinct key) from plan where key not in (select key from rows)")
        return int(count)

    def pending(self) -> Iterator[tuple[str, Job]]:
        """The key and job of each row that is not done, the largest drives first, so that the end is not waited for. Each
        key comes once. Rows may be put while this is read."""
        self._base.execute("delete from todo")
        self._base.execute(
            "insert into todo (key) select key from plan where key not in (select key from rows)"
            " group by key order by max(size) desc, key"
        )
        last = 0
        while some := self._base.execute(
            "select number, key from todo where number > ? order by number limit ?", (last, AT_ONCE)
        ).fetchall():
            for number, key in some:
                last = number
                ((job,),) = self._base.execute("select job from plan where key = ? limit 1", (key,))
                yield key, msgspec.json.decode(job, type=Job)

    # --- Rows

    def put(self, key: str, row: Row, cpu_s: float, peak_mb: float) -> None:
        """Keep a finished row, for good."""
        self._base.execute(
            "insert or replace into rows values (?, ?, ?, ?, ?, ?)",
            (key, row.status, self._limits, msgspec.json.encode(row), cpu_s, peak_mb),
        )

    def rows(self, role: str) -> Iterator[tuple[str, str, Row]]:
        """Drive, key and row of what is done of a role, by the names of the drives."""
        found = self._base.cursor().execute(
            "select drive, key, row from plan join rows using (key) where role = ? order by drive", (role,)
        )
        for drive, key, row in found:
            yield drive, key, msgspec.json.decode(row, type=Row)

    def jobs(self, role: str) -> Iterator[tuple[str, str, Job]]:
        """Drive, key and job of a role, by the names of the drives."""
        found = self._base.cursor().execute("select drive, key, job from plan where role = ? order by drive", (role,))
        for drive, key, job in found:
            yield drive, key, msgspec.json.decode(job, type=Job)

    def put_told(self, key: str, findings: list[Finding]) -> None:
        """Keep what a drive has told, for good."""
        self._base.execute("insert or replace into told values (?, ?)", (key, msgspec.json.encode(findings)))

    def told(self, key: str) -> list[Finding] | None:
        """What the drive with a key has told; None: it was not asked yet."""
        found = self._base.execute("select findings from told where key = ?", (key,)).fetchone()
        return None if found is None else msgspec.json.decode(found[0], type=list[Finding])

    def job(self, role: str, drive: str) -> Job:
        """The job of a drive."""
        ((job,),) = self._base.execute("select job from plan where role = ? and drive = ?", (role, drive))
        return msgspec.json.decode(job, type=Job)

    def cost(self) -> Cost:
        """Of all rows of the plan."""
        ((rows, cpu_s, peak_mb),) = self._base.execute(
            "select count(*), total(cpu_s), max(peak_mb) from rows where key in (select key from plan)"
        )
        return Cost(int(rows), float(cpu_s), float(peak_mb or 0.0))

    def close(self) -> None:
        """Close the file."""
        self._base.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _text(limits: Limits) -> str:
    return f"{limits.seconds:g} s, {limits.memory_mb:g} MB"
