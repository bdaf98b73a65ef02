"""The key of a row: a hash of everything that it follows from: files, configuration, options, version."""

from __future__ import annotations

import hashlib

import msgspec

from fusiond import __version__
from fusiond.app.batch import storage
from fusiond.app.batch.job import Drive, DriveFile, Options
from fusiond.app.batch.row import LAYOUT
from fusiond.config import load
from fusiond.config.toml import ConfigError
from fusiond.errors import UnusableError


def of_configuration(path: str) -> str:
    """The digest of a configuration and of the DBC files that it names. Raises ConfigError, UnusableError."""
    config = load.load(path)
    files = [path, *(str(config.path(dbc)) for bus in config.can.values() for dbc in bus.dbc)]
    return _hash([storage.digest(file) for file in files])


def of_row(drive: Drive, configuration: str | None, options: Options, smoothed_by: str | None = "") -> str:
    """The key of the row of a drive by configurations with these digests, and of the smoother that is compared with; None:
    the drive's own."""
    own = _own(drive) if configuration is None or smoothed_by is None else ""
    configurations = [own if one is None else one for one in (configuration, smoothed_by)]
    files = [_about(file) for file in (*drive.logs, *filter(None, (drive.truth, drive.stored)))]
    return _hash([__version__, LAYOUT, msgspec.json.encode(options).decode(), *configurations, *files])


def _own(drive: Drive) -> str:
    """The digest of a drive's own configuration. What is wrong with it is told in the row."""
    if drive.config is None:
        return ""
    files = [drive.config, *drive.beside]
    if not drive.config.is_remote and not drive.beside:
        try:
            return f"{drive.config.name} {of_configuration(drive.config.where)}"
        except ConfigError:
            pass
    return " ".join(_about(file) for file in files)


def _about(file: DriveFile) -> str:
    """What a file adds to a key. That one cannot be read is told in the row."""
    try:
        return f"{file.name} {file.link} {storage.digest(file.where)}"
    except UnusableError:
        return f"{file.name} {file.link} not readable"


def _hash(parts: list[object]) -> str:
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:32]
