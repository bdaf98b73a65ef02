"""Makes the compiled kernel's source out of the filter's own: typed Python functions in, Cython out.

    python tools/translate_kernel.py            write the generated files of fusiond/filter/kernel
    python tools/translate_kernel.py --check    exit with 1 where one of them is not what would be written

The filter's functions that run for every event are written once, in Python, in fusiond/maths and fusiond/filter; the
interpreter runs them as they are. Here the same functions become C-level Cython: the same operations in the same order, so
both give the same bits. What may stand in such a function is small on purpose:

    int, float, bool     a scalar
    Vector3 and its like a fixed number of floats: `mat_eb[i, j]`, `x[POSITION_E]`, `rates * dt + rest`, element by element
    views                a slice, a row or a column of an array is a view, as in NumPy: a pointer here
    np.array, np.empty, np.zeros, .copy()   memory of a constant size, on the stack here
    FilterState, Plan, Row, Observation, ProcessNoise   the structs of FIELDS below
    if, while, for over range, a call of another such function, and math's functions

A function that returns an array writes it where its caller says. Anything else is an error that names the line. A module's
constants (numbers, slices, enumerations) are put in as numbers, so that none stands twice.
"""

from __future__ import annotations

import ast
import enum
import importlib
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, ModuleType
from typing import NoReturn

ROOT = Path(__file__).parents[1]
KERNEL = ROOT / "fusiond" / "filter" / "kernel"
PACKAGES = ("maths", "filter")  # whose modules are searched for functions marked @compiled
SIZES = {  # constants that the structs and the kernel's class need by name, and where they are
    "fusiond.filter.state": (
        "NOMINAL_SIZE", "AUXILIARY_SIZE", "MEMORY_SIZE", "STAMPS_SIZE", "SOURCE_STAMPS_SIZE", "HYPOTHESES", "CALIBRATIONS",
        "WIDE_SIZE", "PHASE", "CHOOSING", "T",
    ),
    "fusiond.filter.observations.model": ("VALUES", "PARAMETERS"),
    "fusiond.filter.observations": ("IMU",),
    "fusiond.filter.north_east_down": ("ANSWER_SIZE",),
}  # fmt: skip
HEAD = """\
# Made by tools/translate_kernel.py from fusiond/filter and fusiond/maths: not to be edited. `n`: number of error states.
"""


WIDTH = """\
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Made by tools/translate_kernel.py: not to be edited.
\"\"\"The compiled hot loop (kernel.pxi) for {about}: see there.\"\"\"

cdef enum:
    n = {size}  # error states

include "kernel.pxi"
"""


@dataclass(frozen=True)
class Kind:
    """What an expression is. `name`: "int", "float", "bool", "vector" (numbers `stride` apart), "matrix" (rows of
    `columns`), "pointer" (to a struct, perhaps none), "struct" (one on the stack), "tuple", "none". Sizes are C code."""

    name: str
    of: str = "double"  # C type of an element, or the struct's name
    size: str = ""  # elements of a vector, rows of a matrix; empty: not known
    columns: str = ""
    stride: str = "1"
    items: tuple[Kind, ...] = ()

    @property
    def is_scalar(self) -> bool:
        return self.name in ("int", "float", "bool")

    @property
    def c(self) -> str:
        """Its C type as a parameter or variable."""
        if self.is_scalar:
            return {"int": "int64_t", "float": "double", "bool": "bint"}[self.name]
        if self.name in ("vector", "matrix", "pointer"):
            return f"{self.of}*"
        if self.name == "tuple":
            return f"({', '.join(item.c for item in self.items)})"
        return {"none": "void", "struct": self.of}[self.name]


INT, FLOAT, BOOL, NONE = Kind("int"), Kind("float"), Kind("bool"), Kind("none")


def vector(size: str = "", of: str = "double", stride: str = "1") -> Kind:
    return Kind("vector", of, size, stride=stride)


def matrix(rows: str, columns: str, of: str = "double") -> Kind:
    return Kind("matrix", of, rows, columns)


KINDS = {  # annotations
    "int": INT,
    "float": FLOAT,
    "bool": BOOL,
    "None": NONE,
    "Vector": vector(),
    "Vector3": vector("3"),
    "Quaternion": vector("4"),
    "Matrix3": matrix("3", "3"),
    "ErrorVector": vector("n"),
    "ErrorRows3": matrix("3", "n"),
    "Covariance": matrix("n", "n"),
    "Answer": vector("ANSWER_SIZE"),
    "Stamps": vector(of="int64_t"),
    "FilterState": Kind("pointer", "State"),
    "Plan": Kind("pointer", "Plan"),
    "ProcessNoise": Kind("pointer", "Noise"),
    "Observation": Kind("pointer", "Observation"),
    "Row": Kind("pointer", "Row"),
    "Row | None": Kind("pointer", "Row"),
    "Rows": Kind("pointer", "Row", size="rows"),
}
FIELDS: dict[str, dict[str, Kind]] = {  # of the structs
    "State": {
        "nominal": vector("NOMINAL_SIZE"),
        "covariance": matrix("n", "n"),
        "auxiliary": vector("AUXILIARY_SIZE"),
        "memory": matrix("", "MEMORY_SIZE"),
        "bank": matrix("HYPOTHESES", "BLOCK"),
        "stamps": vector("STAMPS_SIZE", "int64_t"),
        "source_stamps": matrix("", "SOURCE_STAMPS_SIZE", "int64_t"),
        "size": INT,
        "sources": INT,
    },
    "Noise": {
        "accel": FLOAT,
        "gyro": FLOAT,
        "accel_bias": FLOAT,
        "gyro_bias": FLOAT,
        "calibrations": vector("(n - CALIBRATIONS)"),
    },
    "Observation": {"m": INT, "innovation": vector("3"), "jacobian": matrix("3", "n"), "variance": vector("3")},
    "Row": {
        "t_ns": INT,
        "sequence": INT,
        "t_receive_ns": INT,
        "source": INT,
        "outcome": INT,
        "ratio": FLOAT,
        "values": vector("VALUES"),
        "innovation": vector("3"),
        "variance": vector("3"),
    },
    "Plan": {
        "noise": Kind("struct", "Noise"),
        "models": vector("", "int64_t"),
        "wheels": vector("", "int64_t"),
        "velocities": vector("", "int64_t"),
        "parameters": matrix("", "PARAMETERS"),
        "constraints": matrix("3", "PARAMETERS"),
        "gates": vector("4"),
        "imu_source": INT,
        "imu_gap_ns": INT,
        "restart_gap_ns": INT,
        "gnss_reset_ns": INT,
        "gnss_return_ns": INT,
        "constraint_interval_ns": INT,
        "still_after_ns": INT,
        "snapshot_interval_ns": INT,
        "standstill": BOOL,
        "non_holonomic": BOOL,
        "course_speed": FLOAT,
        "still_wheel": FLOAT,
        "still_gyro": FLOAT,
        "still_accel": FLOAT,
        "zero_velocity_factor": FLOAT,
        "heading_variance": FLOAT,
    },
}
COUNTED = {"models", "wheels", "velocities"}  # of Plan: lists whose length is a field as well
MATHS = {
    "sqrt": ("sqrt", FLOAT),
    "floor": ("floor", FLOAT),
    "ceil": ("ceil", FLOAT),
    "isfinite": ("isfinite", BOOL),
    "isnan": ("isnan", BOOL),
    "ldexp": ("ldexp", FLOAT),
    "copysign": ("copysign", FLOAT),
}


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


def size_of(kind: Kind) -> str:
    return f"{kind.size} * {kind.columns}" if kind.name == "matrix" else kind.size


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


@dataclass(frozen=True)
class Value:
    """An expression: its code and what it is. The code of a vector that is no view has `@` where the index goes."""

    code: str
    kind: Kind
    is_view: bool = False

    def at(self, index: str) -> str:
        """An element of a vector."""
        if not self.is_view:
            return self.code.replace("@", index)
        if self.kind.stride == "1":
            return f"{bracketed(self.code)}[{index}]"
        return f"{bracketed(self.code)}[{index} * {self.kind.stride}]"


def _without_calls(node: ast.expr) -> Iterator[ast.expr]:
    """The expressions of an expression, but not those handed to a function: what that returns is apart."""
    yield node
    if not isinstance(node, ast.Call):
        for part in ast.iter_child_nodes(node):
            if isinstance(part, ast.expr):
                yield from _without_calls(part)


def bracketed(code: str) -> str:
    return code if code.replace("_", "").replace(".", "").isalnum() else f"({code})"


class Translation:
    """The body of one function."""

    def __init__(self, function: Function, known: dict[FunctionType, Function]) -> None:
        self._function, self._known = function, known
        self._globals = vars(function.module)
        self._locals: dict[str, Kind] = dict(function.parameters)
        self._views = {name for name, kind in function.parameters.items() if not kind.is_scalar}
        self._aliases: set[str] = set()  # views that are pointers of their own
        self._seen_elsewhere: set[str] = set()  # arrays that these views are of
        self._declared: list[str] = []
        self._lines: list[str] = []
        self._depth = 1
        self._temporaries = 0

    def text(self) -> str:
        function = self._function
        for statement in function.tree.body:
            self._statement(statement)
        parameters = [f"{kind.c} {name}" for name, kind in function.parameters.items()]
        returns = function.returns.c
        if function.fills:
            parameters.append("double* out")
            returns = "void"
        head = f"cdef {returns} {function.c_name}({', '.join(parameters)}) noexcept nogil:"
        body = [f"    cdef {line}" for line in self._declared] + (self._lines or ["    pass"])
        return "\n".join([head, *body])

    # --- Statements

    def _fail(self, node: ast.AST, reason: str) -> NoReturn:
        where = f"{self._function.module.__name__}:{getattr(node, 'lineno', '?')}"
        raise UntranslatableError(f"{where}: {self._function.call.__name__}: {reason}: {ast.unparse(node)}")

    def _emit(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)

    def _block(self, statements: list[ast.stmt]) -> None:
        self._depth += 1
        before = len(self._lines)
        for statement in statements:
            self._statement(statement)
        if len(self._lines) == before:
            self._emit("pass")
        self._depth -= 1

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Expr(value=ast.Constant(value=str())) | ast.Assert() | ast.Pass():
                return
            case ast.Expr(value=ast.Call()):
                self._emit(self._call(node.value, as_statement=True).code)
            case ast.Assign():
                self._assign(node)
            case ast.AnnAssign(target=ast.Name(id=name), value=value) if value is not None:
                kind = KINDS.get(ast.unparse(node.annotation))
                if kind is not None and kind.is_scalar:
                    self._declare(name, kind, node)
                self._assign_to(node.target, self._expression(value), node)
            case ast.AugAssign():
                self._augment(node)
            case ast.If():
                self._if(node)
            case ast.While():
                if node.orelse:
                    self._fail(node, "a loop has no else")
                before = len(self._lines)
                test = self._scalar(node.test)
                if len(self._lines) != before:
                    self._fail(node.test, "the test of a loop cannot need temporaries")
                self._emit(f"while {test}:")
                self._block(node.body)
            case ast.For():
                self._for(node)
            case ast.Return():
                self._return(node)
            case ast.Continue():
                self._emit("continue")
            case ast.Break():
                self._emit("break")
            case _:
                self._fail(node, "no translation of this statement")

    def _if(self, node: ast.If, word: str = "if") -> None:
        before = len(self._lines)
        test = self._scalar(node.test)
        if word == "elif" and len(self._lines) != before:
            self._fail(node.test, "an elif cannot need temporaries")
        self._emit(f"{word} {test}:")
        self._block(node.body)
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            self._if(node.orelse[0], "elif")
        elif node.orelse:
            self._emit("else:")
            self._block(node.orelse)

    def _for(self, node: ast.For) -> None:
        if not isinstance(node.target, ast.Name) or node.orelse:
            self._fail(node, "a loop has one name and no else")
        name = node.target.id
        self._declare(name, INT, node)
        if isinstance(node.iter, ast.Call) and isinstance(node.iter.func, ast.Name) and node.iter.func.id == "range":
            bounds = ", ".join(self._scalar(bound) for bound in node.iter.args)
            self._emit(f"for {name} in range({bounds}):")
            self._block(node.body)
            return
        values = self._expression(node.iter)
        if values.kind.name != "vector" or not values.is_view:
            self._fail(node.iter, "a loop goes over a range or a list of the plan")
        counter = self._temporary("int64_t", "k")
        self._emit(f"for {counter} in range({self._length(node.iter, values)}):")
        self._depth += 1
        self._emit(f"{name} = {values.at(counter)}")
        self._depth -= 1
        self._block(node.body)

    def _return(self, node: ast.Return) -> None:
        function = self._function
        if node.value is None or (isinstance(node.value, ast.Constant) and node.value.value is None):
            self._emit("return")
        elif function.fills:
            self._fill("out", node.value, size_of(function.returns))
            self._emit("return")
        elif (choices := self._dispatch(node.value)) is not None:
            for number, code in enumerate(choices):
                self._emit(f"{'elif' if number else 'if'} {self._scalar(node.value.func.value.slice)} == {number}:")  # type: ignore[attr-defined]
                self._emit(f"    return {code}")
            self._emit("return False")
        elif isinstance(node.value, ast.Tuple):
            self._emit(f"return ({', '.join(self._scalar(item) for item in node.value.elts)})")
        else:
            value = self._expression(node.value)
            self._emit(f"return {value.code}")

    def _dispatch(self, node: ast.expr) -> list[str] | None:
        """The calls behind `TABLE[i].field(...)`, one for each row of a table of functions; None for anything else."""
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Subscript(value=ast.Name(id=table)), attr=field)):
                found = [self._known[getattr(row, field)] for row in self._globals[table]]
                return [self._call_code(function, node, None) for function in found]
        return None

    def _assign(self, node: ast.Assign) -> None:
        if len(node.targets) == 1 and isinstance(node.targets[0], ast.Tuple):
            self._unpack(node.targets[0], node.value, node)
            return
        if len(node.targets) > 1:
            value = self._expression(node.value)
            if value.kind.is_scalar:
                kept = Value(self._temporary(value.kind.c), value.kind)
                self._emit(f"{kept.code} = {value.code}")
                value = kept
            for target in node.targets:
                self._assign_to(target, value, node)
            return
        target = node.targets[0]
        if isinstance(target, ast.Name) and self._is_fresh(node.value):
            self._make(target.id, node.value, node)
            return
        self._assign_to(target, self._expression(node.value), node)

    def _is_fresh(self, node: ast.expr) -> bool:
        """Whether an expression makes a new array or struct, which a name can be."""
        if not isinstance(node, ast.Call):
            return False
        text = ast.unparse(node.func)
        if text in ("np.array", "np.empty", "np.zeros", "Observation") or text.endswith((".copy", ".hypothesis")):
            return True
        found = self._called(node)
        return found is not None and found.fills

    def _make(self, name: str, node: ast.expr, statement: ast.stmt) -> None:
        """`name = ` a new array or struct: on the stack."""
        assert isinstance(node, ast.Call)
        text = ast.unparse(node.func)
        if text == "Observation" or text.endswith(".hypothesis"):
            struct = "Observation" if text == "Observation" else "State"
            self._declare(name, Kind("struct", struct), statement)
            if struct == "State":
                assert isinstance(node.func, ast.Attribute)
                state = self._pointer(node.func.value)
                self._emit(f"{name} = hypothesis_of({state}, {self._scalar(node.args[0])})")
            return
        kind = self._shape(node)
        if name in self._locals:
            self._check_own(name, kind, statement)
            taken = self._temporary(f"double@[{size_of(kind)}]")
            self._fill(taken, node, size_of(kind))
            self._copy(name, taken, size_of(kind))
            return
        self._locals[name] = kind
        self._views.add(name)
        self._declared.append(f"{kind.of} {name}[{size_of(kind)}]")
        if text in ("np.empty", "np.zeros"):
            if text == "np.zeros":
                self._emit(f"memset({name}, 0, {size_of(kind)} * sizeof(double))")
            return
        self._fill(name, node, size_of(kind))

    def _shape(self, node: ast.Call) -> Kind:
        """What a call makes."""
        text = ast.unparse(node.func)
        if text in ("np.empty", "np.zeros"):
            (shape,) = node.args
            if isinstance(shape, ast.Tuple):
                rows, columns = (self._size(part) for part in shape.elts)
                return matrix(rows, columns)
            return vector(self._size(shape))
        if text == "np.array":
            (rows_of,) = node.args
            assert isinstance(rows_of, ast.List)
            if isinstance(rows_of.elts[0], ast.List):
                return matrix(str(len(rows_of.elts)), str(len(rows_of.elts[0].elts)))
            return vector(str(len(rows_of.elts)))
        if text.endswith(".copy"):
            assert isinstance(node.func, ast.Attribute)
            kind = self._expression(node.func.value).kind
            return matrix(kind.size, kind.columns) if kind.name == "matrix" else vector(kind.size)
        found = self._called(node)
        assert found is not None
        return found.returns

    def _fill(self, to: str, node: ast.expr, size: str) -> None:
        """Write a new array into memory that nothing else uses."""
        if isinstance(node, ast.Call):
            text = ast.unparse(node.func)
            if text == "np.array":
                (rows_of,) = node.args
                assert isinstance(rows_of, ast.List)
                cells = [cell for row in rows_of.elts for cell in (row.elts if isinstance(row, ast.List) else [row])]
                for number, cell in enumerate(cells):
                    self._emit(f"{to}[{number}] = {self._scalar(cell)}")
                return
            if text.endswith(".copy"):
                assert isinstance(node.func, ast.Attribute)
                self._fill(to, node.func.value, size)
                return
            found = self._called(node)
            if found is not None and found.fills:
                self._emit(self._call_code(found, node, to))
                return
        value = self._expression(node)
        if value.kind.name == "matrix" and value.is_view:
            self._copy(to, value.code, size)
        elif value.kind.name == "vector":
            index = self._index()
            self._emit(f"for {index} in range({size}):")
            self._emit(f"    {to}[{index}] = {value.at(index)}")
        else:
            self._fail(node, "this is no array")

    def _copy(self, to: str, source: str, size: str) -> None:
        self._emit(f"memcpy({to}, {source}, {size} * sizeof(double))")

    def _unpack(self, target: ast.Tuple, node: ast.expr, statement: ast.stmt) -> None:
        if isinstance(node, ast.Tuple) and len(node.elts) == len(target.elts):
            if any(self._is_fresh(item) for item in node.elts):
                for name, item in zip(target.elts, node.elts, strict=True):
                    if isinstance(name, ast.Name) and self._is_fresh(item):
                        self._make(name.id, item, statement)
                    else:
                        self._assign_to(name, self._expression(item), statement)
                return
            values = [self._expression(item) for item in node.elts]
            names = [item.id if isinstance(item, ast.Name) else "" for item in target.elts]
            if all(value.kind.is_scalar for value in values):
                for name, value in zip(names, values, strict=True):
                    if name:
                        self._declare(name, value.kind, statement)
                targets = ", ".join(self._target(item).code for item in target.elts)
                self._emit(f"{targets} = {', '.join(value.code for value in values)}")
                return
            if set(names) & {name.id for item in node.elts for name in ast.walk(item) if isinstance(name, ast.Name)}:
                self._fail(statement, "arrays cannot be exchanged")
            for item, value in zip(target.elts, values, strict=True):
                self._assign_to(item, value, statement)
            return
        value = self._expression(node)
        if value.kind.name == "tuple":
            kept = self._temporary(value.kind.c)
            self._emit(f"{kept} = {value.code}")
            for number, (item, kind) in enumerate(zip(target.elts, value.kind.items, strict=True)):
                self._assign_to(item, Value(f"{kept}[{number}]", kind), statement)
            return
        if value.kind.name == "vector" and all(isinstance(item, ast.Name) for item in target.elts):
            for number, item in enumerate(target.elts):
                scalar = FLOAT if value.kind.of == "double" else INT
                self._assign_to(item, Value(value.at(str(number)), scalar), statement)
            return
        self._fail(statement, "this cannot be unpacked")

    def _assign_to(self, target: ast.expr, value: Value, statement: ast.stmt) -> None:
        if isinstance(target, ast.Name):
            name = target.id
            if value.kind.is_scalar or value.kind.name == "pointer":
                self._declare(name, value.kind, statement)
                self._emit(f"{name} = {value.code}")
            elif value.is_view and name not in self._locals:
                self._locals[name] = value.kind
                self._views.add(name)
                self._aliases.add(name)
                source = statement.value if isinstance(statement, ast.Assign | ast.AnnAssign) else statement
                self._seen_elsewhere |= {part.id for part in ast.walk(source or statement) if isinstance(part, ast.Name)}
                self._declared.append(f"{value.kind.of}* {name}")
                self._emit(f"{name} = {value.code}")
            elif value.is_view and name in self._aliases and self._locals[name] == value.kind:
                self._emit(f"{name} = {value.code}")
            elif value.kind.name == "vector" and not value.is_view:
                self._keep_vector(name, value, statement)
            else:
                self._fail(statement, "a name is one thing only")
            return
        place = self._target(target)
        self._check_overlap(target, statement)
        if place.kind.is_scalar:
            self._emit(f"{place.code} = {value.code}")
        elif place.kind.name in ("vector", "matrix"):
            self._store(place, value, statement)
        else:
            self._fail(statement, "nothing can be assigned here")

    def _keep_vector(self, name: str, value: Value, statement: ast.stmt) -> None:
        """`name = ` a vector that is worked out: a new one, or the same again."""
        kind = vector(value.kind.size)
        if name not in self._locals:
            self._locals[name] = kind
            self._views.add(name)
            self._declared.append(f"double {name}[{kind.size}]")
        else:
            self._check_own(name, kind, statement)
        self._store(Value(name, kind, is_view=True), value, statement)

    def _check_own(self, name: str, kind: Kind, statement: ast.stmt) -> None:
        """An array can be made anew, in its own memory, where nothing else can see it."""
        if self._locals[name] != kind:
            self._fail(statement, f"{name} was something else before")
        if name in self._aliases or name in self._function.parameters or name in self._seen_elsewhere:
            self._fail(statement, f"{name} is not only this function's own array")

    def _check_overlap(self, target: ast.expr, statement: ast.stmt) -> None:
        """A part of a vector is written element by element: it must not be worked out from another part that it meets."""
        if not isinstance(target, ast.Subscript) or not isinstance(statement, ast.Assign | ast.AugAssign):
            return
        to = self._part(target)
        parts = list(_without_calls(statement.value))
        for part in (part for part in parts if isinstance(part, ast.Subscript)):
            if to is None or ast.unparse(part.value) != ast.unparse(target.value):
                continue
            by = self._part(part)
            if by is None or by == to:
                continue
            if not all(number.isdigit() for number in (*to, *by)) or (
                int(to[0]) < int(by[0]) + int(by[1]) and int(by[0]) < int(to[0]) + int(to[1])
            ):
                self._fail(statement, "these parts of one array may overlap")

    def _part(self, node: ast.Subscript) -> tuple[str, str] | None:
        """Begin and length where a node is a part of a vector."""
        if isinstance(node.slice, ast.Constant | ast.Tuple):
            return None
        owner = self._expression(node.value)
        return self._slice(node.slice, owner.kind.size) if owner.kind.name == "vector" else None

    def _store(self, place: Value, value: Value, statement: ast.stmt) -> None:
        """Element by element; a scalar goes into all of them."""
        size = place.kind.size or value.kind.size
        if place.kind.name == "matrix":
            if not value.kind.is_scalar:
                self._fail(statement, "a matrix is filled by a number only")
            flat = vector(f"{place.kind.size} * {place.kind.columns}")
            place = Value(place.code, flat, is_view=True)
            size = flat.size
        if not size:
            self._fail(statement, "how long is this?")
        index = self._index()
        code = self._kept(value) if value.kind.is_scalar else value.at(index)
        self._emit(f"for {index} in range({size}):")
        self._emit(f"    {place.at(index)} = {code}")

    def _augment(self, node: ast.AugAssign) -> None:
        sign = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}.get(type(node.op))
        if sign is None:
            self._fail(node, "no translation of this operator")
        place = self._target(node.target)
        self._check_overlap(node.target, node)
        if place.kind.is_scalar:
            value = self._number(node.value)
            if place.kind != FLOAT and (value.kind == FLOAT or sign == "/"):
                self._fail(node, "this makes a float of an int")
            self._emit(f"{place.code} {sign}= {value.code}")
            return
        scaled = node.value
        if (
            sign == "+"
            and isinstance(scaled, ast.BinOp)
            and isinstance(scaled.op, ast.Mult)
            and place.kind == vector("n")
            and (row := self._expression(scaled.right)).is_view
            and row.kind == vector("n")
        ):
            factor = self._scalar(scaled.left)
            self._emit(f"axpy({place.code}, {factor}, {row.code})")  # to += factor * row, in vector units
            return
        if place.kind.name == "matrix" and isinstance(scaled, ast.BinOp) and ast.unparse(scaled.left).endswith("[:, None]"):
            assert sign == "+" and isinstance(scaled.op, ast.Mult) and isinstance(scaled.left, ast.Subscript)
            column, row, index = self._expression(scaled.left.value), self._expression(scaled.right), self._index()
            self._emit(f"for {index} in range({place.kind.size}):")
            self._emit(f"    axpy({place.code} + {index} * {place.kind.columns}, {column.at(index)}, {row.code})")
            return
        value = self._expression(node.value)
        if place.kind.name != "vector" or not (value.kind.is_scalar or value.kind.name == "vector"):
            self._fail(node, "only vectors are added to like this")
        size = place.kind.size or value.kind.size
        if not size:
            self._fail(node, "how long is this?")
        index = self._index()
        code = self._kept(value) if value.kind.is_scalar else value.at(index)
        self._emit(f"for {index} in range({size}):")
        self._emit(f"    {place.at(index)} {sign}= {code}")

    def _declare(self, name: str, kind: Kind, node: ast.AST) -> None:
        known = self._locals.get(name)
        if known is None:
            self._locals[name] = kind
            if kind.name == "struct":
                self._views.add(name)
            self._declared.append(f"{kind.of if kind.name == 'struct' else kind.c} {name}")
        elif known != kind and not (known == FLOAT and kind == INT):
            self._fail(node, f"{name} is {known.name} and {kind.name}")

    def _temporary(self, c: str, word: str = "t") -> str:
        self._temporaries += 1
        name = f"_{word}{self._temporaries}"
        head, array, size = c.partition("@")
        self._declared.append(f"{head} {name}{size}" if array else f"{c} {name}")
        return name

    def _index(self) -> str:
        if "_i" not in self._locals:
            self._locals["_i"] = INT
            self._declared.append("int _i")
        return "_i"

    # --- Expressions

    def _scalar(self, node: ast.expr) -> str:
        return self._number(node).code

    def _number(self, node: ast.expr) -> Value:
        value = self._expression(node)
        if not value.kind.is_scalar:
            self._fail(node, f"this is a {value.kind.name}, not a number")
        return value

    def _index_of(self, node: ast.expr) -> str:
        """An index or a bound of a slice. In C a negative one is a place before the array."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            self._fail(node, "an index counts from the begin")
        value = self._number(node)
        if value.kind != INT:
            self._fail(node, f"this is a {value.kind.name}, not an index")
        return value.code

    def _pointer(self, node: ast.expr) -> str:
        value = self._expression(node)
        if value.kind.name == "struct":
            return f"&{value.code}"
        if value.kind.name == "pointer":
            return value.code
        self._fail(node, "this is no struct")

    def _target(self, node: ast.expr) -> Value:
        value = self._expression(node)
        if not (value.kind.is_scalar or value.is_view):
            self._fail(node, "nothing can be written here")
        return value

    def _constant(self, value: object, node: ast.expr) -> Value:
        if isinstance(value, bool):
            return Value(str(value), BOOL)
        if isinstance(value, enum.IntEnum):
            return Value(str(int(value)), INT)
        if isinstance(value, int):
            return Value(str(value) if abs(value) < 2**31 else f"(<int64_t>{value})", INT)
        if isinstance(value, float):
            if math.isinf(value):
                return Value("INFINITY" if value > 0 else "(-INFINITY)", FLOAT)
            return Value("NAN" if math.isnan(value) else repr(value), FLOAT)
        self._fail(node, f"no translation of a {type(value).__name__}")

    def _expression(self, node: ast.expr) -> Value:
        match node:
            case ast.Constant(value=value):
                return self._constant(value, node)
            case ast.Name(id=name):
                if name in self._locals:
                    return Value(name, self._locals[name], is_view=name in self._views)
                if name in self._globals:
                    return self._constant(self._globals[name], node)
                self._fail(node, "an unknown name")
            case ast.Attribute():
                return self._attribute(node)
            case ast.Subscript():
                return self._subscript(node)
            case ast.BinOp():
                return self._binary(node)
            case ast.UnaryOp():
                return self._unary(node)
            case ast.BoolOp(op=op, values=values):
                return self._both_or_either(" and " if isinstance(op, ast.And) else " or ", values)
            case ast.Compare():
                return self._compare(node)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return self._choice(test, body, orelse)
            case ast.Call():
                return self._call(node)
        self._fail(node, "no translation of this expression")

    def _both_or_either(self, word: str, nodes: list[ast.expr]) -> Value:
        codes: list[str] = []
        for node in nodes:
            before = len(self._lines)
            value = self._number(node)
            if value.kind != BOOL:
                self._fail(node, f"this is a {value.kind.name}, not true or false")
            if codes and len(self._lines) != before:
                self._fail(node, "what may not be worked out cannot need temporaries")
            codes.append(value.code)
        return Value(f"({word.join(codes)})", BOOL)

    def _choice(self, test: ast.expr, body: ast.expr, orelse: ast.expr) -> Value:
        if isinstance(orelse, ast.Constant) and orelse.value is None:
            value = self._expression(body)
            return Value(f"({value.code} if {self._scalar(test)} else NULL)", value.kind, is_view=True)
        before = len(self._lines)
        one, other = self._expression(body), self._expression(orelse)
        if len(self._lines) != before:
            self._fail(test, "what may not be worked out cannot need temporaries")
        if not (one.kind.is_scalar and other.kind.is_scalar):
            self._fail(test, "a choice is between numbers")
        kind = FLOAT if FLOAT in (one.kind, other.kind) else one.kind
        return Value(f"({one.code} if {self._scalar(test)} else {other.code})", kind)

    def _attribute(self, node: ast.Attribute) -> Value:
        try:
            found = eval(ast.unparse(node), dict(self._globals)) if self._root(node) not in self._locals else None
        except (NameError, AttributeError):
            found = None
        if found is not None:
            return self._constant(found, node)
        owner = self._expression(node.value)
        if owner.kind.name not in ("pointer", "struct"):
            self._fail(node, "only structs have fields")
        if owner.kind.of == "State" and node.attr == "size":
            return Value("n", INT)
        kind = FIELDS[owner.kind.of].get(node.attr)
        if kind is None:
            self._fail(node, f"{owner.kind.of} has no such field")
        return Value(f"{owner.code}.{node.attr}", kind, is_view=not kind.is_scalar)

    @staticmethod
    def _root(node: ast.expr) -> str:
        while isinstance(node, ast.Attribute):
            node = node.value
        return node.id if isinstance(node, ast.Name) else ""

    def _slice(self, node: ast.expr, total: str) -> tuple[str, str] | None:
        """Begin and length of a slice of `total` elements; None where the node is an index."""
        if isinstance(node, ast.Slice):
            if node.step is not None:
                self._fail(node, "a slice has no step")
            if node.lower is None and node.upper is None:
                return "0", total
            low = self._index_of(node.lower) if node.lower else "0"
            high = self._index_of(node.upper) if node.upper else ""
            if high and low.isdigit() and high.isdigit():
                return low, str(int(high) - int(low))
            return low, f"({high or total} - {low})"
        if isinstance(node, ast.Name | ast.Attribute) and self._root(node) not in self._locals:
            found = eval(ast.unparse(node), dict(self._globals))
            if isinstance(found, slice):
                return str(found.start), str(found.stop - found.start)
        return None

    def _subscript(self, node: ast.Subscript) -> Value:
        if isinstance(node.slice, ast.Constant) and isinstance(node.slice.value, str):
            row = self._expression(node.value)
            kind = FIELDS[row.kind.of][node.slice.value]
            return Value(f"{bracketed(row.code)}.{node.slice.value}", kind, is_view=not kind.is_scalar)
        if self._root(node.value) not in self._locals and isinstance(node.value, ast.Name):
            table = self._globals.get(node.value.id)
            if isinstance(table, tuple) and isinstance(node.slice, ast.Constant):
                return self._constant(table[node.slice.value], node)
            if isinstance(table, tuple) and all(isinstance(item, float) for item in table):
                return Value(f"{node.value.id}[{self._scalar(node.slice)}]", FLOAT)
        owner = self._expression(node.value)
        kind = owner.kind
        if kind.name == "pointer" and kind.size == "rows":
            return Value(f"({owner.code} + {self._index_of(node.slice)})", Kind("pointer", kind.of), is_view=True)
        if not owner.is_view:
            self._fail(node, "an element of what is no view")
        scalar = FLOAT if kind.of == "double" else INT
        if kind.name == "vector":
            part = self._slice(node.slice, kind.size)
            if part is None:
                return Value(owner.at(self._index_of(node.slice)), scalar)
            begin, length = part
            if kind.stride != "1":
                self._fail(node, "a part of a column has no translation")
            code = owner.code if begin == "0" else f"{owner.code} + {begin}"
            return Value(code, vector(length or kind.size, kind.of, kind.stride), is_view=True)
        if isinstance(node.slice, ast.Tuple):
            first, second = node.slice.elts
            rows, columns = self._slice(first, kind.size), self._slice(second, kind.columns)
            if rows is None and columns is None:
                row, column = self._index_of(first), self._index_of(second)
                return Value(f"{bracketed(owner.code)}[({row}) * {kind.columns} + {column}]", scalar)
            if rows is None and columns is not None:
                begin, length = columns
                code = f"{owner.code} + ({self._index_of(first)}) * {kind.columns}" + (f" + {begin}" if begin != "0" else "")
                return Value(code, vector(length or kind.columns, kind.of), is_view=True)
            if rows is not None and columns is None:
                code = f"{owner.code} + {self._index_of(second)}" + (
                    f" + ({rows[0]}) * {kind.columns}" if rows[0] != "0" else ""
                )
                return Value(code, vector(rows[1] or kind.size, kind.of, kind.columns), is_view=True)
            self._fail(node, "a block of a matrix has no translation: use loops")
        rows = self._slice(node.slice, kind.size)
        if rows == ("0", kind.size):
            return owner
        if rows is not None:
            self._fail(node, "rows of a matrix have no translation: use loops")
        row = self._index_of(node.slice)
        return Value(f"{owner.code} + ({row}) * {kind.columns}", vector(kind.columns, kind.of), is_view=True)

    def _binary(self, node: ast.BinOp) -> Value:
        sign = {
            ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.BitAnd: "&", ast.BitOr: "|",
        }.get(type(node.op))  # fmt: skip
        if sign is None:
            self._fail(node, "no translation of this operator")
        left, right = self._expression(node.left), self._expression(node.right)
        if left.kind.is_scalar and right.kind.is_scalar:
            if sign == "/" and FLOAT not in (left.kind, right.kind):
                left = Value(f"<double>{left.code}", FLOAT)
            kind = FLOAT if FLOAT in (left.kind, right.kind) or sign == "/" else INT
            return Value(f"({left.code} {sign} {right.code})", kind)
        parts = []
        size = ""
        for part in (left, right):
            if part.kind.is_scalar:
                parts.append(self._kept(part))
            elif part.kind.name == "vector":
                parts.append(part.at("@"))
                size = size or part.kind.size
            else:
                self._fail(node, "no arithmetic with this")
        return Value(f"({parts[0]} {sign} {parts[1]})", vector(size))

    def _kept(self, value: Value) -> str:
        """A number that is the same for all elements of a vector, worked out once, before any of them is written."""
        if value.code.replace("_", "").replace(".", "").isalnum():
            return value.code
        kept = self._temporary(value.kind.c)
        self._emit(f"{kept} = {value.code}")
        return kept

    def _unary(self, node: ast.UnaryOp) -> Value:
        value = self._expression(node.operand)
        if isinstance(node.op, ast.Not):
            return Value(f"(not {value.code})", BOOL)
        sign = {ast.USub: "-", ast.Invert: "~"}.get(type(node.op))
        if sign is None:
            self._fail(node, "no translation of this operator")
        if value.kind.is_scalar:
            return Value(f"({sign}{value.code})", value.kind)
        return Value(f"({sign}{value.at('@')})", vector(value.kind.size))

    def _compare(self, node: ast.Compare) -> Value:
        signs = {
            ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
        }  # fmt: skip
        if isinstance(node.ops[0], ast.Is | ast.IsNot):
            sign = "==" if isinstance(node.ops[0], ast.Is) else "!="
            return Value(f"({self._expression(node.left).code} {sign} NULL)", BOOL)
        if isinstance(node.ops[0], ast.In | ast.NotIn):
            (choices,) = node.comparators
            assert isinstance(choices, ast.Tuple)
            left = self._scalar(node.left)
            is_in = isinstance(node.ops[0], ast.In)
            parts = [f"{left} {'==' if is_in else '!='} {self._scalar(choice)}" for choice in choices.elts]
            return Value(f"({(' or ' if is_in else ' and ').join(parts)})", BOOL)
        code = self._scalar(node.left)
        for operator, right in zip(node.ops, node.comparators, strict=True):
            code += f" {signs[type(operator)]} {self._scalar(right)}"
        return Value(f"({code})", BOOL)

    def _length(self, node: ast.expr, value: Value) -> str:
        if isinstance(node, ast.Attribute) and node.attr in COUNTED:
            return f"{value.code}_count"
        if not value.kind.size:
            self._fail(node, "how long is this?")
        return value.kind.size

    def _size(self, node: ast.expr) -> str:
        return self._scalar(node)

    def _called(self, node: ast.Call) -> Function | None:
        if not isinstance(node.func, ast.Name | ast.Attribute) or self._root(node.func) in self._locals:
            return None
        try:
            found = eval(ast.unparse(node.func), dict(self._globals))
        except (NameError, AttributeError):
            return None
        return self._known.get(found) if isinstance(found, FunctionType) else None

    def _call(self, node: ast.Call, as_statement: bool = False) -> Value:
        text = ast.unparse(node.func)
        if text in ("float", "int", "bool"):
            (inner,) = node.args
            kind = KINDS[text]
            return Value(f"(<{kind.c}>{bracketed(self._scalar(inner))})", kind)
        if text in ("max", "min"):
            values = [self._expression(argument) for argument in node.args]
            kind = FLOAT if FLOAT in (values[0].kind, values[1].kind) else values[0].kind
            one, other = (self._kept(value) for value in values)
            return Value(f"({other} if {other} {'>' if text == 'max' else '<'} {one} else {one})", kind)
        if text == "abs":
            value = self._expression(node.args[0])
            return Value(f"fabs({value.code})" if value.kind == FLOAT else f"labs({value.code})", value.kind)
        if text == "len":
            (inner,) = node.args
            return Value(self._length(inner, self._expression(inner)), INT)
        if text.startswith("math.") and text[5:] in MATHS:
            name, kind = MATHS[text[5:]]
            return Value(f"{name}({', '.join(self._scalar(argument) for argument in node.args)})", kind)
        found = self._called(node)
        if found is None:
            if text.split(".")[-1] == "clear" and as_statement and isinstance(node.func, ast.Attribute):
                return Value(f"clear_state({self._pointer(node.func.value)})", NONE)
            self._fail(node, "no translation of this call")
        if found.fills:
            kind = found.returns
            kept = self._temporary(f"double@[{size_of(kind)}]")
            self._emit(self._call_code(found, node, kept))
            return Value(kept, kind, is_view=True)
        return Value(self._call_code(found, node, None), found.returns)

    def _call_code(self, found: Function, node: ast.Call, out: str | None) -> str:
        given = list(node.args)
        names = list(found.parameters)
        for keyword in node.keywords:
            assert keyword.arg == names[len(given)], "keywords in their order only"
            given.append(keyword.value)
        defaults = found.tree.args.defaults
        while len(given) < len(names):
            given.append(defaults[len(given) - len(names)])
        codes = []
        for argument, kind in zip(given, found.parameters.values(), strict=True):
            value = self._expression(argument)
            if kind.name == "pointer":
                codes.append("NULL" if value.code == "None" else self._pointer(argument))
            elif kind.is_scalar or (value.is_view and value.kind.stride == "1"):
                codes.append(value.code)
            elif value.kind.name == "vector":
                kept = self._temporary(f"double@[{value.kind.size}]")
                index = self._index()
                self._emit(f"for {index} in range({value.kind.size}):")
                self._emit(f"    {kept}[{index}] = {value.at(index)}")
                codes.append(kept)
            else:
                self._fail(argument, "this cannot be handed over")
        return f"{found.c_name}({', '.join([*codes, *([out] if out else [])])})"


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
    for struct in ("Noise", "Observation", "Row", "State", "Plan"):
        lines.append(f"cdef struct {struct}:")
        for name, kind in FIELDS[struct].items():
            if struct == "Row" and name in ("source", "outcome"):
                lines.append(f"    int32_t {name}")
            elif kind.is_scalar or kind.name == "struct" or (struct in ("State", "Plan") and name != "gates"):
                lines.append(f"    {kind.c} {name}")
            elif name == "jacobian":  # models name columns that only the wide state has
                lines.append(f"    {kind.of} {name}[2 * n + WIDE_SIZE]")
            else:
                lines.append(f"    {kind.of} {name}[{size_of(kind)}]")
            if struct == "Plan" and name in COUNTED:
                lines.append(f"    int64_t {name}_count")
        lines.append("")
    scalars = [name for name, kind in FIELDS["Plan"].items() if kind.is_scalar]
    lines += ["", "cdef int load_scalars(Plan* loaded, plan) except -1:", '    """The numbers of a fusiond.filter.Plan."""']
    lines += [f"    loaded.{name} = plan.{name}" for name in scalars]
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


def main(arguments: list[str]) -> int:
    stale = [path for path, text in made().items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    if "--check" in arguments:
        for path in stale:
            print(f"{path.relative_to(ROOT)} is not current: run python tools/translate_kernel.py", file=sys.stderr)
        return 1 if stale else 0
    for path, text in made().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main(sys.argv[1:]))
