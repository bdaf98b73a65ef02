"""One log file: its bytes, unzipped if necessary, the progress of reading, and counts of its content."""

from __future__ import annotations

import gzip
import io
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from fusiond.errors import UnusableError
from fusiond.units import SECOND

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BLOCK = 1 << 18  # bytes read at a time
MAX_LINE = 1 << 16  # characters; a longer line is not text
STAMP_UNTIL_NS = 4_102_444_800 * SECOND  # 2100; stamps of 2262 and later do not fit into 64 bits


class LogError(UnusableError):
    """A log that cannot be read at all; the message says which and why."""


class LogFile:
    """A log on disk, unzipped if its name ends in .gz. A reader counts damage in `counts`: bad lines, a truncated tail.

    Raises LogError if there is no such file, or it is empty.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.counts: Counter[str] = Counter()
        self.warnings: list[str] = []
        self.bytes_read = 0  # of the file on disk
        try:
            self.bytes_total = self.path.stat().st_size
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
        if not self.path.is_file():
            raise LogError(f"{self.path}: is not a file")
        if self.bytes_total == 0:
            raise LogError(f"{self.path}: is empty")

    @property
    def suffix(self) -> str:
        """The format's suffix in lower case, without a final .gz: `.tlog`."""
        suffixes = [suffix.lower() for suffix in self.path.suffixes]
        if self.zipped:
            suffixes.pop()
        return suffixes[-1] if suffixes else ""

    @property
    def zipped(self) -> bool:
        return self.path.suffix.lower() == ".gz"

    def blocks(self) -> Iterator[bytes]:
        """The content in blocks of bounded size. A damaged gzip stream ends at the damage, which is counted."""
        with ExitStack() as stack:
            try:
                raw = stack.enter_context(self.path.open("rb"))
            except OSError as error:
                raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
            stream = stack.enter_context(gzip.GzipFile(fileobj=raw)) if self.zipped else raw
            is_empty = True
            while True:
                try:
                    block = stream.read1(BLOCK)  # `read` would lose the bytes before the damage
                except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                    if is_empty:
                        raise LogError(f"{self.path}: is not a gzip file: {error}") from error
                    self.counts["damaged gzip"] += 1
                    return
                except OSError as error:
                    raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
                if not block:
                    return
                is_empty = False
                self.bytes_read = raw.tell()
                yield block

    def stream(self) -> io.BufferedReader:
        """The content as a file object, for readers that need one."""
        return io.BufferedReader(BlockStream(self.blocks()))

    def takes_stamp(self, t_ns: int) -> bool:
        """Whether a stamp can be one: from 1970 to 2099. Others are counted as `bad stamps`, and a warning is given."""
        taken = 0 <= t_ns < STAMP_UNTIL_NS
        if not taken:
            self.counts["bad stamps"] += 1
            warning = f"{self.path}: frames stamped before 1970 or after 2099 are left out"
            if warning not in self.warnings:
                self.warnings.append(warning)
        return taken


class BlockStream(io.RawIOBase):
    """A file object over an iterator of blocks."""

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks = blocks
        self._rest = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer) -> int:
        target = memoryview(buffer).cast("B")
        if not self._rest:
            self._rest = memoryview(next(self._blocks, b""))
        size = min(len(target), len(self._rest))
        target[:size] = self._rest[:size]
        self._rest = self._rest[size:]
        return size
