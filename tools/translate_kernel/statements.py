"""The body of one function: its statements, in C."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from tools.translate_kernel.expressions import Expressions, Value
from tools.translate_kernel.kinds import FLOAT, INT, KINDS, Kind, matrix, size_of, vector


def _without_calls(node: ast.expr) -> Iterator[ast.expr]:
    """The expressions of an expression, but not those handed to a function: what that returns is apart."""
    yield node
    if not isinstance(node, ast.Call):
        for part in ast.iter_child_nodes(node):
            if isinstance(part, ast.expr):
                yield from _without_calls(part)


class Translation(Expressions):
    """The body of one function."""

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
            self._fail(node.iter, "a loop goes over a range or a list of the parameters")
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
