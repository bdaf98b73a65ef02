"""Units of time: whole nanoseconds, rounded to the nearest."""

from __future__ import annotations

from fusiond.units import MICROSECOND, MILLISECOND, SECOND, nanoseconds


def test_units_make_up_a_second() -> None:
    assert 10**9 == SECOND == 1000 * MILLISECOND == 10**6 * MICROSECOND


def test_seconds_are_rounded_to_whole_nanoseconds() -> None:
    assert nanoseconds(0.1) == 100_000_000
    assert nanoseconds(-1.5e-9) == -2
    assert isinstance(nanoseconds(2), int)
