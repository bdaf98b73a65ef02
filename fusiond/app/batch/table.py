"""Rows as Parquet, written atomically: a reader finds the whole file or the one before it. Needs the extra `batch`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from types import NoneType, TracebackType, UnionType
from typing import Any, Literal, get_args, get_origin

import msgspec

from fusiond.app.batch.row import Row
from fusiond.errors import UnusableError, UsageError
from fusiond_adapters.host.bounded_folder import sync_folder

try:
    import pyarrow as pa
    from pyarrow import parquet
except ModuleNotFoundError as missing:
    raise UsageError("fusiond batch needs the extra batch: pip install 'fusiond[batch]'") from missing

AT_ONCE = 1000  # rows of a group
PLAIN = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def arrow_type(hint: Any) -> pa.DataType:
    """The type of Parquet of a field of a struct."""
    if hint in PLAIN:
        return PLAIN[hint]
    if get_origin(hint) is Literal:
        return pa.string()
    if isinstance(hint, UnionType):
        (inner,) = (one for one in get_args(hint) if one is not NoneType)
        return arrow_type(inner)
    if get_origin(hint) is list:
        return pa.list_(arrow_type(get_args(hint)[0]))
    return pa.struct(list(_fields(hint)))


def _fields(kind: type[msgspec.Struct]) -> Iterator[pa.Field]:
    for item in msgspec.structs.fields(kind):
        yield pa.field(item.name, arrow_type(item.type))


def schema_of(kind: type[msgspec.Struct]) -> pa.Schema:
    """The columns of a struct."""
    return pa.schema(list(_fields(kind)))


SCHEMA = pa.schema([pa.field("drive", pa.string()), pa.field("key", pa.string()), *_fields(Row)])


class ParquetFile:
    """A file that is there when it is complete. A context manager. Raises OSError."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._path, self._schema = path, schema
        self._fresh = path.with_name(f".{path.name}.new")
        self._writer: Any = None

    def write(self, rows: list[dict[str, Any]]) -> None:
        """Write some rows as one group."""
        if rows:
            self._writer.write_table(pa.Table.from_pylist(rows, self._schema))

    def __enter__(self) -> ParquetFile:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = parquet.ParquetWriter(self._fresh, self._schema, compression="zstd")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._writer.close()
        if kind is not None:
            self._fresh.unlink(missing_ok=True)
            return
        with self._fresh.open("rb") as file:
            os.fsync(file.fileno())
        self._fresh.replace(self._path)
        sync_folder(self._path.parent)


def write_rows(path: Path, rows: Iterable[tuple[str, str, Row]]) -> None:
    """Write rows with their drives and keys, in the order given. Raises OSError."""
    with ParquetFile(path, SCHEMA) as file:
        for some in _in_groups(rows):
            file.write([{"drive": drive, "key": key, **msgspec.to_builtins(row)} for drive, key, row in some])


def _in_groups(rows: Iterable[tuple[str, str, Row]]) -> Iterator[list[tuple[str, str, Row]]]:
    iterator = iter(rows)
    while some := list(islice(iterator, AT_ONCE)):
        yield some


def read_rows(path: Path) -> Iterator[tuple[str, str, Row]]:
    """The rows of a file, in its order. Raises UnusableError."""
    try:
        with parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(AT_ONCE):
                for table in batch.to_pylist():
                    drive, key = table.pop("drive"), table.pop("key")
                    yield drive, key, msgspec.convert(table, Row)
    except (OSError, pa.ArrowException, KeyError, msgspec.ValidationError) as error:
        raise UnusableError(f"{path}: holds no rows of fusiond batch: {error}") from error
