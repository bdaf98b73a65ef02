"""The generated files of the compiled kernel: what they hold."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType

from tools.translate_kernel.functions import ROOT, Function, functions
from tools.translate_kernel.kinds import COUNTED, FIELDS, size_of
from tools.translate_kernel.statements import Translation

KERNEL = ROOT / "fusiond" / "filter" / "kernel"
SIZES = {  # constants that the structs and the kernel's class need by name, and where they are
    "fusiond.filter.state": (
        "NOMINAL_SIZE", "AUXILIARY_SIZE", "MEMORY_SIZE", "STAMPS_SIZE", "SOURCE_STAMPS_SIZE", "HYPOTHESES", "CALIBRATIONS",
        "WIDE_SIZE", "PHASE", "CHOOSING", "ALIVE", "T",
    ),
    "fusiond.filter.observations.model": ("VALUES", "PARAMETERS"),
    "fusiond.filter.observations": ("IMU",),
    "fusiond.filter.north_east_down": ("STATE_N_SIZE",),
    "fusiond.filter.smoothing": ("PARTS", "LINKS"),
}  # fmt: skip  # fmt: skip
HEAD = """\
# Made by tools/translate_kernel from fusiond/filter and fusiond/maths: not to be edited. `n`: number of error states.
"""
WIDTH = """\
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Made by tools/translate_kernel: not to be edited.
\"\"\"The compiled hot loop (kernel.pxi) for {about}: see there.\"\"\"

cdef enum:
    n = {size}  # error states

include "kernel.pxi"
"""


def tables(known: dict[FunctionType, Function]) -> Iterator[str]:
    """Tuples of numbers that are indexed at run time."""
    done: set[str] = set()
    for function in known.values():
        for node in ast.walk(function.tree):
            if (
                isinstance(node, ast.Subscript)
                and isinstance(node.value, ast.Name)
                and not isinstance(node.slice, ast.Constant)
            ):
                found = vars(function.module).get(node.value.id)
                if isinstance(found, tuple) and all(isinstance(item, float) for item in found) and node.value.id not in done:
                    done.add(node.value.id)
                    yield f"cdef double[{len(found)}] {node.value.id} = [{', '.join(map(repr, found))}]"


def layout() -> str:
    """Sizes and structs, as the Python modules have them."""
    lines = [HEAD, "cdef enum:"]
    for module, names in SIZES.items():
        found = importlib.import_module(module)
        lines += [f"    {name} = {int(getattr(found, name))}" for name in names]
    lines += ["    BLOCK = 1 + NOMINAL_SIZE + n * n  # numbers of a hypothesis: weight, nominal, covariance", ""]
    for struct in ("Noise", "Observation", "Link", "Row", "State", "Parameters"):
        lines.append(f"cdef struct {struct}:")
        for name, kind in FIELDS[struct].items():
            if struct == "Row" and name in ("source", "outcome"):
                lines.append(f"    int32_t {name}")
            elif kind.is_scalar or kind.name == "struct" or (struct in ("State", "Parameters") and name != "gates"):
                lines.append(f"    {kind.c} {name}")
            elif name == "jacobian":  # models name columns that only the wide state has
                lines.append(f"    {kind.of} {name}[2 * n + WIDE_SIZE]")
            else:
                lines.append(f"    {kind.of} {name}[{size_of(kind)}]")
            if struct == "Parameters" and name in COUNTED:
                lines.append(f"    int64_t {name}_count")
        lines.append("")
    scalars = [name for name, kind in FIELDS["Parameters"].items() if kind.is_scalar]
    lines += ["", "cdef int load_scalars(Parameters* loaded, params) except -1:"]
    lines += ['    """The numbers of fusiond.filter.parameters.Parameters."""']
    lines += [f"    loaded.{name} = params.{name}" for name in scalars]
    lines += ["    return 0", ""]
    return "\n".join(lines)


def bodies() -> str:
    """The translated functions."""
    known = functions()
    parts = [HEAD, "\n".join(tables(known))]
    module = None
    for function in known.values():
        if function.is_primitive:
            continue
        if function.module is not module:
            module = function.module
            parts.append(f"# {'-' * 16} {module.__name__}")
        parts.append(Translation(function, known).text())
    return "\n\n".join(part for part in parts if part) + "\n"


def made() -> dict[Path, str]:
    """The files and their text."""
    state = importlib.import_module("fusiond.filter.state")
    wide = ("the state with all calibrations", state.WIDE_SIZE)
    widths = {"narrow": ("the ordinary state", state.ERROR_SIZE), "wide": wide}
    files = {KERNEL / f"{name}.pyx": WIDTH.format(about=about, size=size) for name, (about, size) in widths.items()}
    return files | {KERNEL / "layout.pxi": layout(), KERNEL / "functions.pxi": bodies()}
