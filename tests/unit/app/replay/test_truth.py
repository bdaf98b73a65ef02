"""The truth: bad files, interpolation, distances on the ellipsoid."""

from __future__ import annotations

import pytest

from fusiond.app.replay.truth import Truth, TruthError, TruthSample, displacement, parse_truth
from fusiond.units import SECOND

HEADER = "unix_us,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg"
ROW = "1000000,48.0,11.0,500.0,1.0,2.0,0.0,0.1,0.2,90.0"
HERE = TruthSample(0, 48.0, 11.0, 500.0, 1.0, 2.0, 90.0)


def test_columns_are_read_by_name() -> None:
    (sample,) = parse_truth([HEADER + "\n", ROW + "\n", "\n"], "truth.csv")
    assert sample == TruthSample(SECOND, 48.0, 11.0, 500.0, 1.0, 2.0, 90.0, pitch_deg=0.2, roll_deg=0.1)
    shuffled = ["yaw_deg,ve_mps,vn_mps,height_m,lon_deg,lat_deg,unix_us", "90,2,1,500,11,48,1000000"]
    assert next(parse_truth(shuffled, "truth.csv"))[:7] == sample[:7]


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
def test_an_error_names_line_and_column(lines: list[str], complaint: str) -> None:
    with pytest.raises(TruthError) as caught:
        list(parse_truth(lines, "t.csv"))
    assert complaint in str(caught.value)


def test_truth_is_interpolated_with_angles_the_short_way_round() -> None:
    samples = [HERE._replace(yaw_deg=170.0, lon_deg=179.9999), HERE._replace(t_ns=SECOND, yaw_deg=-170.0, lon_deg=-179.9999)]
    truth = Truth(samples)
    middle = truth.at(SECOND // 2)
    assert middle is not None
    assert middle.yaw_deg == pytest.approx(180.0)
    assert middle.lon_deg == pytest.approx(180.0)
    assert truth.at(SECOND) == samples[1]
    assert truth.at(SECOND + 1) is None


def test_truth_is_not_interpolated_outside_or_across_a_gap() -> None:
    truth = Truth([HERE._replace(t_ns=SECOND), HERE._replace(t_ns=4 * SECOND)])
    assert [truth.at(t) is None for t in (0, SECOND, 2 * SECOND, 4 * SECOND)] == [True, False, True, False]


def test_truth_is_read_again_where_time_steps_back() -> None:
    samples = [HERE._replace(t_ns=n * SECOND, height_m=float(n)) for n in range(10)]
    truth = Truth(samples)
    heights = [found.height_m for t in (7.5, 2.5, 3.0, 2.0, 8.25) if (found := truth.at(round(t * SECOND)))]
    assert heights == [7.5, 2.5, 3.0, 2.0, 8.25]


def test_displacement_is_metres_on_the_ellipsoid() -> None:
    north, east = displacement(48.001, 11.001, (48.0, 11.0), 0.0)
    assert north == pytest.approx(111.2, abs=0.1)  # a thousandth of a degree of the meridian at 48 N
    assert east == pytest.approx(74.63, abs=0.05)
    assert displacement(0.0, -179.9999, (0.0, 179.9999), 0.0)[1] == pytest.approx(22.26, abs=0.01)
