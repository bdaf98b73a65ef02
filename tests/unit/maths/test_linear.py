"""Sums in a fixed order, and matrices made symmetric."""

from __future__ import annotations

import math

import numpy as np

from fusiond.maths.linear import dot, mirror


def test_dot_sums_from_the_first_element_on() -> None:
    """Any other order of these gives another number: the ones are lost next to the large ones, or not."""
    a, b = np.array([1e16, 1.0, -1e16, 1.0]), np.ones(4)
    assert dot(a, b) == 1.0
    assert dot(a[::-1], b) == 0.0
    assert math.fsum(a) == 2.0


def test_dot_against_exact_sums() -> None:
    rng = np.random.default_rng(1)
    for size in (1, 18, 27):
        a, b = rng.integers(-1000, 1000, (2, size))
        assert dot(a.astype(float), b.astype(float)) == int(sum(x * y for x, y in zip(a.tolist(), b.tolist(), strict=True)))


def test_mirror_lets_the_upper_triangle_decide() -> None:
    p = np.arange(16.0).reshape(4, 4)
    mirror(p)
    assert p.tolist() == [[0, 1, 2, 3], [1, 5, 6, 7], [2, 6, 10, 11], [3, 7, 11, 15]]


def test_mirror_works_in_place_on_a_view() -> None:
    whole = np.random.default_rng(2).normal(size=1 + 18 * 18)
    before = whole.copy()
    mirror(whole[1:].reshape(18, 18))
    upper = np.triu(before[1:].reshape(18, 18))
    np.testing.assert_array_equal(whole[1:].reshape(18, 18), upper + np.triu(upper, 1).T)
    assert whole[0] == before[0]
