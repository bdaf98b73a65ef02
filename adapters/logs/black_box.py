"""The black box: records everything received, in native formats, in a folder of bounded size.

A file is named by the instant of its first frame, then `LINK.tlog`, `can.log`, or `state.json` for the stored state that
the run started with. The caller never waits: a thread writes the frames. If the disk is full or slow, only the black box
loses frames: it counts them, and starts a new file as soon as possible.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from threading import Condition, Thread
from types import TracebackType
from typing import BinaryIO

from fusiond.units import SECOND
from fusiond_adapters.host.bounded_folder import FLUSH_S, MEGABYTE, file_name, make_room, name_pattern

MAX_WAITING = 100_000  # records between the engine and the disk
RETRY_NS = 5 * SECOND  # pause after an error; records of that time are lost
NAME = name_pattern(r"\w+\.(tlog|log|json)")  # nothing else in the folder is ever removed


class Recorder:
    """Writes into a folder, created if missing. A context manager: its end writes the waiting records.

    Raises OSError if the folder cannot be created.
    """

    def __init__(self, folder: Path, file_mb: float, total_mb: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.written = self.lost = 0  # records
        self.error: str | None = None  # the last one, until a write succeeds
        self._folder = folder
        self._file_bytes, self._total_bytes = int(file_mb * MEGABYTE), int(total_mb * MEGABYTE)
        self._files: dict[str, tuple[BinaryIO, int]] = {}  # by kind: the open file, and its size
        self._waiting: deque[tuple[str, int, bytes]] = deque()
        self._changed = Condition()
        self._ending = False
        self._next_try_ns = 0  # records stamped earlier are lost
        self._last_ns = 0  # stamp of the last record given to a file
        self._thread = Thread(target=self._run, name="record")
        self._thread.start()

    def add(self, kind: str, t_ns: int, record: bytes) -> None:
        """Hand over a record of a kind of file (`LINK.tlog`, `can.log`). Never waits."""
        if len(self._waiting) >= MAX_WAITING:
            self.lost += 1
        else:
            self._waiting.append((kind, t_ns, record))

    def close(self) -> None:
        """Write the waiting records, and end."""
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
            except OSError as error:  # buffered records are lost
                self.error = error.strerror or str(error)
        self._files.clear()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
