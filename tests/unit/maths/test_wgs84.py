"""The ellipsoid: round trips everywhere, published values of gravity, axes that are at right angles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.maths.wgs84 import (
    EARTH_RATE,
    SEMI_MAJOR,
    SEMI_MINOR,
    earth_rate_n,
    ecef,
    geodetic,
    geodetic_trig,
    gravity,
    gravity_e,
    mat_ne,
    radii,
)

ROUNDING = 4e-9  # m: the last place of an earth-fixed coordinate is worth 0.93e-9
HEIGHTS = (-1000.0, 0.0, 8848.0, 100_000.0)
LATITUDES = (-90.0, -89.9999999, -60.0, -1e-9, 0.0, 1e-7, 45.0, 89.99, 90.0)  # deg
LONGITUDES = (-180.0, -179.9999999, -90.0, 0.0, 1e-9, 90.0, 179.9999999, 180.0)  # deg


@pytest.mark.parametrize("height", HEIGHTS)
@pytest.mark.parametrize("latitude", LATITUDES)
@pytest.mark.parametrize("longitude", LONGITUDES)
def test_round_trip(latitude: float, longitude: float, height: float) -> None:
    place = ecef(math.radians(latitude), math.radians(longitude), height)
    found = geodetic(place)
    assert np.linalg.norm(ecef(*found) - place) < ROUNDING
    assert found[0] == pytest.approx(math.radians(latitude), abs=3e-16)
    assert found[2] == pytest.approx(height, abs=ROUNDING)
    if abs(latitude) < 89.0:
        turn = (found[1] - math.radians(longitude)) % (2 * math.pi)
        assert min(turn, 2 * math.pi - turn) < 1e-15


def test_round_trip_of_random_places() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5000):
        place = ecef(math.asin(rng.uniform(-1, 1)), rng.uniform(-math.pi, math.pi), rng.uniform(-1e3, 1e5))
        assert np.linalg.norm(ecef(*geodetic(place)) - place) < ROUNDING


def test_known_places() -> None:
    np.testing.assert_allclose(ecef(0.0, 0.0, 0.0), [SEMI_MAJOR, 0.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(ecef(0.0, math.pi / 2, 10.0), [0.0, SEMI_MAJOR + 10.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(ecef(math.pi / 2, 1.0, 5.0), [0.0, 0.0, SEMI_MINOR + 5.0], atol=ROUNDING)
    assert pytest.approx(6356752.3142, abs=5e-5) == SEMI_MINOR  # NIMA TR8350.2, table 3.3
    assert geodetic(np.array([0.0, 0.0, -SEMI_MINOR])) == (-math.pi / 2, 0.0, 0.0)


def test_radii() -> None:
    meridian, transverse = radii(0.0)
    assert (meridian, transverse) == (pytest.approx(SEMI_MINOR**2 / SEMI_MAJOR), pytest.approx(SEMI_MAJOR))
    meridian, transverse = radii(math.pi / 2)
    assert meridian == pytest.approx(transverse) == pytest.approx(SEMI_MAJOR**2 / SEMI_MINOR)


@pytest.mark.parametrize(
    ("latitude", "surface"),
    [(0.0, 9.7803253359), (90.0, 9.8321849378), (45.0, 9.80619777)],  # NIMA TR8350.2, 3-13 to 3-15, and Somigliana's
)
def test_gravity_at_the_surface(latitude: float, surface: float) -> None:
    assert gravity(math.radians(latitude), 0.0) == pytest.approx(surface, abs=6e-9)


def test_gravity_falls_with_height() -> None:
    for latitude in (0.0, 0.8, -1.5):
        fall = (gravity(latitude, 100.0) - gravity(latitude, -100.0)) / 200
        assert fall == pytest.approx(-3.086e-6, rel=2e-3)  # free-air gradient [1/s^2]
    assert gravity(0.8, 100_000.0) == pytest.approx(gravity(0.8, 0.0) * (6371 / 6471) ** 2, rel=3e-4)


def test_gravity_vector_points_down() -> None:
    for latitude, longitude, height in ((0.3, 2.0, 50.0), (-1.2, -3.0, 9000.0), (math.pi / 2, 0.0, 0.0)):
        place = ecef(latitude, longitude, height)
        down = mat_ne(place) @ gravity_e(place)
        np.testing.assert_allclose(down, [0.0, 0.0, gravity(latitude, height)], atol=1e-14)


def test_navigation_axes_are_orthonormal() -> None:
    rng = np.random.default_rng(2)
    places = [ecef(rng.uniform(-1.57, 1.57), rng.uniform(-3.2, 3.2), 100.0) for _ in range(200)]
    places += [np.array([0.0, 0.0, 6.4e6]), np.array([1e-3, 0.0, -6.4e6]), np.array([-6.4e6, -1e-9, 0.0])]
    for place in places:
        axes = mat_ne(place)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=5e-16)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        sin_lat, cos_lat, sin_lon, cos_lon = geodetic_trig(*place.tolist())
        assert sin_lat**2 + cos_lat**2 == pytest.approx(1.0, abs=1e-15)
        assert sin_lon**2 + cos_lon**2 == pytest.approx(1.0, abs=1e-15)


def test_axes_point_where_they_are_named_for() -> None:
    place = ecef(0.7, -2.0, 0.0)
    for axis, (north, east, height) in zip(mat_ne(place), [(1e-6, 0, 0), (0, 1e-6, 0), (0, 0, -1.0)], strict=True):
        there = ecef(0.7 + north, -2.0 + east, height)
        assert axis @ (there - place) == pytest.approx(np.linalg.norm(there - place), rel=1e-6)


def test_earth_rate() -> None:
    for latitude in (0.0, 0.6, -1.4):
        axes = mat_ne(ecef(latitude, 1.0, 0.0))
        np.testing.assert_allclose(earth_rate_n(latitude), axes @ [0.0, 0.0, EARTH_RATE], atol=1e-19)
