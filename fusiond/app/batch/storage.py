"""Where drives lie: folders of this machine and object stores, by fsspec. Needs the extra `batch`."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from fusiond.errors import UnusableError, UsageError

try:
    import fsspec
except ModuleNotFoundError as missing:
    raise UsageError("fusiond batch needs the extra batch: pip install 'fusiond[batch]'") from missing

EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gs", "gcs": "gs"}  # of fusiond, by the scheme of an URL


class Found(NamedTuple):
    """A file in a folder."""

    where: str  # path or URL
    name: str
    size: int


def opened(where: str) -> tuple[Any, str]:
    """The file system of a path or URL, and the path in it. Raises UsageError, UnusableError."""
    scheme = where.partition("://")[0] if "://" in where else "file"
    try:
        system, path = fsspec.core.url_to_fs(where)
    except ImportError as error:
        extra = EXTRAS.get(scheme)
        need = f"needs the extra {extra}: pip install 'fusiond[{extra}]'" if extra else f"needs a library: {error}"
        raise UsageError(f"{where}: {need}") from error
    except ValueError as error:
        raise UsageError(f"{where}: {error}") from error
    return system, path


def matching(pattern: str) -> list[str]:
    """The paths or URLs that a glob pattern stands for, sorted; what is no pattern stands for itself. Raises UsageError,
    UnusableError if there is none."""
    system, path = opened(pattern)
    try:
        if any(letter in path for letter in "*?["):
            found = sorted(system.glob(path))
        else:
            found = [path] if system.exists(path) else []
    except OSError as error:
        raise UnusableError(f"{pattern}: {error.strerror or error}") from error
    if not found:
        raise UnusableError(f"{pattern}: nothing there")
    return [_where(system, one, pattern) for one in found]


def is_folder(where: str) -> bool:
    """Whether it is a folder. Raises UsageError."""
    system, path = opened(where)
    return bool(system.isdir(path))


def folders(where: str) -> Iterator[tuple[str, list[Found]]]:
    """Every folder below one and itself, with its files sorted by name. Raises UsageError, UnusableError."""
    system, path = opened(where)

    def fail(error: OSError) -> None:
        raise UnusableError(f"{where}: {error.strerror or error}") from error

    for folder, _, files in system.walk(path, detail=True, on_error=fail):
        inside = [
            Found(_where(system, info["name"], where), name, int(info.get("size") or 0))
            for name, info in sorted(files.items())
            if info.get("type") != "directory"
        ]
        yield _where(system, folder, where), inside


def file(where: str) -> Found:
    """One file. Raises UsageError, UnusableError."""
    system, path = opened(where)
    try:
        info = system.info(path)
    except OSError as error:
        raise UnusableError(f"{where}: {error.strerror or 'nothing there'}") from error
    return Found(where, Path(path).name, int(info.get("size") or 0))


def _where(system: Any, path: str, given: str) -> str:
    """A path of a file system as an user writes it, in the way of what was given: relative paths stay relative."""
    if "://" in given:
        return str(system.unstrip_protocol(path))
    if Path(given).is_absolute():
        return str(path)
    cwd = f"{Path.cwd()}/"
    return str(path).removeprefix(cwd)


def digest(where: str) -> str:
    """What changes with the content: its SHA-256, or of a remote file what the store tells without reading it. Raises
    UnusableError."""
    try:
        if "://" not in where:
            with Path(where).open("rb") as content:
                return hashlib.file_digest(content, "sha256").hexdigest()
        system, path = opened(where)
        return str(system.checksum(path))
    except OSError as error:
        raise UnusableError(f"{where}: cannot be read: {error.strerror or error}") from error


def fetch(where: str, target: Path) -> Path:
    """Copy a remote file. Raises UnusableError, UsageError."""
    system, path = opened(where)
    try:
        system.get_file(path, str(target))
    except OSError as error:
        raise UnusableError(f"{where}: cannot be fetched: {error.strerror or error}") from error
    return target


def read(where: str) -> bytes:
    """The whole of a small file. Raises UnusableError, UsageError."""
    system, path = opened(where)
    try:
        content: bytes = system.cat_file(path)
    except OSError as error:
        raise UnusableError(f"{where}: cannot be read: {error.strerror or error}") from error
    return content
