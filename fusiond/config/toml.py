"""From a TOML file to typed, frozen structs. All errors are told at once: each names file, line, key and what is allowed."""

from __future__ import annotations

import difflib
import io
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta, Struct

from fusiond.errors import UsageError

MAX_BYTES, MAX_LINE = 1 << 18, 2000  # of a file; characters of a line. A dotted key takes time by its length squared
MAX_COMPLAINTS = 20  # about one file
INTEGERS = range(-(1 << 63), 1 << 63)  # as TOML has them

MISSING = re.compile(r"missing required field `(\w+)`")

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_]+$", description="a name of letters, digits and underscores")]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Vector = tuple[float, float, float]
Complaint = tuple[str, str]  # dotted key, what is wrong


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
Made = TypeVar("Made")


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
            raise ConfigError(f"{path}:{line_of(key, text)}: {key}: unknown key")
    refuse(unusable, text, path)
    complaints: list[Complaint] = []
    wrong: set[str] = set()  # what was taken out is not missing
    while len(complaints) < MAX_COMPLAINTS:
        try:
            decoded = msgspec.convert(table | given, kind)
        except msgspec.ValidationError as error:
            key, what = _explain(str(error), table, kind=kind, given=given)
            missing = MISSING.search(str(error))
            if not (missing and f"{key}.{missing.group(1)}" in wrong):
                complaints.append((key, what))
            wrong.add(key)
            if not _take_out(table, key):
                break
        else:
            refuse(complaints, text, path)
            return decoded
    refuse(complaints, text, path)
    raise AssertionError("a complaint is refused")


def refuse(complaints: Iterable[Complaint], text: str, path: Path) -> None:
    """Raise ConfigError with all complaints, a line for each in the order of the file, if there are any."""
    lines = [(line_of(key, text), f"{key or 'the file'}: {complaint}") for key, complaint in complaints]
    if lines:
        raise ConfigError("\n".join(f"{path}:{number}: {words}" for number, words in sorted(lines, key=itemgetter(0))))


def all_made(makers: Iterable[Callable[[], Made]]) -> list[Made]:
    """The results of all calls. Raises ConfigError with the complaints of all that raise it."""
    made, complaints = [], []
    for make in makers:
        try:
            made.append(make())
        except ConfigError as error:
            complaints.append(str(error))
    if complaints:
        raise ConfigError("\n".join(complaints))
    return made


def meant(name: str, known: Iterable[str]) -> str:
    """A question in brackets, with a space before it, where a wrong name is like a known one; else nothing."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean '{near[0]}'?)" if near else ""


def _take_out(table: dict[str, object], key: str) -> bool:
    """Leave a value out of a table, so that what follows it can be checked. False if it cannot be found."""
    *path, last = re.findall(r"[^.\[\]]+", key) or [""]
    here: object = table
    for part in path:
        here = here[int(part)] if isinstance(here, list) else here.get(part) if isinstance(here, dict) else None
    if isinstance(here, dict):
        return here.pop(last, None) is not None
    if isinstance(here, list):  # a part of a value: all of it
        return _take_out(table, key.rpartition("[")[0])
    return False


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


def _explain(message: str, table: dict[str, object], *, kind: type[Section], given: dict[str, object]) -> Complaint:
    """msgspec's complaint: the dotted key, and what is wrong with it, with the allowed keys or values."""
    where = re.search(r" - at (?:`key` in )?`\$\.?(.*?)`$", message)
    inside = where.group(1) if where else ""
    what = message[: where.start()] if where else message
    key = _resolve(inside, message, table, kind)
    unknown = re.search(r"unknown field `(\w+)`", message)
    if unknown:
        here = _kind_at(kind, key.split(".") if key else [])
        allowed = sorted(set(here.__struct_fields__) - set(given)) if here else []
        key = f"{key}.{unknown.group(1)}" if key else unknown.group(1)
        what = f"unknown key{meant(unknown.group(1), allowed)}; allowed: {', '.join(allowed)}"
    missing = MISSING.search(message)
    if missing:
        what = f"the key '{missing.group(1)}' is missing"
    if wrong := re.match(r"Invalid enum value '?(.*?)'?$", what):
        choices = _choices(kind, key)
        what += f"{meant(wrong.group(1), choices)}; allowed: {', '.join(choices)}"
    if " at `key` in " in message:
        entries = table[inside]
        assert isinstance(entries, dict)
        key = f"{inside}.{next(name for name in entries if not re.fullmatch('[A-Za-z0-9_]+', name))}"
        what = f"must be {_descriptions(Name)[0]}"
    elif "matching regex" in what:
        what = f"must be {_descriptions(_type_of(kind, key))[0]}"
    return key, what


def _choices(kind: type[Section], key: str) -> list[str]:
    """The values that an enumerated key may have."""
    return [str(choice) for choice in _literals(_type_of(kind, key))]


def _type_of(kind: type[Section], key: str) -> object:
    """The type of the field that a dotted key names; None if there is no such field."""
    *tables, last = key.split(".")
    here = _kind_at(kind, tables)
    types = {item.name: item.type for item in msgspec.structs.fields(here)} if here else {}
    return types.get(last.split("[")[0])


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


def line_of(key: str, text: str) -> int:
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
            if (key.startswith(table) or table.startswith(f"{key}.")) and shared > depth:
                best, depth = number, shared
            continue
        assigned = re.match(r"\s*([\w.\-]+)\s*=", line)
        if assigned:
            full = f"{table}.{assigned.group(1)}" if table else assigned.group(1)
            if full == key or key.startswith(full + "["):
                return number
    return best
