"""Folders of recordings of bounded size: the files of the oldest recording are removed first, whatever the clock says.

A file is named NUMBER-INSTANT-KIND: the number of the recording, which counts up in the folder, and the instant of the first
record. A clock may stand in 1971 or run ahead; the number still says what is older.
"""

from __future__ import annotations

import os
import re
from collections.abc import Set
from datetime import UTC, datetime
from pathlib import Path

from fusiond.units import MICROSECOND, SECOND

MEGABYTE = 1_000_000
FLUSH_S = 1.0  # a crash loses at most this much


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power failure. Raises OSError."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


class BoundedFolder:
    """One recording in a folder. `kind` is a regular expression of the kinds of files; no other file is ever removed. Those
    of the kind `kept` are removed last of a recording."""

    def __init__(self, folder: Path, kind: str, file_bytes: int, total_bytes: int, kept: str = "") -> None:
        self.path = folder
        self.removed = 0  # files of this recording, for lack of any that are older
        self._name = re.compile(rf"(?:(\d{{4,}})-)?(\d{{8}}T\d{{6}}\.\d{{6}})Z-({kind})")
        self._kept = re.compile(kept)
        self._file_bytes, self._total_bytes = file_bytes, total_bytes
        self._number: int | None = None  # of this recording, from its first file on

    def new_file(self, t_ns: int, kind: str, open_files: Set[Path] = frozenset()) -> Path:
        """The path of a new file with its first record at an instant, after making room for one more full file. The files of
        a recording must be requested in the order of their instants. Raises OSError."""
        files = self._files()
        if self._number is None:
            self._number = max((number for number, *_ in files), default=0) + 1
        self._make_room(files, open_files)
        instant = datetime.fromtimestamp(t_ns // SECOND, UTC)
        stamp = f"{instant:%Y%m%dT%H%M%S}.{t_ns % SECOND // MICROSECOND:06d}"
        return self.path / f"{self._number:04d}-{stamp}Z-{kind}"

    def _files(self) -> list[tuple[int, bool, str, Path]]:
        """Number of the recording, whether it is removed last, instant and path of each file, in the order of removal."""
        found = [(self._name.fullmatch(path.name), path) for path in self.path.iterdir()]
        return sorted(
            (int(name[1] or 0), bool(self._kept.fullmatch(name[3])), name[2], path) for name, path in found if name
        )

    def _make_room(self, files: list[tuple[int, bool, str, Path]], open_files: Set[Path]) -> None:
        sizes = {path: self._file_bytes if path in open_files else path.stat().st_size for *_, path in files}
        total = sum(sizes.values()) + self._file_bytes
        for number, *_, path in files:
            if total <= self._total_bytes:
                return
            if path not in open_files:
                path.unlink()
                total -= sizes[path]
                self.removed += number == self._number
