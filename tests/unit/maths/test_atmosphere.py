"""The standard atmosphere against its published tables."""

from __future__ import annotations

import pytest

from fusiond.maths.atmosphere import LAYERS, geometric_height, geopotential_height, pressure_altitude

ICAO = {  # geopotential height [m]: pressure [Pa], ICAO Doc 7488/3, tables
    -500: 107_478.0,
    0: 101_325.0,
    1_000: 89_874.6,
    5_000: 54_019.9,
    11_000: 22_632.0,
    15_000: 12_044.5,
    20_000: 5_474.87,
    25_000: 2_511.01,
}


@pytest.mark.parametrize(("height", "at"), ICAO.items())
def test_the_standard_atmosphere(height: float, at: float) -> None:
    assert pressure_altitude(at) == pytest.approx(height, abs=0.3)


def test_the_layers_meet() -> None:
    for base, height, *_ in LAYERS[1:]:
        for factor in (1 - 1e-9, 1.0, 1 + 1e-9):
            assert pressure_altitude(base * factor) == pytest.approx(height, abs=0.01)
    assert pressure_altitude(LAYERS[0][0]) == 0.0


@pytest.mark.parametrize(("geometric", "geopotential"), [(0.0, 0.0), (1_000.0, 999.843), (11_019.07, 11_000.0)])
def test_geometric_and_geopotential_heights(geometric: float, geopotential: float) -> None:
    """The last pair is the tropopause as the tables have it; gravity falls off by 1.6e-4 in a kilometre."""
    assert geopotential_height(geometric) == pytest.approx(geopotential, abs=0.01)
    assert geometric_height(geopotential) == pytest.approx(geometric, abs=0.01)
