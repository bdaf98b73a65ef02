"""One drive to be measured by one configuration, and the options that all drives of a batch share."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

from msgspec import Struct

from fusiond import __version__
from fusiond.app.batch.row import Row, Status
from fusiond.app.tuning.tune import Finding

OWN = "own"  # in place of a configuration: the one that lies beside each drive


class DriveFile(Struct, frozen=True, kw_only=True):
    """A file of a drive: a path or an URL, the name that it is read under, and the link or bus of a log if it is given."""

    where: str
    name: str
    link: str = ""

    @property
    def is_remote(self) -> bool:
        """Whether it has to be fetched first."""
        return "://" in self.where


class Drive(Struct, frozen=True, kw_only=True):
    """The files of one drive as they lie. `beside` are DBC files that its own configuration names."""

    name: str
    logs: list[DriveFile]
    truth: DriveFile | None = None
    stored: DriveFile | None = None  # the stored state that the recorded run started with
    config: DriveFile | None = None  # the one that it was recorded with
    beside: list[DriveFile] = []
    size: int = 0  # of the logs [bytes]

    def files(self) -> list[DriveFile]:
        """All of them."""
        return [*self.logs, *filter(None, (self.truth, self.stored, self.config)), *self.beside]


class Limits(Struct, frozen=True, kw_only=True):
    """What the process of one drive may use."""

    seconds: float = 600.0  # of processor time; ten times as much may pass while it waits
    memory_mb: float = 2000.0


class Options(Struct, frozen=True, kw_only=True):
    """What is measured, the same for all drives. It belongs to the key of a row."""

    rate_hz: float = 10.0  # states compared a second
    outage: str = ""  # length of the outages, such as 60s or 1000m; empty: none
    smooth: bool = False  # where there is no truth, compare with the smoother
    tracks: bool = False


class Job(Struct, frozen=True, kw_only=True):
    """One drive by one configuration, as it is sent to a worker. A configuration is a path; empty: the drive's own."""

    drive: Drive
    config: str
    options: Options
    limits: Limits
    smoothed_by: str | None = None  # where there is no truth: the configuration of the smoother to compare with; None: none
    track: str = ""  # file to write the track to; empty: none
    tune: bool = False  # tell what the drive says of the configuration, instead of anything else
    report: str = ""  # file to write the report to, instead of anything else; empty: none

    def known(self) -> dict[str, Any]:
        """The fields of its row that are known before anything is read."""
        own = self.drive.config.name if self.drive.config else ""
        config, logs = PurePosixPath(self.config or own).name, [log.name for log in self.drive.logs]
        return {"fusiond": __version__, "config": config, "logs": logs, "size": self.drive.size}


class Answer(Struct, frozen=True, kw_only=True):
    """What became of a job: its row, or how the process ended without one; and what it cost, which is in no row."""

    row: Row | None = None
    told: list[Finding] = []  # of a job that tunes
    status: Status = "ok"
    reason: str = ""
    cpu_s: float = 0.0
    peak_mb: float = 0.0
