"""Comparison with the truth, and the summary: figures against NumPy's, bad truth files, the text a reader gets."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from fusiond.app.replay import summary as report
from fusiond.app.replay.comparison import (
    Comparison,
    Errors,
    Histogram,
    Truth,
    TruthError,
    TruthRow,
    Window,
    displacement,
    errors_of,
    parse_truth,
)
from fusiond.estimator.solution import Estimate, Mode, StateEstimate
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import OutcomeCounts, StateMessage

SECOND = 10**9
HEADER = "unix_us,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg"
ROW = "1000000,48.0,11.0,500.0,1.0,2.0,0.0,0.1,0.2,90.0"
HERE = TruthRow(0, 48.0, 11.0, 500.0, 1.0, 2.0, 90.0)


def message(
    second: float = 0.0, mode: Mode = Mode.NOMINAL, speed: float = 0.0, sigma: tuple[float, float, float] = (3.0, 4.0, 5.0)
) -> StateMessage:
    """A state at 48 N 11 E that goes north, with uncorrelated position errors."""
    state = StateEstimate(
        latitude=math.radians(48.0),
        longitude=math.radians(11.0),
        height=500.0,
        velocity_n=(speed, 0.0, 0.0),
        quaternion_nb=(1.0, 0.0, 0.0, 0.0),
        angular_rate_b=(0.0, 0.0, 0.0),
        acceleration_b=(0.0, 0.0, -9.8),
        gyro_bias=(0.0, 0.0, 0.0),
        accel_bias=(0.0, 0.0, 0.0),
        wheel_scale=0.0,
        mount=(0.0, 0.0),
        covariance=np.diag(np.square([*sigma, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01])),
        sigma_gyro_bias=(0.0, 0.0, 0.0),
        sigma_accel_bias=(0.0, 0.0, 0.0),
        sigma_wheel_scale=0.0,
        sigma_mount=(0.0, 0.0),
    )
    return state_message(Estimate(round(second * SECOND), mode, 0, 0, state), "car", OutcomeCounts())


# --- The truth file


def test_truth_rows_are_read_by_column_name() -> None:
    (row,) = parse_truth([HEADER + "\n", ROW + "\n", "\n"], "truth.csv")
    assert row == TruthRow(SECOND, 48.0, 11.0, 500.0, 1.0, 2.0, 90.0)
    shuffled = ["yaw_deg,ve_mps,vn_mps,height_m,lon_deg,lat_deg,unix_us", "90,2,1,500,11,48,1000000"]
    assert next(parse_truth(shuffled, "truth.csv")) == row


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ([], "t.csv:1: no column unix_us"),
        (["unix_us,lat_deg", "1,2"], "t.csv:1: no column lon_deg, height_m"),
        ([HEADER], "t.csv: no rows"),
        ([HEADER, "1000000,48.0"], "t.csv:2: 2 cells where the header has 10 columns"),
        ([HEADER, ROW, ROW.replace("48.0", "x")], "t.csv:3: lat_deg: 'x' is not a number"),
        ([HEADER, ROW.replace("48.0", "")], "t.csv:2: lat_deg: '' is not a number"),
        ([HEADER, ROW.replace("500.0", "nan")], "t.csv:2: height_m: nan is out of range"),
        ([HEADER, ROW.replace("48.0", "91")], "t.csv:2: lat_deg: 91 is out of range"),
        ([HEADER, ROW.replace("1000000", "1e6")], "t.csv:2: unix_us: '1e6' is not a whole number"),
        ([HEADER, ROW, ROW], "t.csv:3: unix_us does not rise"),
    ],
)
def test_bad_truth_is_told_by_line_and_column(lines: list[str], complaint: str) -> None:
    with pytest.raises(TruthError) as caught:
        list(parse_truth(lines, "t.csv"))
    assert complaint in str(caught.value)


def test_truth_is_interpolated_with_angles_the_short_way_round() -> None:
    rows = [HERE._replace(yaw_deg=170.0, lon_deg=179.9999), HERE._replace(t_ns=SECOND, yaw_deg=-170.0, lon_deg=-179.9999)]
    truth = Truth(rows)
    middle = truth.at(SECOND // 2)
    assert middle is not None
    assert middle.yaw_deg == pytest.approx(180.0)
    assert middle.lon_deg == pytest.approx(180.0)
    assert truth.at(SECOND) == rows[1]
    assert truth.at(SECOND + 1) is None


def test_truth_is_not_interpolated_outside_or_across_a_hole() -> None:
    truth = Truth([HERE._replace(t_ns=SECOND), HERE._replace(t_ns=4 * SECOND)])
    assert [truth.at(t) is None for t in (0, SECOND, 2 * SECOND, 4 * SECOND)] == [True, False, True, False]


# --- The figures


def test_histogram_quantiles_are_numpys_within_half_a_bin() -> None:
    values = np.random.default_rng(1).normal(2.0, 1.0, 5000)
    histogram = Histogram(0.01, 10.0)
    for value in values:
        histogram.add(float(value))
    for share in (0.01, 0.5, 0.95):
        expected = np.quantile(values, share, method="inverted_cdf")
        assert histogram.quantile(share) == pytest.approx(expected, abs=0.0051)
    distances = np.quantile(np.abs(values - 2.0), 0.95, method="inverted_cdf")
    assert histogram.quantile_of_distance(0.95, 2.0) == pytest.approx(distances, abs=0.0101)


def test_histogram_is_bounded_and_exact_at_its_ends() -> None:
    histogram = Histogram(1.0, 10.0)
    for value in (-1e9, 0.25, 1e9):
        histogram.add(value)
    assert (histogram.least, histogram.greatest, histogram.count) == (-1e9, 1e9, 3)
    assert abs(histogram.quantile(1.0)) <= 11
    with pytest.raises(ValueError, match="no value"):
        Histogram(1.0, 10.0).quantile(0.5)


def test_displacement_is_metres_on_the_ellipsoid() -> None:
    north, east = displacement(48.001, 11.001, (48.0, 11.0), 0.0)
    assert north == pytest.approx(111.2, abs=0.1)  # a thousandth of a degree of the meridian at 48 N
    assert east == pytest.approx(74.63, abs=0.05)
    assert displacement(0.0, -179.9999, (0.0, 179.9999), 0.0)[1] == pytest.approx(22.26, abs=0.01)


def test_a_state_is_inside_its_ellipse_by_its_own_covariance() -> None:
    state = message().state
    assert state is not None
    for sigmas, inside in ((2.44, True), (2.46, False)):  # sqrt(5.99) = 2.448
        for north, east in ((3.0, 0.0), (0.0, 4.0)):
            lat = 48.0 - north * sigmas / displacement(49.0, 11.0, (48.0, 11.0), 500.0)[0]
            lon = 11.0 - east * sigmas / displacement(48.0, 12.0, (48.0, 11.0), 500.0)[1]
            errors = errors_of(message(), HERE._replace(lat_deg=lat, lon_deg=lon))
            assert errors is not None
            assert (errors.north_m, errors.east_m) == pytest.approx((north * sigmas, east * sigmas), rel=1e-3, abs=1e-6)
            assert errors.inside is inside


def test_nothing_is_compared_without_state_or_truth() -> None:
    assert errors_of(message(), None) is None
    aligning = state_message(Estimate(0, Mode.ALIGNING, None, 0, None), "car", OutcomeCounts())
    assert errors_of(aligning, HERE) is None
    assert Comparison().report() is None


@pytest.mark.parametrize("offset_deg", [0.9, 179.8])
def test_comparison_gives_numpys_figures(offset_deg: float) -> None:
    random = np.random.default_rng(3)
    n = 400
    north, east = random.normal(0.3, 0.2, n), random.normal(-0.1, 0.1, n)
    height, speed, yaw = random.normal(1.0, 0.5, n), np.abs(random.normal(0, 0.1, n)), random.normal(0, 0.5, n)
    inside = random.random(n) < 0.9
    comparison = Comparison(Window(1.0, 3.0))
    for k in range(n):
        wrapped = (float(yaw[k]) + offset_deg + 180) % 360 - 180
        true = HERE._replace(lat_deg=48.0 + k * 1e-5)
        errors = Errors(*map(float, (north[k], east[k], height[k], speed[k])), wrapped, bool(inside[k]), true)
        comparison.add(k * SECOND // 100, errors)
    found = comparison.report()
    assert found is not None
    here = slice(100, 301)
    horizontal = np.hypot(north, east)[here]
    centred = np.hypot(north[here] - north[here].mean(), east[here] - east[here].mean())
    assert (found.rows, found.start_s, found.stop_s) == (201, 1.0, 3.0)
    assert found.distance_m == pytest.approx(displacement(48.002, 11.0, (48.0, 11.0), 500.0)[0], rel=1e-6)
    assert found.position.rmse_m == pytest.approx(np.sqrt(np.mean(horizontal**2)))
    assert found.position.rmse_offset_removed_m == pytest.approx(np.sqrt(np.mean(centred**2)))
    assert found.position.p95_m == pytest.approx(np.quantile(horizontal, 0.95, method="inverted_cdf"), abs=6e-4)
    assert found.position.max_m == horizontal.max()
    assert found.position.end_m == horizontal[-1]
    assert found.position.inside_95 == pytest.approx(inside[here].mean())
    assert found.height_rmse_m == pytest.approx(np.sqrt(np.mean(height[here] ** 2)))
    assert found.velocity_rmse_mps == pytest.approx(np.sqrt(np.mean(speed[here] ** 2)))
    turned = yaw[here] - yaw[here].mean()
    assert found.heading.rmse_deg == pytest.approx(turned.std(), rel=1e-6)
    assert found.heading.p95_deg == pytest.approx(np.quantile(np.abs(turned), 0.95, method="inverted_cdf"), abs=2e-3)
    off = (found.heading.offset_deg - offset_deg - yaw[here].mean() + 180) % 360 - 180
    assert off == pytest.approx(0.0, abs=1e-9)


# --- The summary


def test_dead_reckoning_begins_with_the_last_fix_and_ends_with_the_next() -> None:
    log = report.DeadReckoningLog(timeout_s=2.0)
    for tenth in range(100):
        second = tenth / 10
        mode = Mode.DEAD_RECKONING if 4.0 <= second < 7.0 else Mode.NOMINAL
        log.add(round(second * SECOND), message(second, mode, speed=10.0), None)
    found = log.report()
    (stretch,) = found.stretches
    assert (stretch.start_s, stretch.stop_s) == (2.0, 7.0)
    assert stretch.distance_m == pytest.approx(49.0)  # to the last publication in it, at 6.9 s
    assert stretch.sigma_m == pytest.approx(5.0)
    assert stretch.error_m is None
    assert (found.count, found.seconds) == (1, 5.0)


def test_dead_reckoning_that_is_open_at_the_end_is_told() -> None:
    log = report.DeadReckoningLog(timeout_s=1.0)
    for second in range(6):
        log.add(second * SECOND, message(second, Mode.DEAD_RECKONING if second > 2 else Mode.NOMINAL), None)
    assert [(s.start_s, s.stop_s) for s in log.report().stretches] == [(2.0, 5.0)]


def test_many_stretches_are_counted_but_not_all_kept() -> None:
    log = report.DeadReckoningLog(timeout_s=0.5)
    for second in range(400):
        log.add(second * SECOND, message(second, Mode.DEAD_RECKONING if second % 2 else Mode.NOMINAL), None)
    found = log.report()
    assert found.count == 200
    assert len(found.stretches) == report.MAX_STRETCHES


def test_source_report_adds_up() -> None:
    outcomes = {"FUSED": 5, "REJECTED": 1, "TOO_OLD": 0, "DUPLICATE": 2, "INVALID": 3, "WAITING": 0}
    found = report.source_report(4, outcomes, {"no fix": 3}, None)
    assert (found.events, found.fused, found.withheld, found.invalid_reasons) == (15, 5, 4, {"no fix": 3})


def summary() -> report.Summary:
    source = report.source_report(
        0, {"FUSED": 5, "REJECTED": 1, "TOO_OLD": 2, "DUPLICATE": 0, "INVALID": 3, "WAITING": 0}, {"no fix": 3}, None
    )
    return report.Summary(
        fusiond="0",
        config="car.toml",
        vehicle="car",
        logs={"a.tlog": {"records": 1}},
        warnings=["a.tlog: odd"],
        span=report.Span(first_ns=0, last_ns=SECOND, seconds=1.0),
        events=11,
        clock_pairs=0,
        rerun=7,
        sources={"gps0.position": source},
        clocks={},
        final=message(),
    )


def test_text_tells_what_a_reader_needs() -> None:
    text = report.text(summary())
    for part in (
        "car: 1.0 s from 1970-01-01 00:00:00 UTC out of a.tlog",
        "warning: a.tlog: odd",
        "invalid of gps0.position: no fix (3)",
        "2 came later than filter.horizon_s allows",
        "7 events were run again",
        "+- 3.00 m north, 4.00 m east",
    ):
        assert part in text
    assert "duplicate" not in text  # a column of nothing but zeros
    assert all(line == line.rstrip() for line in text.splitlines())


def test_json_reads_back() -> None:
    decoded = msgspec.json.decode(report.to_json(summary()), type=report.Summary)
    assert decoded == summary()
