"""Makes the compiled kernel's source out of the filter's own: typed Python functions in, Cython out.

    python -m tools.translate_kernel            write the generated files of fusiond/filter/kernel
    python -m tools.translate_kernel --check    exit with 1 where one of them is not what would be written

The filter's functions that run for every event are written once, in Python, in fusiond/maths and fusiond/filter; the
interpreter runs them as they are. Here the same functions become C-level Cython: the same operations in the same order, so
both give the same bits. What may stand in such a function is small on purpose:

    int, float, bool     a scalar
    Vector3 and its like a fixed number of floats: `mat_eb[i, j]`, `x[POSITION_E]`, `rates * dt + rest`, element by element
    views                a slice, a row or a column of an array is a view, as in NumPy: a pointer here
    np.array, np.empty, np.zeros, .copy()   memory of a constant size, on the stack here
    FilterState, Parameters, Row, Observation, ProcessNoise   the structs of FIELDS in kinds.py
    if, while, for over range, a call of another such function, and math's functions

A function that returns an array writes it where its caller says. Anything else is an error that names the line. A module's
constants (numbers, slices, enumerations) are put in as numbers, so that none stands twice.
"""

from __future__ import annotations

import sys

from tools.translate_kernel.files import made
from tools.translate_kernel.functions import ROOT


def main(arguments: list[str]) -> int:
    stale = [path for path, text in made().items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    if "--check" in arguments:
        for path in stale:
            print(f"{path.relative_to(ROOT)} is not current: run python -m tools.translate_kernel", file=sys.stderr)
        return 1 if stale else 0
    for path, text in made().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
