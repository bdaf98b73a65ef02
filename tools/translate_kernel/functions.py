"""The functions that are translated: where they are looked for, and their parameters."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, ModuleType

from tools.translate_kernel.kinds import KINDS, Kind

ROOT = Path(__file__).parents[2]
PACKAGES = ("maths", "filter")  # whose modules are searched for functions marked @compiled


class UntranslatableError(Exception):
    """A function holds what has no translation; the message names file, line and reason."""


@dataclass
class Function:
    """One function that is translated."""

    module: ModuleType
    call: FunctionType
    tree: ast.FunctionDef
    parameters: dict[str, Kind]
    returns: Kind

    @property
    def c_name(self) -> str:
        return f"{self.module.__name__.rpartition('.')[2]}_{self.call.__name__}"

    @property
    def is_primitive(self) -> bool:
        """Whether it is written by hand, in kernel/primitives.pxi."""
        return any(isinstance(mark, ast.Name) and mark.id == "primitive" for mark in self.tree.decorator_list)

    @property
    def fills(self) -> bool:
        """Whether it writes its result where the caller says."""
        return self.returns.name in ("vector", "matrix")


def modules() -> Iterator[tuple[str, str]]:
    """Name and source of every module that may hold such functions."""
    for package in PACKAGES:
        for path in sorted((ROOT / "fusiond" / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            source = path.read_text(encoding="utf-8")
            if "\n@compiled" in source or "\n@primitive" in source:
                yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), source


def functions() -> dict[FunctionType, Function]:
    """Every function marked @compiled, or called by them and written by hand."""
    found: dict[FunctionType, Function] = {}
    for name, source in modules():
        module = importlib.import_module(name)
        for tree in ast.parse(source).body:
            if not isinstance(tree, ast.FunctionDef):
                continue
            marks = [mark.id for mark in tree.decorator_list if isinstance(mark, ast.Name)]
            if not {"compiled", "primitive"} & set(marks):
                continue
            call = getattr(module, tree.name)

            def kind_of(hint: ast.expr | None, tree: ast.FunctionDef = tree, name: str = name) -> Kind:
                text = ast.unparse(hint) if hint else ""
                if text.startswith("tuple["):
                    assert isinstance(hint, ast.Subscript) and isinstance(hint.slice, ast.Tuple)
                    items = tuple(kind_of(item) for item in hint.slice.elts)
                    if all(item.is_scalar for item in items):
                        return Kind("tuple", items=items)
                if text not in KINDS:
                    raise UntranslatableError(f"{name}:{tree.lineno}: {tree.name}: no translation of the type '{text}'")
                return KINDS[text]

            parameters = {argument.arg: kind_of(argument.annotation) for argument in tree.args.args}
            found[call] = Function(module, call, tree, parameters, kind_of(tree.returns))
    return found
