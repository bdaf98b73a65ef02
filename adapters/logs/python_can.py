"""Readers of the CAN logs that python-can knows: .asc, .blf, .trc, .csv, .db (its SQLite), .mf4 (with the extra `mf4`).

Stamps are those of the log, absolute if it has its start time.
"""

from __future__ import annotations

import importlib.util
import io
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import can
from can.io.blf import BLFParseError

from fusiond.units import MICROSECOND
from fusiond_adapters.logs.blf import checked
from fusiond_adapters.logs.can_channels import LogFrame, Wanted, open_can_log, survey_can_log
from fusiond_adapters.logs.file import MAX_LINE, BlockStream, LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading

if TYPE_CHECKING:
    from fusiond_adapters.logs.survey import Survey

BINARY = (".blf", ".db", ".mf4")  # the others are text
FILES = (".db", ".mf4")  # read from a file, not from a stream
MF4_MAGIC = (b"MDF", b"UnFinMF")
MAX_ROW, MIN_ROW = 1 << 16, 4  # bytes of a row in a .db

# Exceptions of python-can's readers on content that is not of their format.
DAMAGE: tuple[type[Exception], ...] = (
    ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError,
    struct.error, zlib.error, sqlite3.Error, BLFParseError,
)  # fmt: skip


def open_log(opening: Opening) -> Reading:
    """The reading of a log, by its suffix. Raises LogError, ConfigError."""
    return open_can_log(opening, _python_can)


def survey(found: Survey) -> None:
    """Add what is in a log to a survey. Raises LogError."""
    survey_can_log(found, _python_can)


def _python_can(log: LogFile, wanted: Wanted) -> Iterator[LogFrame]:
    """The frames, whose ids are wanted, of a log that python-can reads."""
    counts = log.counts
    for message in _messages(log):
        counts["frames"] += 1
        if message.is_error_frame:
            counts["error frames"] += 1
        elif not wanted.holds(message.arbitration_id, message.is_extended_id):
            counts["other ids"] += 1
        elif message.is_remote_frame:
            counts["remote frames"] += 1
        else:
            try:
                t_ns = round(message.timestamp * 1e6) * MICROSECOND  # a float of Unix time is not more accurate
            except (ValueError, OverflowError):
                counts["bad stamps"] += 1
                continue
            channel = None if message.channel is None else str(message.channel)
            yield LogFrame(t_ns, channel, message.arbitration_id, message.is_extended_id, bytes(message.data))


class _Text(io.TextIOWrapper):
    """The text of a log; counts the lines read. A line that is too long is left out, and never held as a whole."""

    def __init__(self, log: LogFile) -> None:
        super().__init__(log.stream(), encoding="utf-8", errors="replace")
        self.lines = 0
        self._counts = log.counts

    def __next__(self) -> str:  # type: ignore[override]  # typeshed's own TextIOWrapper needs the same
        while line := self.readline(MAX_LINE):
            self.lines += 1
            if len(line) < MAX_LINE or line.endswith("\n"):
                return line
            self._counts["bad lines"] += 1
            while line and not line.endswith("\n"):
                line = self.readline(MAX_LINE)
        raise StopIteration


def _messages(log: LogFile) -> Iterator[can.Message]:
    """python-can's messages. After a bad line of a text format, reading continues and loses at most one more line; a binary
    format ends there."""
    if log.suffix in FILES:
        with log.unzipped() as path:
            yield from _messages_at(log, path)
    else:
        yield from _messages_at(log, log.path)


def _messages_at(log: LogFile, path: Path) -> Iterator[can.Message]:
    """The same; `path`: of a file that python-can opens itself."""
    text = None if log.suffix in BINARY else _Text(log)
    damage = (*DAMAGE, *_mf4_damage(log)) if log.suffix == ".mf4" else DAMAGE
    try:
        reader = _open(log, text, path)
    except damage as error:
        raise LogError(f"{log.path}: is not a {log.suffix} log: {error}") from error
    with reader:
        lines = -1  # lines read when reading last failed
        while True:
            try:
                yield from reader
            except damage as error:
                if text is None:
                    if not log.counts["frames"]:
                        raise LogError(f"{log.path}: is not a {log.suffix} log: {error}") from error
                    log.counts["unreadable tail"] += 1
                    log.warnings.append(f"{log.path}: cannot be read to its end: {error}")
                    return
                if text.lines <= lines:
                    return  # the end: the reader failed because a header is missing
                lines = text.lines
                log.counts["bad lines"] += 1
            else:
                return


def _open(log: LogFile, text: _Text | None, path: Path) -> can.io.generic.MessageReader:
    """python-can's reader of the format: a text format reads from `text`."""
    if text is not None:
        if log.suffix == ".asc":
            return can.ASCReader(text, relative_timestamp=False)
        return can.TRCReader(text) if log.suffix == ".trc" else can.CSVReader(text)
    if log.suffix == ".blf":
        return can.BLFReader(io.BufferedReader(BlockStream(checked(log.stream()))))
    if log.suffix == ".db":
        return _Sqlite(log, path)
    with path.open("rb") as file:
        if not file.read(8).startswith(MF4_MAGIC):  # checked first: asammdf prints to standard error besides raising
            raise ValueError("it does not start like one")
    return can.MF4Reader(path)


class _Sqlite(can.io.generic.MessageReader):
    """The rows of python-can's table. Its own reader would run a view of that name, which may have any number of rows of
    any size. Raises sqlite3.Error, ValueError."""

    def __init__(self, log: LogFile, path: Path) -> None:
        self._log = log
        self._size = path.stat().st_size
        self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_ROW)
        self._base.execute("PRAGMA trusted_schema = OFF")
        kinds = [row[2] for row in self._base.execute("PRAGMA main.table_list('messages')")]
        if kinds != ["table"]:
            self._base.close()
            raise ValueError(f"its 'messages' is a {kinds[0]}" if kinds else "it has no table 'messages'")

    def __iter__(self) -> Iterator[can.Message]:
        most_rows = self._size // MIN_ROW  # a damaged tree may lead to the same row again and again
        for number, row in enumerate(self._base.execute("SELECT * FROM main.messages")):
            if number > most_rows:
                raise ValueError(f"more than {most_rows} rows")
            try:
                yield _message(*row)
            except (TypeError, ValueError):
                self._log.counts["bad rows"] += 1

    def stop(self) -> None:
        self._base.close()


def _message(t_s: float, number: int, extended: int, remote: int, error: int, dlc: int, data: bytes | None) -> can.Message:
    """A row as a message. Raises TypeError if a cell is of the wrong type."""
    if not (isinstance(t_s, int | float) and isinstance(number, int) and isinstance(data, bytes | None)):
        raise TypeError
    return can.Message(t_s, number, bool(extended), bool(remote), bool(error), dlc=dlc, data=data)


def _mf4_damage(log: LogFile) -> Iterator[type[Exception]]:
    """Exceptions of asammdf and its decompressors besides DAMAGE. Raises LogError if it is not installed."""
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{log.path}: reading .mf4 needs the extra mf4: pip install 'fusiond[mf4]'")
    yield RuntimeError
    yield MemoryError  # it believes sizes
    for module, name in (("asammdf.blocks.utils", "MdfException"), ("isal.igzip_lib", "IsalError"), ("zstd", "Error")):
        if importlib.util.find_spec(module.partition(".")[0]) is not None:
            yield getattr(importlib.import_module(module), name)
