"""Fill the tables of keys in configuration.md and simulator.md from the source: python docs/make_configuration.py"""

import ast
import inspect
import json
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import msgspec
from msgspec import Meta

from fusiond.config.schema import Config
from fusiond.config.toml import Name, Section
from fusiond.simulation.scenario import Scenario

FOLDER = Path(__file__).parent
PAGES: dict[str, tuple[type[Section], frozenset[str]]] = {  # page: the whole file's struct, fields that are no keys
    "configuration.md": (Config, frozenset({"directory"})),
    "simulator.md": (Scenario, frozenset()),
}
TOP = "Before the first table"
BEGIN, END = "<!-- keys: made by make_configuration.py -->\n", "<!-- keys: end -->\n"
SUFFIXES = {  # of a key: its unit; the longest that fits
    "_deg_per_mps2": "deg/(m/s^2)", "_deg_s": "deg/s", "_mps2": "m/s^2", "_mps": "m/s", "_deg": "deg", "_ppm": "ppm",
    "_kmh": "km/h", "_ms": "ms", "_hz": "Hz", "_mb": "MB", "_m": "m", "_s": "s",
}  # fmt: skip
UNIT = re.compile(r"\s*\[([^][]*/[^][]*)\](?:,\s*)?")  # of a comment: `[m/s^2]`; a table's name has no stroke
ABOUT = re.compile(r"\[+[\w.]+\]+:?\s*")  # what a struct's docstring begins with
BOUNDS = (("gt", "> {}"), ("ge", ">= {}"), ("lt", "< {}"), ("le", "<= {}"))


class Table(NamedTuple):
    """One TOML table, which may stand at several places of the file."""

    struct: type[Section]
    defaults: dict[str, Any]  # by place, such as `[imu.NAME]`: an instance, or None where it has none


def page(name: str, text: str) -> str:
    """The text of a page with its tables regenerated."""
    root, omitted = PAGES[name]
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + "\n".join(_lines(root, omitted)) + "\n" + END + after


def _lines(root: type[Section], omitted: frozenset[str]) -> Iterator[str]:
    for table in _tables(root):
        rows = [row for row in _rows(table) if row[0].strip("`") not in omitted]
        if not rows:
            continue
        about = ABOUT.sub("", inspect.getdoc(table.struct) or "")
        yield "\n### " + (", ".join(f"`{place}`" for place in table.defaults) if table.struct is not root else TOP)
        if about and table.struct is not root:
            yield f"\n{about[0].upper()}{about[1:]}"
        yield "\n| key | unit | default | allowed | meaning |\n|---|---|---|---|---|"
        for row in rows:
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"


def _tables(root: type[Section]) -> list[Table]:
    """A file's struct and the tables below it, in the order of the file."""
    found: dict[type[Section], Table] = {}

    def walk(struct: type[Section], path: str, place: str, default: Any) -> None:
        found.setdefault(struct, Table(struct, {})).defaults[place] = default
        for field in msgspec.structs.fields(struct):
            inner, kind = _section(field.type)
            if inner is None:
                continue
            inside = f"{path}.{field.name}" if path else field.name
            place = {"dict": f"[{inside}.NAME]", "list": f"[[{inside}]]"}.get(kind, f"[{inside}]")
            own = getattr(default, field.name) if default is not None else _default(field)
            walk(inner, inside, place, own if kind == "table" else None)

    walk(root, "", "", None)
    return list(found.values())


def _section(hint: Any) -> tuple[type[Section] | None, str]:
    """The struct in a field's type, and whether it is a table, a dict or a list of them."""
    if isinstance(hint, type) and issubclass(hint, Section):
        return hint, "table"
    for inner in get_args(hint):
        struct, _ = _section(inner)
        if struct:
            kinds = {dict: "dict", list: "list"}
            return struct, kinds.get(get_origin(hint), _section(inner)[1])
    return None, ""


def _rows(table: Table) -> Iterator[tuple[str, str, str, str, str]]:
    comments = _comments(table.struct)
    for field in msgspec.structs.fields(table.struct):
        if _section(field.type)[0]:
            continue
        comment = comments[field.name]
        unit = UNIT.search(comment)
        named = next((SUFFIXES[end] for end in SUFFIXES if field.name.endswith(end)), "")
        meaning = UNIT.sub("", comment).strip()
        default = _defaults(field, table.defaults)
        yield f"`{field.name}`", unit[1] if unit else named, default, _allowed(field.type), meaning


def _comments(struct: type[Section]) -> dict[str, str]:
    """The trailing comment of every field, inherited ones too. KeyError where one has none."""
    found: dict[str, str] = {}
    for kind in reversed(struct.__mro__):
        if issubclass(kind, Section):
            found |= _own_comments(kind)
    wanted = {field.name for field in msgspec.structs.fields(struct) if not _section(field.type)[0]}
    silent = sorted(name for name in wanted if not UNIT.sub("", found.get(name, "")))
    if silent:
        raise KeyError(f"{struct.__name__}: a trailing comment is missing: {', '.join(silent)}")
    return {name: found[name] for name in wanted}


def _own_comments(struct: type[Section]) -> dict[str, str]:
    """The trailing comments of the fields that a struct itself defines."""
    lines = inspect.getsource(struct).splitlines(keepends=True)
    tokens = tokenize.generate_tokens(iter(lines).__next__)
    by_line = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    (tree,) = ast.parse("".join(lines)).body
    assert isinstance(tree, ast.ClassDef)
    fields = {
        node.target.id: node.end_lineno or 0
        for node in tree.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    return {name: by_line[line] for name, line in fields.items() if line in by_line}


def _defaults(field: msgspec.structs.FieldInfo, instances: dict[str, Any]) -> str:
    """The default, and where a table's own differs from it."""
    if field.required:
        return "required"
    usual = _default(field)
    text = _toml(usual)
    for place, instance in instances.items():
        if instance is not None and getattr(instance, field.name) != usual:
            text += f", `{place}`: {_toml(getattr(instance, field.name))}"
    return text


def _default(field: msgspec.structs.FieldInfo) -> Any:
    if callable(field.default_factory):
        return field.default_factory()
    return None if field.required else field.default


def _toml(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, float) and value == float("inf"):
        return "`inf`"
    return f"`{json.dumps(value)}`"


def _allowed(hint: Any) -> str:
    """A type in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Name:
        words = "letters, digits, `_`"
    elif origin is Annotated:
        metas = [meta for meta in inner[1:] if isinstance(meta, Meta)]
        bounds = [form.format(getattr(m, key)) for m in metas for key, form in BOUNDS if getattr(m, key) is not None]
        words = f"{_allowed(inner[0])} {', '.join(bounds)}".strip()
    elif origin is Literal:
        words = ", ".join(f"`{json.dumps(value)}`" for value in inner)
    elif origin in (Union, UnionType):
        words = " or ".join(_allowed(part) for part in inner if part is not NoneType)
    elif origin is tuple:
        words = f"[{', '.join(_allowed(part) for part in inner)}]"
    elif origin is list:
        words = f"list of {_allowed(inner[0])}"
    else:
        words = {float: "number", int: "integer", bool: "`true`, `false`", str: "text"}[hint]
    return words


def main() -> None:
    for name in PAGES:
        file = FOLDER / name
        file.write_text(page(name, file.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
