"""The generated part of the compiled kernel (layout.pxi, functions.pxi): it is what tools/translate_kernel makes of the
Python sources as they are now, and holds every function that is marked for it."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module

import pytest

from fusiond.filter.observations.model import VALUES
from fusiond.filter.rows import ROW
from fusiond.filter.state import ERROR_SIZE, WIDE_SIZE
from tests.helpers.paths import ROOT

KERNEL = ROOT / "fusiond" / "filter" / "kernel"


def marked(mark: str) -> Iterator[tuple[str, str]]:
    """Module and name of every function with a mark, wherever in the package it stands."""
    for path in sorted((ROOT / "fusiond").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and mark in map(ast.unparse, node.decorator_list):
                yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), node.name


def test_the_committed_files_are_current() -> None:
    command = [sys.executable, "-m", "tools.translate_kernel", "--check"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_every_marked_function_is_compiled_once() -> None:
    text = (KERNEL / "functions.pxi").read_text(encoding="utf-8")
    defined = re.findall(r"^cdef .*?(\w+)\([^()]*\) noexcept nogil:$", text, re.MULTILINE)
    expected = [f"{module.rpartition('.')[2]}_{name}" for module, name in marked("compiled")]
    assert len(expected) > 100
    assert sorted(defined) == sorted(expected)


def test_marked_functions_stand_where_they_are_looked_for() -> None:
    for module, name in marked("compiled"):
        assert module.startswith(("fusiond.maths.", "fusiond.filter.")), f"{module}.{name}"
        assert callable(getattr(import_module(module), name))


def test_what_is_written_by_hand_is_there() -> None:
    text = (KERNEL / "primitives.pxi").read_text(encoding="utf-8")
    names = [f"{module.rpartition('.')[2]}_{name}" for module, name in marked("primitive")]
    assert names
    assert all(re.search(rf"^cdef .*\b{name}\(", text, re.MULTILINE) for name in names)


def struct(name: str) -> list[tuple[str, str, str]]:
    """Type, name and size of the fields of a struct in layout.pxi."""
    text = (KERNEL / "layout.pxi").read_text(encoding="utf-8")
    (body,) = re.findall(rf"^cdef struct {name}:\n((?:    .+\n)+)", text, re.MULTILINE)
    return re.findall(r"^    (\w+\*?) (\w+)(?:\[(.+)\])?$", body, re.MULTILINE)


def test_a_row_is_laid_out_as_in_the_table() -> None:
    types = {"int64_t": "i8", "int32_t": "i4", "double": "f8"}
    sizes = {"": (), "3": (3,), "VALUES": (VALUES,)}
    found = [(name, types[type_], sizes[size]) for type_, name, size in struct("Row")]
    assert found == [(name, ROW[name].base.str[1:], ROW[name].shape) for name in ROW.names or ()]


@pytest.mark.parametrize(("name", "size"), [("narrow", ERROR_SIZE), ("wide", WIDE_SIZE)])
def test_the_kernels_are_for_the_two_sizes_of_a_state(name: str, size: int) -> None:
    assert f"\n    n = {size}  # error states\n" in (KERNEL / f"{name}.pyx").read_text(encoding="utf-8")
