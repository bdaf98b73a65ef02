"""Comparison with the truth: figures against NumPy's, and the 95 % ellipse."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.app.replay.comparison import Comparison, Errors, Window, errors_of
from fusiond.app.replay.truth import TruthSample
from fusiond.estimator.solution import Mode, Solution
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import OutcomeCounts
from fusiond.units import SECOND
from tests.helpers.published import message

HERE = TruthSample(0, 48.0, 11.0, 500.0, 1.0, 2.0, 90.0)
M_PER_DEG_NORTH, M_PER_DEG_EAST = 111199.05, 74631.19  # at 48 N, 500 m, by the radii of WGS-84


def test_a_state_is_inside_its_ellipse_by_its_own_covariance() -> None:
    state = message().state
    assert state is not None
    for sigmas, inside in ((2.44, True), (2.46, False)):  # sqrt(5.99) = 2.448
        for north, east in ((3.0, 0.0), (0.0, 4.0)):
            lat, lon = 48.0 - north * sigmas / M_PER_DEG_NORTH, 11.0 - east * sigmas / M_PER_DEG_EAST
            errors = errors_of(message(), HERE._replace(lat_deg=lat, lon_deg=lon))
            assert errors is not None
            assert (errors.north_m, errors.east_m) == pytest.approx((north * sigmas, east * sigmas), rel=1e-3, abs=1e-6)
            assert errors.inside is inside


def test_nothing_is_compared_without_state_or_truth() -> None:
    assert errors_of(message(), None) is None
    aligning = state_message(Solution(0, Mode.ALIGNING, None, 0, None), "car", OutcomeCounts())
    assert errors_of(aligning, HERE) is None
    assert Comparison().report() is None


@pytest.mark.parametrize("offset_deg", [0.9, 179.8])
def test_comparison_gives_numpys_figures(offset_deg: float) -> None:
    random = np.random.default_rng(3)
    n = 400
    north, east = random.normal(0.3, 0.2, n), random.normal(-0.1, 0.1, n)
    height, speed, yaw = random.normal(1.0, 0.5, n), np.abs(random.normal(0, 0.1, n)), random.normal(0, 0.5, n)
    nees = random.chisquare(2, n)
    comparison = Comparison(Window(1.0, 3.0))
    for k in range(n):
        wrapped = (float(yaw[k]) + offset_deg + 180) % 360 - 180
        true = HERE._replace(lat_deg=48.0 + k * 1e-5)
        errors = Errors(*map(float, (north[k], east[k], height[k], speed[k])), wrapped, float(nees[k]), true)
        comparison.add(k * SECOND // 100, errors)
    found = comparison.report()
    assert found is not None
    here = slice(100, 301)
    horizontal = np.hypot(north, east)[here]
    centred = np.hypot(north[here] - north[here].mean(), east[here] - east[here].mean())
    assert (found.rows, found.start_s, found.stop_s) == (201, 1.0, 3.0)
    assert found.distance_m == pytest.approx(222.39814, rel=1e-6)  # from 48 to 48.002 deg: the integral of M + height
    assert found.position.rmse_m == pytest.approx(np.sqrt(np.mean(horizontal**2)))
    assert found.position.rmse_offset_removed_m == pytest.approx(np.sqrt(np.mean(centred**2)))
    assert found.position.p95_m == pytest.approx(np.quantile(horizontal, 0.95, method="inverted_cdf"), abs=6e-4)
    assert found.position.p68_m == pytest.approx(np.quantile(horizontal, 0.68, method="inverted_cdf"), abs=6e-4)
    assert found.velocity_p68_mps == pytest.approx(np.quantile(speed[here], 0.68, method="inverted_cdf"), abs=6e-4)
    assert found.position.max_m == horizontal.max()
    assert found.position.end_m == horizontal[-1]
    assert found.position.inside_95 == pytest.approx((nees[here] <= 5.991).mean())
    assert found.position.nees == pytest.approx(nees[here].mean())
    assert found.height_rmse_m == pytest.approx(np.sqrt(np.mean(height[here] ** 2)))
    assert found.velocity_rmse_mps == pytest.approx(np.sqrt(np.mean(speed[here] ** 2)))
    turned = yaw[here] - yaw[here].mean()
    assert found.heading.rmse_deg == pytest.approx(turned.std(), rel=1e-6)
    assert found.heading.p95_deg == pytest.approx(np.quantile(np.abs(turned), 0.95, method="inverted_cdf"), abs=2e-3)
    assert found.heading.p68_deg == pytest.approx(np.quantile(np.abs(turned), 0.68, method="inverted_cdf"), abs=2e-3)
    assert found.pitch is None  # the truth has none
    off = (found.heading.offset_deg - offset_deg - yaw[here].mean() + 180) % 360 - 180
    assert off == pytest.approx(0.0, abs=1e-9)


def test_pitch_and_roll_are_compared_where_the_truth_has_them() -> None:
    state = message().state
    assert state is not None
    for pitch, roll, told in ((1.0, -2.0, True), (0.0, 0.0, False)):  # zeros: a track that does not tell
        comparison = Comparison()
        for k in range(10):
            errors = errors_of(message(), HERE._replace(pitch_deg=pitch + 0.1 * k if told else 0.0, roll_deg=roll))
            assert errors is not None
            comparison.add(k * SECOND, errors)
        found = comparison.report()
        assert found is not None
        assert (found.pitch is not None, found.roll is not None) == (told, told)
        if found.pitch and found.roll:
            assert found.pitch.offset_deg == pytest.approx(state.pitch_deg - 1.45)
            assert found.pitch.rmse_deg == pytest.approx(np.std(0.1 * np.arange(10)))
            assert found.roll.offset_deg == pytest.approx(state.roll_deg + 2.0)
            assert found.roll.rmse_deg == pytest.approx(0.0, abs=1e-9)
