"""The translator of the kernel: what it makes of small functions, and what it refuses, by module, line and reason."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from tools.translate_kernel import __main__ as command
from tools.translate_kernel import files, functions
from tools.translate_kernel.functions import UntranslatableError

HEAD = """\
import math
from enum import IntEnum
import numpy as np
from fusiond.filter.observations.model import Observation
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import Row
from fusiond.filter.state import FilterState
from fusiond.maths.typed import Covariance, ErrorVector, Matrix3, Quaternion, Stamps, Vector, Vector3, compiled
PART, PLACE, FACTOR, TABLE = slice(3, 6), 7, 0.1, (0.5, 0.25)
class Reason(IntEnum):
    LOST = 4
"""
FIRST_LINE = HEAD.count("\n") + 1  # of the function that follows
Translate = Callable[[str], str]


@pytest.fixture
def translate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Translate:
    """The translation of functions in a module of their own, called `small`."""

    def translated(source: str) -> str:
        text = HEAD + textwrap.dedent(source).lstrip("\n")
        (tmp_path / "small.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, "small", raising=False)
        monkeypatch.setattr(functions, "modules", lambda: iter([("small", text)]))
        return files.bodies().partition("small\n\n")[2].strip()

    yield translated
    sys.modules.pop("small", None)


def same(found: str, expected: str) -> None:
    assert found == textwrap.dedent(expected).strip()


def test_numbers(translate: Translate) -> None:
    found = translate("""
        @compiled
        def share(count: int, total: float) -> float:
            '''Docstrings go.'''
            rest = count / 3
            if count > 0 and not total < FACTOR:
                rest -= float(count)
            elif count == Reason.LOST:
                return math.inf
            return max(rest, total) if count < 9 else -math.sqrt(abs(rest))
        """)
    same(
        found,
        """
        cdef double small_share(int64_t count, double total) noexcept nogil:
            cdef double rest
            rest = (<double>count / 3)
            if ((count > 0) and (not (total < 0.1))):
                rest -= (<double>count)
            elif (count == 4):
                return INFINITY
            return ((total if total > rest else rest) if (count < 9) else (-sqrt(fabs(rest))))
        """,
    )


def test_vectors_are_worked_out_element_by_element_into_memory_of_their_own(translate: Translate) -> None:
    found = translate("""
        @compiled
        def ahead(place: Vector3, velocity: Vector3, dt: float) -> Vector3:
            moved = place + velocity * (dt / 2)
            moved[0] = 0.0
            return moved
        """)
    same(
        found,
        """
        cdef void small_ahead(double* place, double* velocity, double dt, double* out) noexcept nogil:
            cdef double _t1
            cdef double moved[3]
            cdef int _i
            _t1 = (dt / 2)
            for _i in range(3):
                moved[_i] = (place[_i] + (velocity[_i] * _t1))
            moved[0] = 0.0
            for _i in range(3):
                out[_i] = moved[_i]
            return
        """,
    )


def test_a_number_is_read_before_a_vector_is_written(translate: Translate) -> None:
    """`v / v[0]` divides by the first element as it was."""
    found = translate("""
        @compiled
        def scale(v: Vector3) -> None:
            v /= v[0]
        """)
    same(
        found,
        """
        cdef void small_scale(double* v) noexcept nogil:
            cdef int _i
            cdef double _t1
            _t1 = v[0]
            for _i in range(3):
                v[_i] /= _t1
        """,
    )


def test_slices_rows_and_columns_are_views(translate: Translate) -> None:
    found = translate("""
        @compiled
        def use(state: FilterState, p: Covariance, i: int) -> float:
            velocity = state.nominal[PART]
            velocity[1] += 1.0
            row = p[i]
            column = p[:, PLACE]
            p[i, PART] = 0.0
            return row[2] + column[i] + p[i, i + 1]
        """)
    same(
        found,
        """
        cdef double small_use(State* state, double* p, int64_t i) noexcept nogil:
            cdef double* velocity
            cdef double* row
            cdef double* column
            cdef int _i
            velocity = state.nominal + 3
            velocity[1] += 1.0
            row = p + (i) * n
            column = p + 7
            for _i in range(3):
                (p + (i) * n + 3)[_i] = 0.0
            return ((row[2] + column[i * n]) + p[(i) * n + (i + 1)])
        """,
    )


def test_matrices_and_calls(translate: Translate) -> None:
    found = translate("""
        @compiled
        def turn(m: Matrix3, v: Vector3) -> Vector3:
            return np.array([m[0, 0] * v[0], m[1, 1] * v[1], 0.0])

        @compiled
        def twice(m: Matrix3, v: Vector3) -> float:
            kept = m.copy()
            zeros = np.zeros((3, 3))
            return turn(kept, turn(zeros, v))[2]
        """)
    same(
        found.partition("\n\n")[2],
        """
        cdef double small_twice(double* m, double* v) noexcept nogil:
            cdef double kept[3 * 3]
            cdef double zeros[3 * 3]
            cdef double _t1[3]
            cdef double _t2[3]
            memcpy(kept, m, 3 * 3 * sizeof(double))
            memset(zeros, 0, 3 * 3 * sizeof(double))
            small_turn(zeros, v, _t2)
            small_turn(kept, _t2, _t1)
            return _t1[2]
        """,
    )


def test_tuples(translate: Translate) -> None:
    found = translate("""
        @compiled
        def pair(a: float, b: float) -> tuple[float, bool]:
            a, b = b, a
            return a, a < b

        @compiled
        def first(v: Quaternion) -> float:
            w, x, y, z = v
            larger, swapped = pair(w, x)
            return larger + y + z if swapped else TABLE[1]
        """)
    same(
        found,
        """
        cdef (double, bint) small_pair(double a, double b) noexcept nogil:
            a, b = b, a
            return (a, (a < b))

        cdef double small_first(double* v) noexcept nogil:
            cdef double w
            cdef double x
            cdef double y
            cdef double z
            cdef (double, bint) _t1
            cdef double larger
            cdef bint swapped
            w = v[0]
            x = v[1]
            y = v[2]
            z = v[3]
            _t1 = small_pair(w, x)
            larger = _t1[0]
            swapped = _t1[1]
            return (((larger + y) + z) if swapped else 0.25)
        """,
    )


def test_loops(translate: Translate) -> None:
    found = translate("""
        @compiled
        def count(stamps: Stamps, params: Parameters, state: FilterState) -> int:
            total = 0
            for source in params.wheels:
                if stamps[source] < 0:
                    continue
                total += stamps[source]
            for i in range(state.size - 1, -1, -1):
                total += i
            while total > 10:
                total -= 1
                if total == 20:
                    break
            return total
        """)
    same(
        found,
        """
        cdef int64_t small_count(int64_t* stamps, Parameters* params, State* state) noexcept nogil:
            cdef int64_t total
            cdef int64_t source
            cdef int64_t _k1
            cdef int64_t i
            total = 0
            for _k1 in range(params.wheels_count):
                source = params.wheels[_k1]
                if (stamps[source] < 0):
                    continue
                total += stamps[source]
            for i in range((n - 1), (-1), (-1)):
                total += i
            while (total > 10):
                total -= 1
                if (total == 20):
                    break
            return total
        """,
    )


def test_structs_and_rows(translate: Translate) -> None:
    found = translate("""
        @compiled
        def fill(state: FilterState, row: Row, following: Row | None) -> int:
            seen = Observation(state.size)
            seen.m = 1
            seen.innovation[0] = row["values"][PLACE]
            seen.jacobian[0, PART] = state.nominal[PART] * 2.0
            hypothesis = state.hypothesis(4)
            hypothesis.nominal[0] += 1.0
            row["ratio"] = 0.0 if following is None else following["ratio"]
            return int(row["t_ns"])
        """)
    same(
        found,
        """
        cdef int64_t small_fill(State* state, Row* row, Row* following) noexcept nogil:
            cdef Observation seen
            cdef int _i
            cdef State hypothesis
            seen.m = 1
            seen.innovation[0] = row.values[7]
            for _i in range(3):
                (seen.jacobian + (0) * n + 3)[_i] = ((state.nominal + 3)[_i] * 2.0)
            hypothesis = hypothesis_of(state, 4)
            hypothesis.nominal[0] += 1.0
            row.ratio = (0.0 if (following == NULL) else following.ratio)
            return (<int64_t>row.t_ns)
        """,
    )


def test_rows_of_the_covariance_go_in_vector_units(translate: Translate) -> None:
    found = translate("""
        @compiled
        def grow(p: Covariance, gain: ErrorVector, kept: ErrorVector) -> None:
            p[2] += gain[1] * p[3]
            p += gain[:, None] * kept
        """)
    same(
        found,
        """
        cdef void small_grow(double* p, double* gain, double* kept) noexcept nogil:
            cdef int _i
            axpy(p + (2) * n, gain[1], p + (3) * n)
            for _i in range(n):
                axpy(p + _i * n, gain[_i], kept)
        """,
    )


REFUSED = {
    "a block of a matrix": ("x = p[0:3, 0:3]", "a block of a matrix has no translation"),
    "rows of a matrix": ("p[0:3] = 0.0", "rows of a matrix have no translation"),
    "an unknown call": ("x = np.linalg.norm(v)", "no translation of this call"),
    "a function that is not marked": ("helper(v)", "no translation of this call"),
    "an unknown name": ("x = missing", "an unknown name"),
    "an unknown field": ("x = state.speed", "State has no such field"),
    "a number that becomes a float": ("k = 1\n    k = 0.5", "k is int and float"),
    "a number that is added to": ("k = 1\n    k += 0.5", "this makes a float of an int"),
    "a number that is divided": ("k = 1\n    k /= 2", "this makes a float of an int"),
    "a number that becomes a vector": ("x = 1.0\n    x = v + v", "x was something else before"),
    "a vector of another length": ("x = v + v\n    x = np.zeros(4)", "x was something else before"),
    "a vector that becomes a number": ("x = v + v\n    x = 1.0", "x is vector and float"),
    "a parameter made anew": ("v = v + v", "v is not only this function's own array"),
    "a parameter made anew by a call": ("v = v.copy()", "v is not only this function's own array"),
    "a view made anew": ("x = p[2, 0:3]\n    x = x + v", "x is not only this function's own array"),
    "an array that a view is of": ("x = v + v\n    y = x[0:3]\n    x = v + y", "x is not only this function's own array"),
    "views exchanged": ("x = p[0]\n    y = p[1]\n    x, y = y, x", "arrays cannot be exchanged"),
    "parts that overlap": ("v[0:2] = v[1:3] * 2.0", "these parts of one array may overlap"),
    "parts that may overlap": ("v[0:2] += v[i : i + 2] * 2.0", "these parts of one array may overlap"),
    "a dictionary": ("x = {1: 2}", "no translation of this expression"),
    "a list that grows": ("x = []\n    x.append(1)", "no translation of this expression"),
    "a comprehension": ("x = [k for k in range(3)]", "no translation of this expression"),
    "a string": ("x = 'text'", "no translation of a str"),
    "a power": ("x = i**2", "no translation of this operator"),
    "a remainder": ("x = i % 2", "no translation of this operator"),
    "a vector as a condition": ("if v:\n        return", "this is a vector, not a number"),
    "numbers joined by or": ("x = i or 1", "this is a int, not true or false"),
    "an index from the end": ("x = v[-1]", "an index counts from the begin"),
    "a slice to the end but one": ("x = v[0:-1]", "an index counts from the begin"),
    "a slice with a step": ("x = v[0:3:2]", "a slice has no step"),
    "a part of a column": ("x = p[:, 1][1:2]", "a part of a column has no translation"),
    "a float as an index": ("x = v[0.0]", "this is a float, not an index"),
    "a matrix added to": ("p += p", "only vectors are added to like this"),
    "a sum of matrices": ("p[0] = (p + p)[0]", "no arithmetic with this"),
    "a matrix assigned": ("p[:] = p", "a matrix is filled by a number only"),
    "a vector of no known length": ("values *= 2.0", "how long is this?"),
    "a loop over a vector": ("for x in v * 2.0:\n        pass", "a loop goes over a range or a list of the parameters"),
    "a loop with two names": ("for a, b in params.wheels:\n        pass", "a loop has one name and no else"),
    "for and else": ("for k in range(3):\n        pass\n    else:\n        pass", "a loop has one name and no else"),
    "while and else": ("while i > 0:\n        break\n    else:\n        pass", "a loop has no else"),
    "an exception": ("raise ValueError", "no translation of this statement"),
    "a context": ("with open('x'):\n        pass", "no translation of this statement"),
    "a function in a function": ("def inner() -> None:\n        pass", "no translation of this statement"),
    "a temporary that a loop tests": ("while double(v)[0] > 0:\n        pass", "the test of a loop cannot need temporaries"),
    "a temporary of an elif": (
        "if i > 0:\n        pass\n    elif double(v)[0] > 0:\n        pass",
        "an elif cannot need temporaries",
    ),
    "a temporary behind and": ("x = i > 0 and double(v)[0] > 0", "what may not be worked out cannot need temporaries"),
    "a temporary of a choice": ("x = double(v)[0] if i > 0 else 0.0", "what may not be worked out cannot need temporaries"),
    "a choice of vectors": ("x = v if i > 0 else v", "a choice is between numbers"),
}


@pytest.mark.parametrize(("body", "reason"), REFUSED.values(), ids=REFUSED)
def test_what_has_no_translation(translate: Translate, body: str, reason: str) -> None:
    source = (
        "@compiled\ndef double(v: Vector3) -> Vector3:\n    return v * 2.0\n"
        "def helper(v: Vector3) -> None:\n    pass\n"
        "@compiled\ndef use(state: FilterState, params: Parameters, p: Covariance, v: Vector3, values: Vector, i: int)"
        " -> None:\n"
        f"    {body}\n"
    )
    with pytest.raises(UntranslatableError) as refused:
        translate(source)
    where, function, rest = str(refused.value).split(": ", 2)
    module, _, line = where.partition(":")
    assert (module, function) == ("small", "use")
    body_line = FIRST_LINE + 7
    assert body_line <= int(line) < body_line + 1 + body.count("\n")
    assert rest.startswith(reason)


@pytest.mark.parametrize(
    ("signature", "type_"),
    [
        ("x: dict", "dict"),
        ("x", ""),
        ("x: list[float]", "list[float]"),
        ("x: float) -> tuple[Vector3, float]:  # (", "tuple[Vector3, float]"),
    ],
)
def test_types_that_have_no_translation(translate: Translate, signature: str, type_: str) -> None:
    source = f"@compiled\ndef use({signature}) -> None:\n    pass\n" if "->" not in signature else (
        f"@compiled\ndef use({signature}\n    return np.zeros(3), x\n"
    )  # fmt: skip
    with pytest.raises(UntranslatableError) as refused:
        translate(source)
    assert str(refused.value) == f"small:{FIRST_LINE + 1}: use: no translation of the type '{type_}'"


def test_check_tells_which_file_is_not_current(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "ROOT", tmp_path)
    made = {tmp_path / "layout.pxi": "sizes", tmp_path / "functions.pxi": "bodies"}
    monkeypatch.setattr(command, "made", lambda: made)
    assert command.main(["--check"]) == 1  # neither is there
    assert list(tmp_path.iterdir()) == []
    assert command.main([]) == 0
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"layout.pxi": "sizes", "functions.pxi": "bodies"}
    capsys.readouterr()
    assert command.main(["--check"]) == 0
    (tmp_path / "functions.pxi").write_text("edited")
    assert command.main(["--check"]) == 1
    assert capsys.readouterr().err == "functions.pxi is not current: run python -m tools.translate_kernel\n"
