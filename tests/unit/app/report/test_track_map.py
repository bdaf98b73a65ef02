"""The map's projections."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("bokeh", reason="needs the extra report")

from fusiond.app.report.track_map import Projection

OSLO = (59.91, 10.75, 0.0)


def test_a_plain_grid_has_metres() -> None:
    projection = Projection(OSLO, mercator=False)
    points = np.array([3.0, -4.0]), np.array([0.5, 1e5])
    assert projection.stretch == 1.0
    assert all((made == given).all() for made, given in zip(projection(points), points, strict=True))


def test_tiles_have_web_mercator() -> None:
    """EPSG:3857's own example in its terms: x = a lon, y = a ln tan(45 deg + lat / 2); a metre is 1 / cos(lat) long."""
    projection = Projection(OSLO, mercator=True)
    x, y = projection((np.zeros(1), np.zeros(1)))
    assert x[0] == pytest.approx(1_196_684.5, abs=0.1) and y[0] == pytest.approx(8_379_937.0, abs=60_000)
    east, north = projection((np.array([100.0]), np.array([100.0])))
    stretch = 1 / math.cos(math.radians(59.91))
    assert projection.stretch == pytest.approx(stretch)
    assert [east[0] - x[0], north[0] - y[0]] == pytest.approx([100 * stretch, 100 * stretch], rel=0.006)
