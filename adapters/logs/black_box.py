"""The black box: records everything received, in native formats, in a folder of bounded size.

A file is named by the number of the recording, the instant of its first frame, and `LINK.tlog`, `can.log`; `config.json` and
`BUS_N.dbc` for the configuration that was used, or `state.json` for the stored state that the run started with. These stay
for as long as there is a frame of the recording. The caller never waits: a thread writes the frames, and each second syncs
them to the disk. Only then do they count as written. If the disk is full or slow, only the black box loses frames: it counts
them, and starts a new file as soon as possible.
"""

from __future__ import annotations

import os
from collections import deque
from contextlib import suppress
from pathlib import Path
from threading import Condition, Thread
from types import TracebackType

from fusiond.units import SECOND
from fusiond_adapters.host.bounded_folder import FLUSH_S, MEGABYTE, BoundedFolder, sync_folder

MAX_WAITING = 100_000  # records between the engine and the disk
GATHERED = 1 << 16  # bytes that are written at once
RETRY_NS = 5 * SECOND  # pause after an error; records of that time are lost
KIND, KEPT = r"\w+\.(?:tlog|log|json|dbc)", r"\w+\.(?:json|dbc)"


class Recorder:
    """Writes into a folder, created if missing. A context manager: its end writes the waiting records.

    Raises OSError if the folder cannot be created.
    """

    def __init__(self, folder: Path, file_mb: float, total_mb: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.written = 0  # records on the disk
        self.error: str | None = None  # the last one, until a write succeeds
        self._overflowed = self._lost = 0  # records: counted by the caller's thread, and by its own
        self._file_bytes = int(file_mb * MEGABYTE)
        self._folder = BoundedFolder(folder, KIND, self._file_bytes, int(total_mb * MEGABYTE), KEPT)
        self._files: dict[str, _File] = {}  # open ones, by kind
        self._waiting: deque[tuple[str, int, bytes]] = deque()
        self._changed = Condition()
        self._ending = False
        self._next_try_ns = 0  # records stamped earlier are lost
        self._last_ns = 0  # stamp of the last record that was to be written
        self._thread = Thread(target=self._run, name="record")
        self._thread.start()

    @property
    def lost(self) -> int:
        """Records that are not on the disk, and will not be."""
        return self._overflowed + self._lost

    @property
    def removed(self) -> int:
        """Files of this recording that made room for later ones: it alone is larger than the limit."""
        return self._folder.removed

    def counts(self) -> tuple[int, int, int]:
        """Records written, records lost, and own files removed."""
        return self.written, self.lost, self.removed

    def add(self, kind: str, t_ns: int, record: bytes) -> None:
        """Hand over a record of a kind of file (`LINK.tlog`, `can.log`). Never waits."""
        if len(self._waiting) >= MAX_WAITING:
            self._overflowed += 1
        else:
            self._waiting.append((kind, t_ns, record))

    def end(self) -> None:
        """Nothing will be added: its thread writes the waiting records, and ends. Does not wait for it."""
        with self._changed:
            self._ending = True
            self._changed.notify()

    def close(self) -> None:
        """Write the waiting records, and end."""
        self.end()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                ending = self._ending or self._changed.wait_for(lambda: self._ending, FLUSH_S)
            while self._waiting:
                self._write(*self._waiting.popleft())
            self._sync()
            if ending:
                self._close_files()
                return

    def _write(self, kind: str, t_ns: int, record: bytes) -> None:
        if t_ns < self._next_try_ns:
            self._lost += 1
            return
        self._last_ns = t_ns
        try:
            file = self._file_with_room(kind, len(record), t_ns)
        except OSError as error:
            self._lost += 1
            self._fail(error)
        else:
            file.add(record)

    def _file_with_room(self, kind: str, size: int, t_ns: int) -> _File:
        file = self._files.get(kind)
        if file is not None and file.size + size > self._file_bytes:
            self._close(self._files.pop(kind))
            file = None
        if file is None:
            open_files = {other.path for other in self._files.values()}
            file = self._files[kind] = _File(self._folder.new_file(t_ns, kind, open_files))
        elif file.gathered >= GATHERED:
            file.write()
        return file

    def _sync(self) -> None:
        try:
            for file in self._files.values():
                self.written += file.sync()
                self.error = None
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self._next_try_ns = self._last_ns + RETRY_NS
        self._close_files()
        self.error = error.strerror or str(error)

    def _close_files(self) -> None:
        for file in self._files.values():
            self._close(file)
        self._files.clear()

    def _close(self, file: _File) -> None:
        """Close a file; its records are now on the disk, or lost."""
        try:
            self.written += file.sync()
        except OSError as error:
            self.error = error.strerror or str(error)
        self.written += file.close()
        self._lost += file.unsynced

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _File:
    """A new file of whole records. Raises OSError, also in `write` and `sync`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0  # with the records that are not written yet [bytes]
        self._lengths: list[int] = []  # of the records that a power failure would take
        self._written_size = self._synced_size = 0
        self._gathered = bytearray()
        self._can_sync = True  # after an error the kernel forgets what it could not write
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)

    @property
    def unsynced(self) -> int:
        """Number of records that are not on the disk."""
        return len(self._lengths)

    @property
    def gathered(self) -> int:
        """Bytes that are not written yet."""
        return len(self._gathered)

    def add(self, record: bytes) -> None:
        """Gather a record."""
        self._gathered += record
        self.size += len(record)
        self._lengths.append(len(record))

    def write(self) -> None:
        """Write what was gathered, without syncing it."""
        while self._gathered:
            size = os.write(self._file, self._gathered)
            del self._gathered[:size]
            self._written_size += size

    def sync(self) -> int:
        """Write, and sync to the disk. Returns the number of records that have come onto the disk by this."""
        if not self._lengths:
            return 0
        self.write()
        return self._sync(len(self._lengths), self.size)

    def _sync(self, records: int, size: int) -> int:
        try:
            os.fdatasync(self._file)
            if not self._synced_size:
                sync_folder(self.path.parent)  # so that the name survives a power failure
        except OSError:
            self._can_sync = False
            raise
        self._synced_size = size
        del self._lengths[:records]
        return records

    def close(self) -> int:
        """Close it, after an error with the whole records that fit on the disk; without any the file is removed. Returns the
        number of records that have come onto the disk by this."""
        kept = 0
        with suppress(OSError):  # what is not synced then is lost
            kept = self._keep_what_fits()
        with suppress(OSError):
            os.close(self._file)
        if not self._synced_size:
            with suppress(OSError):
                self.path.unlink()
        return kept

    def _keep_what_fits(self) -> int:
        records, size = 0, self._synced_size
        if self._can_sync:
            for length in self._lengths:
                if size + length > self._written_size:
                    break
                records, size = records + 1, size + length
        os.ftruncate(self._file, size)
        return self._sync(records, size) if records else 0
