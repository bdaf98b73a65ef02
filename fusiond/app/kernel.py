"""Tells users where the filter runs without its compiled kernel."""

from __future__ import annotations

from fusiond.filter.kernel.interpreted import compiled_available


def slow_kernel() -> str | None:
    """What to tell the user where the compiled kernel was not built; otherwise None.

    The factor was measured with the bundled drive, which has 100 inertial samples and 400 wheel readings a second: its 150 s
    took 179 s in the interpreter, and 4.3 s compiled.
    """
    if compiled_available():
        return None
    return (
        "the filter's compiled kernel was not built, so it runs in Python's interpreter: the same results, about 40 times"
        " slower, too slow for most vehicles live. Install a C compiler, then fusiond again"
    )
