"""Reader of CAN logs: candump text by itself, because an hour has tens of millions of lines; the rest by python-can.

Formats, by suffix: .log (`candump -L`), .asc, .blf, .trc, .csv (python-can's), .db (python-can's SQLite), .mf4 (needs
the extra `mf4`); all but the last two also with .gz. Stamps are what the log holds, absolute where it tells its start.

Which bus a frame belongs to. A bus takes the frames of its `log_channel`, by default of its own name, as the log writes
it: .asc and .blf number their channels from 0, .trc from 1. If only one bus may be in the log, and its first wheel
frames are all on another channel, that channel is the bus: so a log of one bus needs no configuration, and a warning
says what was taken. A given `log_channel` forbids that, unless the bus is named with the log (`BUS=path`) or the format
has no channels. What no bus takes is counted; if that is all of the first wheel frames, it is an error.

Counts: `frames` (all readable ones), `other ids`, `other channels`, `error frames`, `remote frames`, `bad lines`,
`unreadable tail` (the rest of a damaged binary log), `bad stamps` (wheel frames dropped for their stamp).
"""

from __future__ import annotations

import importlib.util
import io
import re
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain, islice
from typing import NamedTuple

import can
from can.io.blf import BLFParseError

from fusiond.config.schema import Config
from fusiond.events import Received
from fusiond_adapters.can.decoder import PDU2, CanDecoder, frame_key, parameter_group
from fusiond_adapters.logs import LogError, LogInput

TEXT = {".asc": "Vector ASC", ".trc": "PEAK TRC", ".csv": "python-can CSV"}
BINARY = {".blf": "Vector BLF", ".db": "python-can SQLite", ".mf4": "ASAM MDF 4"}
SUFFIXES = (".log", *TEXT, *BINARY)
UNZIPPED_ONLY = (".db", ".mf4")

LINE = re.compile(
    rb"\s*\((\d{1,10})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"  # (seconds.fraction) channel id
    rb"#(?:#[0-9A-Fa-f])?([0-9A-Fa-f]*|[Rr][0-9A-Fa-f]?)(?:\s+[RTrt])?\s*"  # #data, ##flags data, or #R
)
OTHERS = (  # lines as candump itself writes them, of data frames whose ids are not among those at %(ids)b
    rb"((?:\(\d{1,10}\.\d{1,9}\) \S+ (?!(?:%(ids)b)#)(?:[0-9A-F]{3}|[01][0-9A-F]{7})#[0-9A-F]*+\n)*+)"
)
WANTED = rb"(?:\((\d{1,10})\.(\d{6})\) (\S+) (%(ids)b)#((?:[0-9A-F]{2})*+)\n)?+"  # the like, of an id that is
LONGEST_LINE = 1 << 16  # bytes; more without a line's end is no text
ERROR_FLAG, ID_BITS = 0x20000000, 0x1FFFFFFF  # in the 8-digit ids of candump
MF4_MAGIC = (b"MDF", b"UnFinMF")
STEP_NS = 1_000_000_000  # a stamp that jumps by more is compared with the next one
DECISION = 100  # wheel frames that the choice of channels looks at

# What python-can's readers are known to raise on content that is not of their format.
DAMAGE: tuple[type[Exception], ...] = (
    ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError,
    struct.error, zlib.error, sqlite3.Error, BLFParseError,
)  # fmt: skip


class _Frame(NamedTuple):
    t_ns: int
    channel: str | None
    arbitration_id: int
    is_extended: bool
    data: bytes


class _Wanted(NamedTuple):
    """Which frames carry a wheel."""

    keys: frozenset[int]  # see `frame_key`
    groups: frozenset[int]  # J1939's PGNs

    def holds(self, arbitration_id: int, is_extended: bool) -> bool:
        if frame_key(arbitration_id, is_extended) in self.keys:
            return True
        return is_extended and parameter_group(arbitration_id) in self.groups

    def patterns(self) -> Iterator[bytes]:
        """Regular expressions of the ids as candump writes them."""
        for key in self.keys:
            yield b"%03X" % key if key <= 0x7FF else b"%08X" % (key & ID_BITS)
        for group in self.groups:  # any priority, above the group's top bits; any destination, where it has one; any sender
            heads = b"|".join(b"%02X" % (priority << 2 | group >> 16) for priority in range(8))
            rest = b"%04X[0-9A-F]{2}" % (group & 0xFFFF)
            if group >> 8 & 0xFF < PDU2:
                rest = b"%02X[0-9A-F]{4}" % (group >> 8 & 0xFF)
            yield b"(?:%b)%b" % (heads, rest)


def read_can_log(
    log: LogInput, decoders: Mapping[str, CanDecoder], config: Config, *, named: bool = False
) -> Iterator[list[Received]]:
    """The wheel speeds in a CAN log, frame by frame in the order of the file.

    `decoders`: by bus, those that may be in this log. `named`: the log was given as that of the only one of them.
    Raises LogError where nothing in the file is a CAN frame, or no bus can be told from its channels.
    """
    keys, groups = zip(*((decoder.keys, decoder.groups) for decoder in decoders.values()), strict=True)
    wanted = _Wanted(frozenset().union(*keys), frozenset().union(*groups))
    frames = _without_strays(_candump(log, wanted) if log.suffix == ".log" else _python_can(log, wanted), log)
    head = list(islice(frames, DECISION))
    buses = _assign(log, [frame.channel for frame in head], decoders, config, named=named)
    for t_ns, channel, arbitration_id, is_extended, data in chain(head, frames):
        decoder = buses.get(channel)
        if decoder is None:
            log.counts["other channels"] += 1
        else:
            yield decoder.decode(arbitration_id, is_extended, data, t_ns)
    if not log.counts["frames"]:
        kind = "`candump -L`" if log.suffix == ".log" else (TEXT | BINARY)[log.suffix]
        raise LogError(f"{log.path}: no CAN frame in it; is it a {kind} log?")


def _without_strays(frames: Iterator[_Frame], log: LogInput) -> Iterator[_Frame]:
    """The frames but those whose stamp jumps away from the one before while the next is back: a damaged digit, which would
    hold up everything after it. A stamp that others follow is a clock that was set."""
    last_ns: int | None = None
    held: _Frame | None = None
    for frame in frames:
        if held is not None:
            jump_ns = 0 if last_ns is None else abs(held.t_ns - last_ns)
            if jump_ns > STEP_NS and last_ns is not None and abs(frame.t_ns - held.t_ns) > abs(frame.t_ns - last_ns):
                log.counts["bad stamps"] += 1
            else:
                last_ns = held.t_ns
                yield held
        held = frame
    if held is not None:
        yield held


def _assign(
    log: LogInput, seen: list[str | None], decoders: Mapping[str, CanDecoder], config: Config, *, named: bool
) -> dict[str | None, CanDecoder]:
    """The decoder of each channel, by the rule above; `seen`: the channels of the first wheel frames."""
    buses: dict[str | None, CanDecoder] = {}
    for name, decoder in decoders.items():
        if decoder.keys or decoder.groups:
            given = config.can[name].log_channel
            buses[name if given is None else given] = decoder
    channels = set(seen)
    if not channels or channels & set(buses):
        return buses
    if len(buses) == 1 and len(channels) == 1:
        channel, decoder = seen[0], next(iter(buses.values()))
        if channel is None:
            return {None: decoder}
        if named or config.can[decoder.bus].log_channel is None:
            log.warnings.append(f"{log.path}: channel {channel} is taken for the bus {decoder.bus}")
            return {channel: decoder}
    if None in channels:
        raise LogError(f"{log.path}: its format has no channels; say whose it is: BUS={log.path}")
    listed = ", ".join(sorted(str(channel) for channel in channels))
    wanted = ", ".join(str(channel) for channel in buses)
    raise LogError(f"{log.path}: wheel frames are on {listed}, wanted on {wanted}: set log_channel in [can.BUS]")


def _candump(log: LogInput, wanted: _Wanted) -> Iterator[_Frame]:
    """The frames of a `candump -L` log whose ids are wanted. Most lines of a log are of other ids: stretches of them are
    passed over in one step."""
    ids = b"|".join(wanted.patterns()) or b"-"  # no id begins with a dash
    scan = re.compile((OTHERS + WANTED) % {b"ids": ids}).match
    counts = log.counts
    for text in _whole_lines(log):
        at = 0
        while at < len(text):
            found = scan(text, at)
            assert found is not None, "it may be empty"
            passed = text.count(b"\n", at, found.end(1))
            counts["frames"] += passed
            counts["other ids"] += passed
            at = found.end()
            seconds, micros, channel, digits, content = found.group(2, 3, 4, 5, 6)
            if digits is not None:
                counts["frames"] += 1
                name, data = channel.decode("utf-8", "replace"), bytes.fromhex(content.decode("ascii"))
                yield _Frame(int(seconds + micros) * 1000, name, int(digits, 16), len(digits) == 8, data)
            elif at < len(text):
                end = text.index(b"\n", at) + 1
                frame = _frame(text[at:end], wanted, counts)
                if frame is not None:
                    yield frame
                at = end


def _frame(line: bytes, wanted: _Wanted, counts: Counter[str]) -> _Frame | None:
    """The frame in a line, if its id is wanted. Everything is counted."""
    found = LINE.fullmatch(line)
    if found is None:
        counts["bad lines"] += bool(line.strip())
        return None
    seconds, fraction, channel, digits, content = found.groups()
    number, is_extended = int(digits, 16), len(digits) == 8
    is_wanted = number <= ID_BITS and wanted.holds(number, is_extended)
    remote = content[:1] in (b"R", b"r")
    if is_wanted and not remote and len(content) % 2:
        counts["bad lines"] += 1
        return None
    counts["frames"] += 1
    if not is_wanted:
        error = is_extended and number & ERROR_FLAG
        counts["error frames" if error else "other ids"] += 1
        return None
    if remote:
        counts["remote frames"] += 1
        return None
    t_ns = int(seconds) * 10**9 + int(fraction.ljust(9, b"0"))
    data = bytes.fromhex(content.decode("ascii"))
    return _Frame(t_ns, channel.decode("utf-8", "replace"), number, is_extended, data)


def _whole_lines(log: LogInput) -> Iterator[bytes]:
    """A text log in pieces that end where a line ends, in bounded memory."""
    rest = b""
    for block in log.blocks():
        head, end, tail = block.rpartition(b"\n")
        if end:
            yield rest + head + end
            rest = tail
        else:
            rest += tail
        if len(rest) > LONGEST_LINE:
            log.counts["bad lines"] += 1
            rest = b""
    if rest:
        yield rest + b"\n"


def _python_can(log: LogInput, wanted: _Wanted) -> Iterator[_Frame]:
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
                t_ns = round(message.timestamp * 1e6) * 1000  # a float of Unix time is good for no more than that
            except (ValueError, OverflowError):
                counts["bad lines"] += 1
                continue
            channel = None if message.channel is None else str(message.channel)
            yield _Frame(t_ns, channel, message.arbitration_id, message.is_extended_id, bytes(message.data))


class _Text(io.TextIOWrapper):
    """The text of a log, which knows whether reading gets on."""

    lines = 0

    def __next__(self) -> str:  # type: ignore[override]  # typeshed's own TextIOWrapper needs the same
        line = super().__next__()
        self.lines += 1
        return line


def _messages(log: LogInput) -> Iterator[can.Message]:
    """python-can's messages. After a bad line of a text format reading goes on, at the loss of at most one more line;
    a binary format ends there."""
    text = None if log.suffix in BINARY else _Text(log.stream(), encoding="utf-8", errors="replace")
    damage = (*DAMAGE, *_mf4_damage(log)) if log.suffix == ".mf4" else DAMAGE
    try:
        reader = _open(log, text)
    except damage as error:
        raise LogError(f"{log.path}: not a {(TEXT | BINARY)[log.suffix]} log: {error}") from error
    with reader:
        lines = -1  # how many were read when reading last broke off
        while True:
            try:
                yield from reader
            except damage:
                if text is None:
                    log.counts["unreadable tail"] += 1
                    return
                if text.lines <= lines:
                    return  # the end; what broke is the reader, for want of a header
                lines = text.lines
                log.counts["bad lines"] += 1
            else:
                return


def _open(log: LogInput, text: _Text | None) -> can.io.generic.MessageReader:
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
        if not file.read(8).startswith(MF4_MAGIC):  # asked first: asammdf complains on standard error besides raising
            raise ValueError("it does not begin like one")
    return can.MF4Reader(log.path)


def _mf4_damage(log: LogInput) -> Iterator[type[Exception]]:
    """What asammdf and the decompressors behind it raise, besides DAMAGE. Raises LogError where it is not installed."""
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{log.path}: reading .mf4 needs the extra mf4: pip install 'fusiond[mf4]'")
    yield RuntimeError
    for module, name in (("asammdf.blocks.utils", "MdfException"), ("isal.igzip_lib", "IsalError"), ("zstd", "Error")):
        if importlib.util.find_spec(module.partition(".")[0]) is not None:
            yield getattr(importlib.import_module(module), name)
