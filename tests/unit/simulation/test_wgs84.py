"""The Earth for whole arrays agrees with that of the filter."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.maths import wgs84 as earth
from fusiond.simulation import wgs84


def test_vector_earth_agrees_with_the_filters() -> None:
    latitude, height = np.radians([-80.0, -30.0, 0.0, 48.0, 89.0]), np.array([0.0, 100.0, 9000.0, -50.0, 560.0])
    meridian, transverse = wgs84.radii(latitude)
    for k, (lat, h) in enumerate(zip(latitude.tolist(), height.tolist(), strict=True)):
        assert (meridian[k], transverse[k]) == pytest.approx(earth.radii(lat), rel=1e-14)
        assert wgs84.gravity(latitude, height)[k] == pytest.approx(earth.gravity(lat, h), rel=1e-14)
        assert wgs84.earth_rate_n(latitude)[k] == pytest.approx(earth.earth_rate_n(lat), abs=1e-18)
