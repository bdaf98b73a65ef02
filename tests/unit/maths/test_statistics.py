"""The chi-square quantile against tables, closed forms and its own ends."""

from __future__ import annotations

import math

import pytest

from fusiond.maths.statistics import chi_square


@pytest.mark.parametrize(
    ("probability", "freedom", "table"),
    [
        (0.95, 1, 3.841459),
        (0.95, 2, 5.991465),
        (0.95, 3, 7.814728),
        (0.999, 1, 10.827566),
        (0.999, 2, 13.815511),
        (0.999, 3, 16.266236),
        (0.5, 1, 0.454936),
        (0.99, 10, 23.209251),
        (0.999999, 3, 30.664848),
    ],
)
def test_chi_square_against_tables(probability: float, freedom: int, table: float) -> None:
    assert chi_square(probability, freedom) == pytest.approx(table, rel=1e-6)


def test_chi_square_at_the_ends() -> None:
    assert chi_square(1e-12, 2) == pytest.approx(2e-12, rel=1e-3)
    assert 70 < chi_square(1 - 1e-16, 2) < 1000  # as near to 1 as a number gets
    for probability in (0.01, 0.5, 0.9999):  # two degrees have a closed form
        assert chi_square(probability, 2) == pytest.approx(-2 * math.log1p(-probability), rel=1e-12)
