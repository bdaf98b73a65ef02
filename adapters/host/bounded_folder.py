"""Folders of recordings of bounded size: files are named by the instant of their first record, the oldest removed."""

from __future__ import annotations

import re
from collections.abc import Set
from datetime import UTC, datetime
from pathlib import Path

from fusiond.units import MICROSECOND, SECOND

MEGABYTE = 1_000_000
FLUSH_S = 1.0  # a crash loses at most this much


def file_name(t_ns: int, kind: str) -> str:
    """The name of a file with its first record at an instant; `kind` follows the instant in the name."""
    instant = datetime.fromtimestamp(t_ns // SECOND, UTC)
    return f"{instant:%Y%m%dT%H%M%S}.{t_ns % SECOND // MICROSECOND:06d}Z-{kind}"


def name_pattern(kind: str) -> re.Pattern[str]:
    """Matches the names that `file_name` returns; `kind` is a regular expression."""
    return re.compile(rf"\d{{8}}T\d{{6}}\.\d{{6}}Z-{kind}")


def make_room(
    folder: Path, name: re.Pattern[str], file_bytes: int, total_bytes: int, open_files: Set[Path] = frozenset()
) -> None:
    """Remove the oldest files with matching names until there is room for one more full file. Raises OSError."""
    files = sorted(path for path in folder.iterdir() if name.fullmatch(path.name))
    sizes = {path: file_bytes if path in open_files else path.stat().st_size for path in files}
    total = sum(sizes.values()) + file_bytes
    for path in files:
        if total <= total_bytes:
            return
        if path not in open_files:
            path.unlink()
            total -= sizes[path]
