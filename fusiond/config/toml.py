"""From a TOML file to typed, frozen structs. An error names the file, the line, the key and what is allowed."""

from __future__ import annotations

import io
import math
import re
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta, Struct

from fusiond.errors import UsageError

MAX_BYTES, MAX_LINE = 1 << 18, 2000  # of a file; characters of a line. A dotted key takes time by its length squared
INTEGERS = range(-(1 << 63), 1 << 63)  # as TOML has them

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_]+$", description="a name of letters, digits and underscores")]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Vector = tuple[float, float, float]


class ConfigError(UsageError):
    """The configuration cannot be used; the message says where and why."""


class Section(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A TOML table: unknown keys are errors."""


def read_text(path: Path) -> str:
    """The text of a file. Raises ConfigError."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ConfigError(f"{path}: is larger than {MAX_BYTES >> 10} KiB")
        return io.TextIOWrapper(io.BytesIO(content), encoding="utf-8").read()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text") from error


Table = TypeVar("Table", bound=Section)


def decode(text: str, path: Path, kind: type[Table], **given: object) -> Table:
    """Check the text of a TOML file against a struct. `given` are fields that no file may set. Raises ConfigError."""
    for number, line in enumerate(text.splitlines(), 1):
        if len(line) > MAX_LINE:
            raise ConfigError(f"{path}:{number}: a line of {len(line)} characters; at most {MAX_LINE}")
    try:
        table = tomllib.loads(text)
        unusable = list(_unusable_numbers(table))
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: tables or arrays are nested too deeply") from error
    for key in given:
        if key in table:
            raise ConfigError(f"{path}:{_line_of(key, text)}: {key}: unknown key")
    refuse(unusable, text, path)
    try:
        return msgspec.convert(table | given, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error), table, text, path, kind=kind, given=given)) from error


def refuse(complaints: Iterable[tuple[str, str]], text: str, path: Path) -> None:
    """Raise ConfigError for the first complaint (dotted key, what is wrong), if there is one."""
    for key, complaint in complaints:
        raise ConfigError(f"{path}:{_line_of(key, text)}: {key}: {complaint}")


def _unusable_numbers(value: object, key: str = "") -> Iterator[tuple[str, str]]:
    """The dotted key of every number in a table or array that is inf, nan or beyond 64 bits, and what is wrong with it."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _unusable_numbers(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for place, inner in enumerate(value):
            yield from _unusable_numbers(inner, f"{key}[{place}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield key, "must be a finite number"
    elif isinstance(value, int) and value not in INTEGERS:
        yield key, "must fit into 64 bits"


def _explain(
    message: str, table: dict[str, object], text: str, path: Path, *, kind: type[Section], given: dict[str, object]
) -> str:
    """msgspec's complaint, with the file's line, the dotted key and the allowed keys."""
    where = re.search(r" - at (?:`key` in )?`\$\.?(.*?)`$", message)
    inside = where.group(1) if where else ""
    what = message[: where.start()] if where else message
    key = _resolve(inside, message, table, kind)
    unknown = re.search(r"unknown field `(\w+)`", message)
    if unknown:
        here = _kind_at(kind, key.split(".") if key else [])
        allowed = sorted(set(here.__struct_fields__) - set(given)) if here else []
        key = f"{key}.{unknown.group(1)}" if key else unknown.group(1)
        what = f"unknown key; allowed: {', '.join(allowed)}"
    missing = re.search(r"missing required field `(\w+)`", message)
    if missing:
        what = f"the key '{missing.group(1)}' is missing"
    if what.startswith("Invalid enum value"):
        what += f"; allowed: {', '.join(_choices(kind, key))}"
    if " at `key` in " in message:
        entries = table[inside]
        assert isinstance(entries, dict)
        key = f"{inside}.{next(name for name in entries if not re.fullmatch('[A-Za-z0-9_]+', name))}"
        what = f"must be {_descriptions(Name)[0]}"
    elif "matching regex" in what:
        what = f"must be {_descriptions(_type_of(kind, key))[0]}"
    return f"{path}:{_line_of(key, text)}: {key or 'the file'}: {what}"


def _choices(kind: type[Section], key: str) -> list[str]:
    """The values that an enumerated key may have."""
    return [str(choice) for choice in _literals(_type_of(kind, key))]


def _type_of(kind: type[Section], key: str) -> object:
    """The type of the field that a dotted key names; None if there is no such field."""
    *tables, last = key.split(".")
    here = _kind_at(kind, tables)
    types = {item.name: item.type for item in msgspec.structs.fields(here)} if here else {}
    return types.get(last)


def _descriptions(hint: object) -> list[str]:
    """What the patterns of a type describe."""
    if isinstance(hint, Meta):
        return [hint.description] if hint.description else []
    return [description for inner in get_args(hint) for description in _descriptions(inner)]


def _literals(hint: object) -> list[object]:
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    return [choice for inner in get_args(hint) for choice in _literals(inner)]


def _resolve(inside: str, message: str, table: dict[str, object], kind: type[Section]) -> str:
    """msgspec writes `[...]` in place of a table's name: find the name of the table with the error."""
    if "[...]" not in inside:
        return inside
    head, tail = inside.split("[...]", 1)
    entries = table.get(head)
    inner = _kind_at(kind, [head, "NAME"])
    if isinstance(entries, dict) and inner is not None:
        for name, entry in entries.items():
            try:
                msgspec.convert({name: entry}, dict[Name, inner])  # type: ignore[valid-type]
            except msgspec.ValidationError as error:
                if str(error) == message.replace(f"$.{head}[...]", "$[...]"):
                    return f"{head}.{name}{tail}"
    return head


def _kind_at(kind: type[Section], parts: list[str]) -> type[Section] | None:
    """The struct at a dotted key, through arrays of tables and tables of named tables."""
    here: type[Section] | None = kind
    named = False
    for part in parts:
        if named:
            named = False
            continue
        types = {item.name: item.type for item in msgspec.structs.fields(here)} if here else {}
        here, named = _section_in(types.get(part.split("[")[0]))
    return here


def _section_in(hint: object) -> tuple[type[Section] | None, bool]:
    """The struct inside a field's type, and whether it stands in a table of named tables."""
    if isinstance(hint, type) and issubclass(hint, Section):
        return hint, False
    found = [inner for inner, _ in map(_section_in, get_args(hint)) if inner is not None]
    return (found[0], get_origin(hint) is dict) if found else (None, False)


def _line_of(key: str, text: str) -> int:
    """The line of a dotted key, or of the nearest table above it; 1 if neither is in the text."""
    parts = key.split(".")
    table, best, depth = "", 1, 0
    counts: dict[str, int] = {}  # of the tables in an array so far
    for number, line in enumerate(text.splitlines(), 1):
        head = re.match(r"\s*(\[+)([^\]]+)\]", line)
        if head:
            table = re.sub("[\"']", "", head.group(2).strip())
            if head.group(1) == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = f"{table}[{counts[table]}]"
            shared = len([1 for a, b in zip(table.split("."), parts, strict=False) if a == b])
            if key.startswith(table) and shared > depth:
                best, depth = number, shared
            continue
        assigned = re.match(r"\s*([\w.\-]+)\s*=", line)
        if assigned:
            full = f"{table}.{assigned.group(1)}" if table else assigned.group(1)
            if full == key or key.startswith(full + "["):
                return number
    return best
