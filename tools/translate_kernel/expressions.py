"""An expression of one function: its code in C, and what it is."""

from __future__ import annotations

import ast
import enum
import math
from dataclasses import dataclass
from types import FunctionType
from typing import NoReturn

from tools.translate_kernel.functions import Function, UntranslatableError
from tools.translate_kernel.kinds import BOOL, COUNTED, FIELDS, FLOAT, INT, KINDS, NONE, Kind, size_of, vector

MATHS = {
    "sqrt": ("sqrt", FLOAT),
    "floor": ("floor", FLOAT),
    "ceil": ("ceil", FLOAT),
    "isfinite": ("isfinite", BOOL),
    "isnan": ("isnan", BOOL),
    "ldexp": ("ldexp", FLOAT),
    "copysign": ("copysign", FLOAT),
}


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


def bracketed(code: str) -> str:
    return code if code.replace("_", "").replace(".", "").isalnum() else f"({code})"


class Expressions:
    """The expressions of one function. Working one out may need lines before it, and names of its own."""

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

    def _fail(self, node: ast.AST, reason: str) -> NoReturn:
        where = f"{self._function.module.__name__}:{getattr(node, 'lineno', '?')}"
        raise UntranslatableError(f"{where}: {self._function.call.__name__}: {reason}: {ast.unparse(node)}")

    def _emit(self, line: str) -> None:
        self._lines.append("    " * self._depth + line)

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
