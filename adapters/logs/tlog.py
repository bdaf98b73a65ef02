"""Reader of .tlog: MAVLink frames, each after the microseconds of Unix time of its receipt (8 bytes, big endian).

The file may be damaged anywhere. While the records follow one another the magic bytes alone are looked at; where the
next one is missing, checksums decide, and the search for the next record goes on byte by byte. Stamps that jump are
compared with their neighbours: a lone outlier is dropped with its record, a clock that was set is followed.

Counts: `records`, `bad bytes` (skipped between records), `truncated tail` (the last record is cut off), `bad stamps`
(records dropped for their stamp), `clock set back`.
"""

from __future__ import annotations

from collections.abc import Iterator
from struct import Struct

from fusiond.measurements import Received

from ..mavlink import LENGTH_KNOWN, LONGEST_FRAME, MAGIC, MAGIC_1, MAGIC_2, Dialect, MavlinkDecoder, frame_length
from . import LogError, LogInput

STAMP = Struct(">Q")  # microseconds of Unix time
STAMP_SIZE = STAMP.size
MAGICS = (MAGIC_1, MAGIC_2)
STAMP_UNTIL_US = 4_102_444_800 * 10**6  # 2100
RESYNC_REACH_US = 366 * 86_400 * 10**6  # a record found after garbage is stamped within a year of the one before
STEP_US = 10**6  # a stamp that jumps by more is compared with the next one
REACH = 2 * (STAMP_SIZE + LONGEST_FRAME)  # bytes in which a whole record and the next one's beginning lie


def read_tlog(log: LogInput, decoder: MavlinkDecoder) -> Iterator[list[Received]]:
    """The events of a .tlog, frame by frame in the order of the file. Raises LogError where there is no MAVLink in it."""
    decode = decoder.decode
    for stamp_us, frame in _Records(log, decoder.dialect):
        yield decode(frame, stamp_us * 1000)
    if not log.counts["records"]:
        raise LogError(f"{log.path}: no MAVLink frame in it; is it a .tlog?")


class _Records:
    """Cuts a .tlog into (stamp [us], frame)."""

    def __init__(self, log: LogInput, dialect: Dialect) -> None:
        self._blocks = log.blocks()
        self._counts = log.counts
        self._dialect = dialect
        self._buffer = b""
        self._ended = False
        self._last_us: int | None = None  # stamp of the last record taken
        self._in_step = False  # the last record ended where reading goes on

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        at = 0
        skipped = 0  # bytes since the last record
        cut = False  # the bytes skipped began like a record that the file's end cuts off
        counts = self._counts
        while True:
            if len(self._buffer) - at < REACH and not self._ended:
                at = self._refill(at)
            if at >= len(self._buffer):
                break
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
                yield stamp_us, self._buffer[at + STAMP_SIZE : at + size]
            at += size
        if cut:
            counts["truncated tail"] += 1
        else:
            counts["bad bytes"] += skipped

    def _refill(self, at: int) -> int:
        """Read on until a record and the next one's beginning are there, or the file ends. The new place of `at`."""
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
        """Bytes of the record that begins at `at`; 0 where none does."""
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
            return stamp_us < STAMP_UNTIL_US
        return abs(stamp_us - self._last_us) < RESYNC_REACH_US

    def _is_cut(self, at: int) -> bool:
        """Does the file end inside the record at `at`?"""
        start = at + STAMP_SIZE
        if not self._ended or len(self._buffer) < start + LENGTH_KNOWN:
            return self._ended
        length = frame_length(self._buffer, start)
        return length > 0 and start + length > len(self._buffer)

    def _next_candidate(self, at: int) -> int:
        """Where the next record may begin, after `at`."""
        found = MAGIC.search(self._buffer, at + STAMP_SIZE + 1)
        if found:
            return found.start() - STAMP_SIZE
        return len(self._buffer) if self._ended else max(at + 1, len(self._buffer) - STAMP_SIZE)

    def _stamp_is_good(self, stamp_us: int, following: int) -> bool:
        """Compare a stamp with the last one and, where it jumps, with that of the record at `following`."""
        last_us = self._last_us
        if last_us is not None and not -STEP_US <= stamp_us - last_us <= STEP_US:
            next_us = self._stamp_at(following)
            alone = next_us is not None and abs(next_us - stamp_us) > abs(next_us - last_us)
            far = abs(stamp_us - last_us) > RESYNC_REACH_US
            if alone or (next_us is None and far):
                self._counts["bad stamps"] += 1
                return False
            if stamp_us < last_us:
                self._counts["clock set back"] += 1
        elif last_us is None and stamp_us >= STAMP_UNTIL_US:
            self._counts["bad stamps"] += 1
            return False
        self._last_us = stamp_us
        return True

    def _stamp_at(self, at: int) -> int | None:
        """The stamp of the record at `at`, if there is one."""
        magic = at + STAMP_SIZE
        if magic >= len(self._buffer) or self._buffer[magic] not in MAGICS:
            return None
        stamp_us: int = STAMP.unpack_from(self._buffer, at)[0]
        return stamp_us
