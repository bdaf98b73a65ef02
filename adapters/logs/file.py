"""One log file: its bytes, unzipped if need be, how far reading has come, and counts of what was found."""

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

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BLOCK = 1 << 18  # bytes read at a time


class LogError(UnusableError):
    """A log that cannot be read at all; the message says which and why."""


class LogFile:
    """A log on disk, unzipped where its name ends in .gz. A reader counts damage in `counts`: bad lines, a cut tail.

    Raises LogError where there is no such file, or nothing in it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.counts: Counter[str] = Counter()
        self.warnings: list[str] = []
        self.bytes_read = 0  # of the file as it lies on disk
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
        """The content in blocks of bounded size. A damaged gzip stream ends where the damage begins, and is counted."""
        with ExitStack() as stack:
            try:
                raw = stack.enter_context(self.path.open("rb"))
            except OSError as error:
                raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
            source = stack.enter_context(gzip.GzipFile(fileobj=raw)) if self.zipped else raw
            anything = False
            while True:
                try:
                    block = source.read1(BLOCK)  # read would lose what comes before the damage
                except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                    if not anything:
                        raise LogError(f"{self.path}: is not a gzip file: {error}") from error
                    self.counts["damaged gzip"] += 1
                    return
                except OSError as error:
                    raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
                if not block:
                    return
                anything = True
                self.bytes_read = raw.tell()
                yield block

    def stream(self) -> io.BufferedReader:
        """The same content as a file object, for readers that want one."""
        return io.BufferedReader(_BlockStream(self.blocks()))


class _BlockStream(io.RawIOBase):
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
