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

import can
from can.io.blf import BLFParseError

from fusiond.units import MICROSECOND
from fusiond_adapters.logs.can_channels import LogFrame, Wanted, open_can_log
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading

BINARY = (".blf", ".db", ".mf4")  # the others are text
MF4_MAGIC = (b"MDF", b"UnFinMF")

# Exceptions of python-can's readers on content that is not of their format.
DAMAGE: tuple[type[Exception], ...] = (
    ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError,
    struct.error, zlib.error, sqlite3.Error, BLFParseError,
)  # fmt: skip


def open_log(opening: Opening) -> Reading:
    """The reading of a log, by its suffix. Raises LogError, ConfigError."""
    return open_can_log(opening, _python_can)


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
                counts["bad lines"] += 1
                continue
            channel = None if message.channel is None else str(message.channel)
            yield LogFrame(t_ns, channel, message.arbitration_id, message.is_extended_id, bytes(message.data))


class _Text(io.TextIOWrapper):
    """The text of a log; counts the lines read."""

    lines = 0

    def __next__(self) -> str:  # type: ignore[override]  # typeshed's own TextIOWrapper needs the same
        line = super().__next__()
        self.lines += 1
        return line


def _messages(log: LogFile) -> Iterator[can.Message]:
    """python-can's messages. After a bad line of a text format, reading continues and loses at most one more line; a binary
    format ends there."""
    text = None if log.suffix in BINARY else _Text(log.stream(), encoding="utf-8", errors="replace")
    damage = (*DAMAGE, *_mf4_damage(log)) if log.suffix == ".mf4" else DAMAGE
    try:
        reader = _open(log, text)
    except damage as error:
        raise LogError(f"{log.path}: is not a {log.suffix} log: {error}") from error
    with reader:
        lines = -1  # lines read when reading last failed
        while True:
            try:
                yield from reader
            except damage:
                if text is None:
                    log.counts["unreadable tail"] += 1
                    return
                if text.lines <= lines:
                    return  # the end: the reader failed because a header is missing
                lines = text.lines
                log.counts["bad lines"] += 1
            else:
                return


def _open(log: LogFile, text: _Text | None) -> can.io.generic.MessageReader:
    """python-can's reader of the format: a text format reads from `text`."""
    if text is not None:
        if log.suffix == ".asc":
            return can.ASCReader(text, relative_timestamp=False)
        return can.TRCReader(text) if log.suffix == ".trc" else can.CSVReader(text)
    if log.suffix == ".blf":
        return can.BLFReader(log.stream())
    if log.suffix == ".db":
        return can.SqliteReader(log.path)
    with log.path.open("rb") as file:
        if not file.read(8).startswith(MF4_MAGIC):  # checked first: asammdf prints to standard error besides raising
            raise ValueError("it does not start like one")
    return can.MF4Reader(log.path)


def _mf4_damage(log: LogFile) -> Iterator[type[Exception]]:
    """Exceptions of asammdf and its decompressors besides DAMAGE. Raises LogError if it is not installed."""
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{log.path}: reading .mf4 needs the extra mf4: pip install 'fusiond[mf4]'")
    yield RuntimeError
    for module, name in (("asammdf.blocks.utils", "MdfException"), ("isal.igzip_lib", "IsalError"), ("zstd", "Error")):
        if importlib.util.find_spec(module.partition(".")[0]) is not None:
            yield getattr(importlib.import_module(module), name)
