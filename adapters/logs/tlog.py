"""Reader of .tlog: MAVLink frames, each after the Unix time of its receipt (microseconds, 8 bytes, big endian).

The file may be damaged anywhere. While one record follows another, only the magic bytes are checked, and unwanted frames
are skipped by their headers. If the next record is missing, it is searched byte by byte, and checksums decide. A
stamp that jumps is compared with its neighbours: a single outlier is dropped with its record, a clock that was set is
followed.

Counts: `records`, `bad bytes` (skipped between records), `truncated tail` (the last record is cut off), `bad stamps`
(records dropped for their stamp), `clock set back`.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from struct import Struct
from typing import TYPE_CHECKING, Protocol

import pymavlink.dialects.v20.ardupilotmega as dialect

from fusiond.events import Received
from fusiond.units import MICROSECOND
from fusiond_adapters.logs.file import STAMP_UNTIL_NS, LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading
from fusiond_adapters.mavlink.decoder import (
    CHECKSUM,
    HEADER_2,
    HEARTBEAT,
    LENGTH_KNOWN,
    MAGIC,
    MAGIC_1,
    MAGIC_2,
    MAX_FRAME_BYTES,
    SIGNATURE,
    SIGNED,
    Dialect,
    MavlinkDecoder,
    frame_length,
    message_id,
)
from fusiond_adapters.mavlink.tlog_record import STAMP, STAMP_SIZE

if TYPE_CHECKING:
    from fusiond_adapters.logs.survey import Survey

RECORD_2 = Struct(">Q10B")  # stamp, and the header of a MAVLink 2 frame
OVERHEAD = STAMP_SIZE + HEADER_2 + CHECKSUM  # bytes of a MAVLink 2 record without its payload
OVERHEAD_SIGNED = OVERHEAD + SIGNATURE
MAGICS = (MAGIC_1, MAGIC_2)
RESYNC_REACH_US = 366 * 86_400 * 10**6  # a record found after garbage is stamped within a year of the one before
STEP_US = 10**6  # a stamp that jumps by more is compared with the next one
REACH = 2 * (STAMP_SIZE + MAX_FRAME_BYTES)  # bytes in which a whole record and the next one's beginning lie


def open_log(opening: Opening) -> Reading:
    """The reading of a .tlog, by default of the first link. Raises LogError if no link is configured, or not that one;
    ConfigError if the dialect lacks a wanted message."""
    path, links = opening.file.path, opening.config.mavlink
    if not links:
        raise LogError(f"{path}: the configuration has no [mavlink.NAME] for it")
    link = next(iter(links)) if opening.name is None else opening.name
    if link not in links:
        raise LogError(f"{link}={path}: a .tlog is a MAVLink log; configured links: {', '.join(links)}")
    decoder = MavlinkDecoder(opening.config, link, opening.sequences)
    return Reading("mavlink", [decoder], read_tlog(opening.file, decoder))


class FrameDecoder(Protocol):
    """What makes events of frames: MavlinkDecoder, or what stands in for it."""

    dialect: Dialect

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        """The events in one frame."""

    def decode_by_header(
        self, number: int, counter: int, system: int, component: int, frame: bytes, t_receive_ns: int, /
    ) -> list[Received]:
        """The same for a frame whose header has been read."""


def read_tlog(log: LogFile, decoder: FrameDecoder) -> Iterator[list[Received]]:
    """The events of a .tlog, frame by frame in the order of the file. Raises LogError if it has no MAVLink frame."""
    yield from _Records(log, decoder)
    if not log.counts["records"]:
        raise LogError(f"{log.path}: no MAVLink frame in it; is it a .tlog?")


def survey(found: Survey) -> None:
    """Add what is in a .tlog to a survey: a stream for each message of each component. Raises LogError."""
    found.protocol = "mavlink"
    for _ in read_tlog(found.file, _Surveyor(found)):
        pass


class _Surveyor:
    """In place of a decoder: adds frames to a survey."""

    def __init__(self, found: Survey) -> None:
        self.dialect = Dialect("ardupilotmega")
        self._found = found
        self._names = {number: name for name, number in self.dialect.ids.items()}

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        at = 5 if frame[0] == MAGIC_2 else 3
        return self.decode_by_header(message_id(frame), 0, frame[at], frame[at + 1], frame, t_receive_ns)

    def decode_by_header(
        self, number: int, _counter: int, system: int, component: int, frame: bytes, t_receive_ns: int
    ) -> list[Received]:
        if self.dialect.sound(frame) is False:
            self._found.file.counts["bad checksum"] += 1
            return []
        sender, name = f"system {system}, component {component}", self._names.get(number, f"message {number}")
        self._found.add(sender, name, t_receive_ns)
        if name == HEARTBEAT and sender not in self._found.senders:
            self._found.senders[sender] = _described(frame)
        return []


def _described(heartbeat: bytes) -> str:
    """The kinds of autopilot and of vehicle in a HEARTBEAT."""
    message = dialect.MAVLink(None).decode(bytearray(heartbeat))
    kinds = (("MAV_AUTOPILOT", message.autopilot), ("MAV_TYPE", message.type))
    names = [dialect.enums[enum][value].name if value in dialect.enums[enum] else f"{enum}_{value}" for enum, value in kinds]
    return ", ".join(name.removeprefix("MAV_AUTOPILOT_").removeprefix("MAV_TYPE_") for name in names)


class _Records:
    """Cuts a .tlog into records and decodes them."""

    def __init__(self, log: LogFile, decoder: FrameDecoder) -> None:
        self._log = log
        self._blocks = log.blocks()
        self._counts = log.counts
        self._decoder, self._dialect = decoder, decoder.dialect
        self._buffer = b""
        self._ended = False
        self._last_us: int | None = None  # stamp of the last record used
        self._in_step = False  # the last record ended at the present position

    def __iter__(self) -> Iterator[list[Received]]:
        at = 0
        skipped = 0  # bytes since the last record
        cut = False  # the skipped bytes start like a record that is cut off by the end of the file
        counts = self._counts
        while True:
            if len(self._buffer) - at < REACH and not self._ended:
                at = self._refill(at)
            if at >= len(self._buffer):
                break
            if self._in_step:
                begin, at = at, (yield from self._plain(at))
                if at != begin:
                    continue
            size = self._record_size(at)
            if not size:
                cut = cut or (self._in_step and self._is_cut(at))
                self._in_step = False
                start = self._next_candidate(at)
                skipped += start - at
                at = start
                continue
            if skipped:
                counts["bad bytes"] += skipped
                skipped = 0
            cut, self._in_step = False, True
            counts["records"] += 1
            stamp_us: int = STAMP.unpack_from(self._buffer, at)[0]
            if self._stamp_is_good(stamp_us, at + size):
                yield self._decoder.decode(self._buffer[at + STAMP_SIZE : at + size], stamp_us * MICROSECOND)
            at += size
        if cut:
            counts["truncated tail"] += 1
        else:
            counts["bad bytes"] += skipped

    def _plain(self, at: int) -> Generator[list[Received], None, int]:
        """Cut the ordinary MAVLink 2 records from `at` on. Returns the end of the buffer, or the position of a record that
        needs more checks."""
        buffer, unpack, decode = self._buffer, RECORD_2.unpack_from, self._decoder.decode_by_header
        until, records, last_us = len(buffer) - REACH, 0, self._last_us
        while at <= until and last_us is not None:
            stamp_us, magic, size, flags, _, counter, system, component, low, middle, high = unpack(buffer, at)
            end = at + size + (OVERHEAD_SIGNED if flags else OVERHEAD)
            if magic != MAGIC_2 or flags > SIGNED or buffer[end + STAMP_SIZE] not in MAGICS:
                break
            if not -STEP_US <= stamp_us - last_us <= STEP_US:
                break
            last_us = stamp_us
            records += 1
            number, frame = low | middle << 8 | high << 16, buffer[at + STAMP_SIZE : end]
            events = decode(number, counter, system, component, frame, stamp_us * MICROSECOND)
            at = end
            if events:
                yield events
        self._last_us = last_us
        self._counts["records"] += records
        return at

    def _refill(self, at: int) -> int:
        """Read until the buffer has a record and the start of the next one, or the file ends. Returns the new `at`."""
        parts = [self._buffer[at:]]
        size = len(parts[0])
        while size < REACH and not self._ended:
            block = next(self._blocks, b"")
            self._ended = not block
            parts.append(block)
            size += len(block)
        self._buffer = b"".join(parts)
        return 0

    def _record_size(self, at: int) -> int:
        """Bytes of the record that begins at `at`; 0 if none does."""
        buffer, size = self._buffer, len(self._buffer)
        start = at + STAMP_SIZE
        if size < start + LENGTH_KNOWN:
            return 0
        length = frame_length(buffer, start)
        end = start + length
        if not length or end > size:
            return 0
        next_magic = end + STAMP_SIZE
        goes_on = buffer[next_magic] in MAGICS if next_magic < size else end == size
        if self._in_step and goes_on:
            return end - at
        sound = self._dialect.sound(buffer[start:end])
        if sound is None:
            sound = goes_on
        return end - at if sound and (self._in_step or self._may_resume(at)) else 0

    def _may_resume(self, at: int) -> bool:
        stamp_us: int = STAMP.unpack_from(self._buffer, at)[0]
        if self._last_us is None:
            return stamp_us * MICROSECOND < STAMP_UNTIL_NS
        return abs(stamp_us - self._last_us) < RESYNC_REACH_US

    def _is_cut(self, at: int) -> bool:
        """Whether the file ends inside the record at `at`."""
        start = at + STAMP_SIZE
        if not self._ended or len(self._buffer) < start + LENGTH_KNOWN:
            return self._ended
        length = frame_length(self._buffer, start)
        return length > 0 and start + length > len(self._buffer)

    def _next_candidate(self, at: int) -> int:
        """The next position after `at` where a record may begin."""
        found = MAGIC.search(self._buffer, at + STAMP_SIZE + 1)
        if found:
            return found.start() - STAMP_SIZE
        return len(self._buffer) if self._ended else max(at + 1, len(self._buffer) - STAMP_SIZE)

    def _stamp_is_good(self, stamp_us: int, following: int) -> bool:
        """Compare a stamp with the last one and, where it jumps, with that of the record at `following`."""
        last_us = self._last_us
        if not self._log.takes_stamp(stamp_us * MICROSECOND):
            return False
        if last_us is not None and not -STEP_US <= stamp_us - last_us <= STEP_US:
            next_us = self._stamp_at(following)
            alone = next_us is not None and abs(next_us - stamp_us) > abs(next_us - last_us)
            far = abs(stamp_us - last_us) > RESYNC_REACH_US
            if alone or (next_us is None and far):
                self._counts["bad stamps"] += 1
                return False
            if stamp_us < last_us:
                self._counts["clock set back"] += 1
        self._last_us = stamp_us
        return True

    def _stamp_at(self, at: int) -> int | None:
        """The stamp of the record at `at`, if there is one."""
        magic = at + STAMP_SIZE
        if magic >= len(self._buffer) or self._buffer[magic] not in MAGICS:
            return None
        stamp_us: int = STAMP.unpack_from(self._buffer, at)[0]
        return stamp_us
