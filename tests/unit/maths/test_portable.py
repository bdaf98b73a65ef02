"""The elementary functions: within 2 units in the last place of the C library's, and exact where that can be asked."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.maths.portable import HALF_PI_HIGH, HALF_PI_LOW, asin, atan2, exp, log, sin_cos, square

CASES = 20_000


def ulps(ours: float, theirs: float) -> float:
    return abs(ours - theirs) / math.ulp(theirs)


@pytest.mark.parametrize("reach", [1e-8, 0.1, math.pi, 100.0, 1e5])
def test_sine_and_cosine(reach: float) -> None:
    for x in np.random.default_rng(1).uniform(-reach, reach, CASES):
        sine, cosine = sin_cos(float(x))
        assert ulps(sine, math.sin(x)) <= 2
        assert ulps(cosine, math.cos(x)) <= 2


def test_sine_and_cosine_of_special_angles() -> None:
    assert sin_cos(0.0) == (0.0, 1.0)
    for turns in range(-9, 10):
        sine, cosine = sin_cos(turns * math.pi / 2)
        assert sine == pytest.approx((0.0, 1.0, 0.0, -1.0)[turns % 4], abs=1e-15)
        assert cosine == pytest.approx((1.0, 0.0, -1.0, 0.0)[turns % 4], abs=1e-15)
    for x in (math.inf, -math.inf, math.nan):
        assert all(math.isnan(value) for value in sin_cos(x))


@pytest.mark.parametrize("decades", [0, 3, 100])
def test_arc_tangent(decades: int) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (CASES, 2)) * 10.0 ** rng.uniform(-decades, decades, (CASES, 2))
    for y, x in points.tolist():
        assert ulps(atan2(y, x), math.atan2(y, x)) <= 2


def test_arc_tangent_of_special_points() -> None:
    quarter = HALF_PI_HIGH + HALF_PI_LOW
    assert quarter == math.pi / 2
    for y, x in [(0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (1.0, 1.0), (-1.0, -1.0), (1e-300, -1.0), (0.0, 0.0)]:
        assert atan2(y, x) == math.atan2(y, x)


def test_arc_sine() -> None:
    for x in np.random.default_rng(3).uniform(-1, 1, CASES).tolist():
        assert asin(x) == pytest.approx(math.asin(x), rel=1e-15)
    assert (asin(1.0), asin(-1.0), asin(0.0)) == (math.pi / 2, -math.pi / 2, 0.0)
    assert (asin(1.0000001), asin(-2.0)) == (math.pi / 2, -math.pi / 2)


@pytest.mark.parametrize("reach", [1e-9, 1.0, 700.0])
def test_exponential(reach: float) -> None:
    for x in np.random.default_rng(4).uniform(-reach, reach, CASES).tolist():
        assert ulps(exp(x), math.exp(x)) <= 2


def test_exponential_of_special_values() -> None:
    assert (exp(0.0), exp(-701.0), exp(-math.inf)) == (1.0, 0.0, 0.0)
    assert exp(701.0) == exp(math.inf) == math.inf
    assert math.isnan(exp(math.nan))


@pytest.mark.parametrize("decades", [1e-12, 1e-3, 1.0, 300.0])
def test_logarithm(decades: float) -> None:
    for power in np.random.default_rng(6).uniform(-decades, decades, CASES).tolist():
        x = 10.0**power
        assert ulps(log(x), math.log(x)) <= 2


def test_logarithm_of_special_values() -> None:
    assert (log(1.0), log(math.inf), log(0.0), log(-0.0)) == (0.0, math.inf, -math.inf, -math.inf)
    assert log(5e-324) == pytest.approx(math.log(5e-324), rel=1e-15)
    assert log(2.0**40) == pytest.approx(40 * math.log(2.0), rel=1e-15)
    assert math.isnan(log(-1.0))
    assert math.isnan(log(math.nan))
    assert math.isnan(log(-math.inf))


def test_square_is_rounded_once() -> None:
    for x in np.random.default_rng(5).uniform(0, 3, CASES).tolist():
        assert square(x) == float(np.multiply(x, x))
