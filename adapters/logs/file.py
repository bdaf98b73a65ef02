"""One log file: its bytes, unzipped if necessary (.gz, and .zst with the extra `zst`), the progress of reading, and counts
of its content."""

from __future__ import annotations

import gzip
import importlib.util
import io
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from fusiond.errors import UnusableError
from fusiond.units import SECOND

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BLOCK = 1 << 18  # bytes read at a time
ZSTD_PIECE = 512  # bytes unzipped at a time: they become 16 MB at most
MAX_WINDOW = 1 << 27  # bytes of memory that a Zstandard stream may ask for
MAX_LINE = 1 << 16  # characters; a longer line is not text
ZIPPED = {".gz": "gzip", ".zst": "Zstandard"}  # by suffix
STAMP_UNTIL_NS = 4_102_444_800 * SECOND  # 2100; stamps of 2262 and later do not fit into 64 bits


class LogError(UnusableError):
    """A log that cannot be read at all; the message says which and why."""


class LogFile:
    """A log on disk, unzipped if it ends in .gz or .zst. A reader counts damage in `counts`: bad lines, a truncated tail.

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
        """The format's suffix in lower case, without a final .gz or .zst: `.tlog`."""
        suffixes = [suffix.lower() for suffix in self.path.suffixes]
        if self.zipped:
            suffixes.pop()
        return suffixes[-1] if suffixes else ""

    @property
    def zipped(self) -> bool:
        return self.path.suffix.lower() in ZIPPED

    def blocks(self) -> Iterator[bytes]:
        """The content in blocks of bounded size. A damaged zipped stream ends at the damage, which is counted."""
        with ExitStack() as stack:
            try:
                raw = stack.enter_context(self.path.open("rb"))
            except OSError as error:
                raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
            stream, damage = self._opened(raw, stack)
            is_empty = True
            while True:
                try:
                    block = stream.read1(BLOCK)  # `read` would lose the bytes before the damage
                except damage as error:
                    kind = ZIPPED[self.path.suffix.lower()]
                    if is_empty:
                        raise LogError(f"{self.path}: is not a {kind} file: {error}") from error
                    self.counts[f"damaged {kind}"] += 1
                    return
                except OSError as error:
                    raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error
                if not block:
                    return
                is_empty = False
                self.bytes_read = raw.tell()
                yield block

    def _opened(self, raw: BinaryIO, stack: ExitStack) -> tuple[Any, tuple[type[Exception], ...]]:
        """The content as a stream, and the exceptions that damage raises in it."""
        match self.path.suffix.lower():
            case ".gz":
                return stack.enter_context(gzip.GzipFile(fileobj=raw)), (EOFError, zlib.error, gzip.BadGzipFile)
            case ".zst":
                if importlib.util.find_spec("zstandard") is None:
                    raise LogError(f"{self.path}: reading .zst needs the extra zst: pip install 'fusiond[zst]'")
                import zstandard  # noqa: PLC0415 - an extra

                return _Zstandard(raw), (EOFError, zstandard.ZstdError)
        return raw, ()

    @contextmanager
    def unzipped(self) -> Iterator[Path]:
        """A path to the content as it is, for readers that need a file: a temporary one if the log is zipped."""
        if not self.zipped:
            yield self.path
            self.bytes_read = self.bytes_total
            return
        with tempfile.NamedTemporaryFile(suffix=self.suffix) as copy:
            for block in self.blocks():
                copy.write(block)
            copy.flush()
            yield Path(copy.name)

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


class _Zstandard:
    """The content of a Zstandard file, of one frame or several. Raises EOFError where it is cut off, as gzip's reader does,
    and ZstdError where it is damaged."""

    def __init__(self, raw: BinaryIO) -> None:
        import zstandard  # noqa: PLC0415 - an extra, imported only where such a file is read

        self._raw, self._whole = raw, True  # no frame has begun that is not whole
        self._unzip = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        self._frame = self._unzip.decompressobj()

    def read1(self, _size: int) -> bytes:
        """The next bytes; none at the end."""
        block = b""
        while not block:
            packed = self._raw.read(ZSTD_PIECE)
            if not packed:
                if not self._whole:
                    raise EOFError("it is cut off")
                break
            while packed:
                self._whole = False
                block += self._frame.decompress(packed)
                packed = self._frame.unused_data if self._frame.eof else b""
                if self._frame.eof:
                    self._whole, self._frame = True, self._unzip.decompressobj()
        return block


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
