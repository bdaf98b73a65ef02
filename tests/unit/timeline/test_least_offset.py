"""The line under noisy offsets: it never lies above a point, follows drift, forgets old points and does not grow."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusiond.timeline.least_offset import BUCKETS, MAX_DRIFT, OffsetFloor
from fusiond.units import MILLISECOND as MS
from fusiond.units import SECOND


def test_the_least_offset_counts_at_once() -> None:
    floor = OffsetFloor(0, 9 * MS)
    assert floor.at(0) == 9 * MS
    floor.add(SECOND // 10, 4 * MS)
    floor.add(SECOND // 5, 30 * MS)
    assert floor.at(SECOND // 5) == floor.at(-SECOND) == 4 * MS


@given(st.lists(st.tuples(st.integers(0, 3 * SECOND), st.integers(-SECOND, SECOND)), min_size=1, max_size=60))
def test_the_line_never_lies_above_the_newest_point(points: list[tuple[int, int]]) -> None:
    x = 0
    floor = OffsetFloor(x, points[0][1])
    for elapsed, y in points:
        x += elapsed
        floor.add(x, y)
        assert floor.at(x) <= y
        assert abs(floor.slope) <= MAX_DRIFT


@pytest.mark.parametrize("drift_ppm", [0, 50, -50])
def test_drift_is_found_under_noise(drift_ppm: int) -> None:
    rng = random.Random(1)
    floor = OffsetFloor(0, 0)
    for x in range(0, 300 * SECOND, SECOND // 20):
        floor.add(x, x * drift_ppm // 10**6 + round(rng.expovariate(1 / (5 * MS))))
    assert floor.slope / 1e3 == pytest.approx(drift_ppm, abs=2.0)
    assert floor.at(300 * SECOND) == pytest.approx(300 * SECOND * drift_ppm // 10**6, abs=MS // 5)


def test_an_offset_that_rises_is_followed_after_a_window() -> None:
    floor = OffsetFloor(0, 0)
    for x in range(0, 4_000 * SECOND, SECOND):
        floor.add(x, 0 if x < 1_000 * SECOND else 10 * MS)
    assert floor.at(4_000 * SECOND) == 10 * MS


def test_an_earlier_point_counts_as_the_newest() -> None:
    floor = OffsetFloor(10 * SECOND, 0)
    floor.add(SECOND, -MS)
    assert floor.at(10 * SECOND) == -MS


def test_the_window_does_not_grow() -> None:
    floor = OffsetFloor(0, 0)
    for x in range(0, 3_000 * SECOND, SECOND // 4):
        floor.add(x, x % 7)
        assert len(floor._points) <= BUCKETS
