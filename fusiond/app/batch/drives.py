"""Finding drives: in folders as they lie, by patterns, in object stores, or listed in a manifest.

A folder with logs is a drive, or several: a black box numbers its recordings, and logs of the same format are of different
drives and told apart by their names without the suffix. What lies beside the logs belongs to them: a reference track, the
configuration that was used, the stored state that a recording started with.
"""

from __future__ import annotations

import csv
import io
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath
from typing import Any

from fusiond.app.batch import storage
from fusiond.app.batch.job import Drive, DriveFile
from fusiond.app.batch.storage import Found
from fusiond.errors import UnusableError, UsageError
from fusiond_adapters.registry import LOG_FORMATS

NOT_LOGS = {".csv", ".json", ".toml"}  # a .csv beside logs is a track; name a log of python-can in a manifest
LOGS = frozenset(kind.suffix for kind in LOG_FORMATS) - NOT_LOGS
PACKED = (".gz", ".zst")
RECORDED = re.compile(r"(\d{4,})-\d{8}T\d{6}\.\d{6}Z-(\w+\.(?:tlog|log|json|dbc))")  # see `BoundedFolder`
MANIFESTS = {".csv", ".parquet"}
TRUTHS = ("truth.csv", "truth.csv.gz")
CONFIGS = ("fusiond.toml", "config.toml")
COLUMNS = {"logs", "drive", "truth", "config", "stored"}  # of a manifest


def find(arguments: Sequence[str]) -> Iterator[Drive]:
    """The drives of the command line. Raises UsageError, UnusableError."""
    for argument in arguments:
        before = 0
        for drive in _of(argument):
            before += 1
            yield drive
        if not before:
            raise UnusableError(f"{argument}: no logs there; known: {', '.join(sorted(LOGS))}")


def _of(argument: str) -> Iterator[Drive]:
    if _suffix(argument) in MANIFESTS:
        yield from _listed(argument)
        return
    files: dict[str, list[Found]] = defaultdict(list)  # by folder
    for where in storage.matching(argument):
        if storage.is_folder(where):
            for folder, found in storage.folders(where):
                yield from in_folder(folder, found)
        else:
            files[where.rpartition("/")[0]].append(storage.file(where))
    for folder, found in sorted(files.items()):
        yield from in_folder(folder, found)


def _suffix(name: str) -> str:
    """The suffix of the format, in lower case: that before .gz."""
    suffixes = [suffix.lower() for suffix in PurePosixPath(name).suffixes]
    while suffixes and suffixes[-1] in PACKED:
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _stem(name: str) -> str:
    """A name without the suffixes of its format."""
    for packed in PACKED:
        name = name.removesuffix(packed)
    return name.removesuffix(PurePosixPath(name).suffix)


# --- Folders


def in_folder(folder: str, files: Sequence[Found]) -> Iterator[Drive]:
    """The drives of one folder."""
    recorded = [(match, one) for one in files if (match := RECORDED.fullmatch(one.name))]
    yield from _recordings(folder, recorded)
    others = [one for one in files if not RECORDED.fullmatch(one.name)]
    logs = [one for one in others if _suffix(one.name) in LOGS]
    if not logs:
        return
    formats = [_suffix(one.name) for one in logs]
    if len(set(formats)) == len(formats):
        yield _drive(folder, logs, others, "")
        return
    by_stem: dict[str, list[Found]] = defaultdict(list)
    for one in logs:
        by_stem[_stem(one.name)].append(one)
    for stem, some in sorted(by_stem.items()):
        yield _drive(f"{folder}/{stem}".lstrip("/"), some, others, f"{stem}.")


def _drive(name: str, logs: Sequence[Found], others: Sequence[Found], prefix: str) -> Drive:
    """A drive of some logs; `prefix` begins the names of what belongs to it alone."""
    config = _first(others, [f"{prefix}toml", *CONFIGS] if prefix else CONFIGS) or _only(others, ".toml")
    remote = "://" in name
    return Drive(
        name=name or ".",
        logs=[_file(one) for one in logs],
        truth=_first(others, [f"{prefix}{one}" for one in TRUTHS]),
        config=config,
        beside=[_file(one) for one in others if _suffix(one.name) == ".dbc"] if remote else [],
        size=sum(one.size for one in logs),
    )


def _recordings(folder: str, recorded: Sequence[tuple[re.Match[str], Found]]) -> Iterator[Drive]:
    """The recordings of a black box, see `fusiond_adapters.logs.black_box`: config.json is the configuration that was used,
    state.json the stored state, a DBC file is under the name that the configuration gives it."""
    by_number: dict[str, list[tuple[str, Found]]] = defaultdict(list)
    for match, one in recorded:
        by_number[match[1]].append((match[2], one))
    for number, files in sorted(by_number.items()):
        logs = [
            DriveFile(where=one.where, name=one.name, link=_stem(kind) if kind.endswith(".tlog") else "")
            for kind, one in files
            if _suffix(kind) in LOGS
        ]
        beside = {kind: DriveFile(where=one.where, name=kind) for kind, one in files}
        if logs:
            yield Drive(
                name=f"{folder}/{number}",
                logs=logs,
                config=beside.get("config.json"),
                stored=beside.get("state.json"),
                beside=[file for kind, file in beside.items() if kind.endswith(".dbc")],
                size=sum(one.size for kind, one in files if _suffix(kind) in LOGS),
            )


def _file(found: Found) -> DriveFile:
    return DriveFile(where=found.where, name=found.name)


def _first(files: Sequence[Found], names: Sequence[str]) -> DriveFile | None:
    by_name = {one.name: one for one in files}
    return next((_file(by_name[name]) for name in names if name in by_name), None)


def _only(files: Sequence[Found], suffix: str) -> DriveFile | None:
    found = [one for one in files if _suffix(one.name) == suffix]
    return _file(found[0]) if len(found) == 1 else None


# --- Manifests


def _listed(manifest: str) -> Iterator[Drive]:
    """The drives of a manifest: a table with the column `logs` (paths relative to it, joined by semicolons, or a list), and
    if wanted `drive` (a name), `truth`, `config` and `stored`."""
    for number, row in enumerate(_rows(manifest), 1):
        if None in row or not set(row) >= {"logs"} or not set(row) <= COLUMNS:
            columns, allowed = (", ".join(map(str, names)) for names in (row, sorted(COLUMNS)))
            raise UsageError(f"{manifest}: its columns are {columns}; `logs` is needed, allowed are {allowed}")
        given = row["logs"]
        names = [one.strip() for one in given.split(";")] if isinstance(given, str) else list(given or [])
        if not any(names):
            raise UsageError(f"{manifest}, row {number}: no logs")
        logs = [_named(_beside(manifest, name)) for name in names]
        config = _given(manifest, row, "config")
        yield Drive(
            name=str(row.get("drive") or _stem(_beside(manifest, names[0]))),
            logs=[_file(one) for one in logs],
            truth=_given(manifest, row, "truth"),
            stored=_given(manifest, row, "stored"),
            config=config,
            beside=_tables_beside(config) if config and config.is_remote else [],
            size=sum(one.size for one in logs),
        )


def _given(manifest: str, row: dict[str, Any], column: str) -> DriveFile | None:
    name = row.get(column)
    return _file(_named(_beside(manifest, str(name)))) if name else None


def _named(where: str) -> Found:
    """A file that a manifest names. That it is missing is told in the row of its drive."""
    try:
        return storage.file(where)
    except UnusableError:
        return Found(where, PurePosixPath(where).name, 0)


def _tables_beside(config: DriveFile) -> list[DriveFile]:
    """The DBC files in the folder of a remote configuration."""
    for _, files in storage.folders(config.where.rpartition("/")[0]):
        return [_file(one) for one in files if _suffix(one.name) == ".dbc"]
    return []


def _beside(manifest: str, name: str) -> str:
    """A file that a manifest names."""
    folder = manifest.rpartition("/")[0]
    return name if "://" in name or name.startswith("/") or not folder else f"{folder}/{name}"


def _rows(manifest: str) -> Iterator[dict[str, Any]]:
    content = storage.read(storage.matching(manifest)[0])
    if manifest.lower().endswith(".parquet"):
        import pyarrow as pa  # noqa: PLC0415 - needs the extra `batch`
        from pyarrow import parquet  # noqa: PLC0415

        try:
            with parquet.ParquetFile(io.BytesIO(content)) as file:
                for some in file.iter_batches(1000):
                    yield from some.to_pylist()
        except pa.ArrowException as error:
            raise UnusableError(f"{manifest}: is no Parquet file: {error}") from error
    else:
        try:
            yield from csv.DictReader(io.StringIO(content.decode("utf-8-sig")))
        except (UnicodeDecodeError, csv.Error) as error:
            raise UnusableError(f"{manifest}: is no CSV file: {error}") from error
