"""The black box: what was received, in native formats, in files of bounded size, the oldest of which go in time.

A file is named by the instant of its first frame, then `LINK.tlog`, `can.log`, or `state.json` for the stored state that
the run began with, so that names sort by time. Frames are
handed over without waiting; a thread writes them. When the disk is full or slow, frames are lost to the box alone: they
are counted, and the box goes on with a new file as soon as it can.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Set
from datetime import UTC, datetime
from pathlib import Path
from threading import Condition, Thread
from types import TracebackType
from typing import BinaryIO

MEGABYTE = 1_000_000
MOST_WAITING = 100_000  # records between the engine and the disk
FLUSH_S = 1.0  # what is lost at a crash, at the most
RETRY_NS = 5_000_000_000  # after an error records are passed over for so long before the disk is tried again
NAME = re.compile(r"\d{8}T\d{6}\.\d{6}Z-\w+\.(tlog|log|json)")  # nothing else in the folder is ever removed


def file_name(t_ns: int, kind: str) -> str:
    """The name of a file whose first record is of that instant."""
    instant = datetime.fromtimestamp(t_ns // 10**9, UTC)
    return f"{instant:%Y%m%dT%H%M%S}.{t_ns % 10**9 // 1000:06d}Z-{kind}"


def make_room(
    folder: Path, name: re.Pattern[str], file_bytes: int, total_bytes: int, open_files: Set[Path] = frozenset()
) -> None:
    """Remove the oldest of the files so named, as long as one more full one could exceed the limit. Raises OSError."""
    files = sorted(path for path in folder.iterdir() if name.fullmatch(path.name))
    sizes = {path: file_bytes if path in open_files else path.stat().st_size for path in files}
    total = sum(sizes.values()) + file_bytes
    for path in files:
        if total <= total_bytes:
            return
        if path not in open_files:
            path.unlink()
            total -= sizes[path]


class Recorder:
    """Writes into a folder, made if need be. A context manager: its end writes what is waiting.

    Raises OSError where the folder cannot be made.
    """

    def __init__(self, folder: Path, file_mb: float, total_mb: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.written = self.lost = 0  # records
        self.error: str | None = None  # the last one, while it lasts
        self._folder = folder
        self._file_bytes, self._total_bytes = int(file_mb * MEGABYTE), int(total_mb * MEGABYTE)
        self._files: dict[str, tuple[BinaryIO, int]] = {}  # by kind: the open file, and its size
        self._waiting: deque[tuple[str, int, bytes]] = deque()
        self._changed = Condition()
        self._ending = False
        self._next_try_ns = 0  # records stamped earlier are passed over
        self._last_ns = 0  # stamp of the last record given to a file
        self._thread = Thread(target=self._run, name="record")
        self._thread.start()

    def add(self, kind: str, t_ns: int, record: bytes) -> None:
        """Hand over a record of a kind of file (`LINK.tlog`, `can.log`). Never waits."""
        if len(self._waiting) >= MOST_WAITING:
            self.lost += 1
        else:
            self._waiting.append((kind, t_ns, record))

    def close(self) -> None:
        """Write what is waiting, and end."""
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                ending = self._ending or self._changed.wait_for(lambda: self._ending, FLUSH_S)
            while self._waiting:
                self._write(*self._waiting.popleft())
            try:
                for file, _ in self._files.values():
                    file.flush()
            except OSError as error:
                self._fail(error, self._last_ns)
            if ending:
                self._close_files()
                return

    def _write(self, kind: str, t_ns: int, record: bytes) -> None:
        if t_ns < self._next_try_ns:
            self.lost += 1
            return
        try:
            file, size = self._files.get(kind) or (None, 0)
            if file is not None and size + len(record) > self._file_bytes:
                del self._files[kind]
                file.close()
                file = None
            if file is None:
                file, size = self._open(kind, t_ns), 0
            self._files[kind] = file, size + len(record)
            self._last_ns = t_ns
            file.write(record)
        except OSError as error:
            self.lost += 1
            self._fail(error, t_ns)
        else:
            self.written += 1
            self.error = None

    def _open(self, kind: str, t_ns: int) -> BinaryIO:
        open_files = {Path(file.name) for file, _ in self._files.values()}
        make_room(self._folder, NAME, self._file_bytes, self._total_bytes, open_files)
        return (self._folder / file_name(t_ns, kind)).open("wb", buffering=1 << 16)

    def _fail(self, error: OSError, t_ns: int) -> None:
        self.error = error.strerror or str(error)
        self._next_try_ns = t_ns + RETRY_NS
        self._close_files()

    def _close_files(self) -> None:
        for file, _ in self._files.values():
            try:
                file.close()
            except OSError as error:  # what was buffered is lost
                self.error = error.strerror or str(error)
        self._files.clear()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
