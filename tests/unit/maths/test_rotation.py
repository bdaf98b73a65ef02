"""Rotations: every representation against the others, and the series near zero against the closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.maths.rotation import (
    cross,
    euler,
    matrix,
    matrix_from_euler,
    matrix_product,
    normalised,
    product,
    quaternion,
    quaternion_exp,
    quaternion_multiply,
    skew,
    times,
    transposed_times,
)
from fusiond.maths.typed import Array

RNG = np.random.default_rng(1)
VECTORS = [RNG.normal(0.0, size, 3) for size in (1e-9, 1e-5, 1e-4, 1e-3, 0.3, 1.0) for _ in range(20)]


def exponential(rotation: Array) -> Array:
    """Rotation matrix of a rotation vector, by its power series."""
    term = total = np.eye(3)
    for k in range(1, 60):
        term = term @ skew(rotation) / k
        total = total + term
    return total


def test_skew_is_the_cross_product() -> None:
    a, b = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))


@pytest.mark.parametrize("vector", VECTORS)
def test_exponential(vector: Array) -> None:
    q = quaternion_exp(vector)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=3e-16)
    np.testing.assert_allclose(matrix(q), exponential(vector), atol=2e-15)


def test_exponential_has_no_step_where_the_series_ends() -> None:
    axis = np.array([0.6, 0.0, 0.8])
    below, above = (quaternion_exp(axis * 1e-4 * factor) for factor in (1 - 1e-9, 1 + 1e-9))
    np.testing.assert_allclose(below[1:] / (1 - 1e-9), above[1:] / (1 + 1e-9), rtol=4e-16)
    assert below[0] == pytest.approx(above[0], abs=2e-16)


def test_product_of_quaternions_is_that_of_matrices() -> None:
    a, b = (quaternion_exp(v) for v in RNG.normal(size=(2, 3)))
    np.testing.assert_allclose(matrix(quaternion_multiply(a, b)), matrix(a) @ matrix(b), atol=1e-15)


def test_quaternion_of_matrix() -> None:
    turns = [np.zeros(3), *VECTORS, *(math.pi * axis for axis in np.eye(3)), *RNG.normal(0.0, 2.0, (200, 3))]
    for vector in turns:  # half turns about each axis take every branch
        q = quaternion(matrix(quaternion_exp(vector)))
        assert q[0] >= 0
        assert np.linalg.norm(q) == pytest.approx(1.0)
        np.testing.assert_allclose(matrix(q), matrix(quaternion_exp(vector)), atol=1e-15)


@pytest.mark.parametrize("axis", np.eye(3))
@pytest.mark.parametrize("angle", [-3.0, -2.0, -0.3, 1e-9, 0.3, 2.0, 3.0, math.pi])
def test_quaternion_is_half_the_angle_about_the_axis(axis: Array, angle: float) -> None:
    """Rodrigues' formula makes the matrix; each axis and a large angle take the largest part of the quaternion elsewhere."""
    cosine, sine = math.cos(angle), math.sin(angle)
    a, b, c = axis
    across = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    turned = np.eye(3) + sine * across + (1 - cosine) * across @ across
    expected = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])
    np.testing.assert_allclose(quaternion(turned), expected, atol=1e-15)


def test_products_of_three() -> None:
    """By their sums, written out; on views too, which are what the filter hands over."""
    room = np.random.default_rng(2).normal(size=(4, 9))
    for a, b in ((room[0].reshape(3, 3), room[1].reshape(3, 3)), (room[2].reshape(3, 3).T, room[3].reshape(3, 3).T)):
        v = b[1]
        rows = range(3)
        assert times(a, v) == pytest.approx([sum(a[i, k] * v[k] for k in rows) for i in rows], rel=1e-14)
        assert transposed_times(a, v) == pytest.approx([sum(a[k, i] * v[k] for k in rows) for i in rows], rel=1e-14)
        expected = [[sum(a[i, k] * b[k, j] for k in rows) for j in rows] for i in rows]
        np.testing.assert_allclose(matrix_product(a, b), expected, rtol=1e-13)


def test_cross_product() -> None:
    forward, right, down = np.eye(3)
    for one, other, third in ((forward, right, down), (right, down, forward), (down, forward, right)):
        assert cross(one, other).tolist() == third.tolist()
        assert cross(other, one).tolist() == (-third).tolist()
    a, b = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=1e-14)


def test_euler_angles() -> None:
    for roll, pitch, yaw in RNG.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (300, 3)):
        np.testing.assert_allclose(euler(matrix_from_euler(roll, pitch, yaw)), (roll, pitch, yaw), atol=1e-13)
    north, east = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(matrix_from_euler(0.0, 0.0, math.pi / 2) @ north, east, atol=1e-15)
    np.testing.assert_allclose(matrix_from_euler(0.0, 0.1, 0.0) @ north, [math.cos(0.1), 0.0, -math.sin(0.1)])
    np.testing.assert_allclose(matrix_from_euler(0.1, 0.0, 0.0) @ east, [0.0, math.cos(0.1), math.sin(0.1)])


def test_normalised() -> None:
    np.testing.assert_allclose(normalised(np.array([2.0, 0.0, 0.0, -2.0])), [math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)])


def test_product() -> None:
    a, b, v = RNG.normal(size=(4, 3)), RNG.normal(size=(3, 5)), RNG.normal(size=3)
    np.testing.assert_allclose(product(a, b), a @ b, atol=1e-15)
    np.testing.assert_allclose(product(a, v), a @ v, atol=1e-15)
