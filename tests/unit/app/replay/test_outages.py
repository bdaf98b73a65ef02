"""Outages of GNSS in a replay: their plan by hand, the errors at their ends, and a whole command."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pytest

from fusiond.__main__ import SUCCESS, main
from fusiond.app.replay.comparison import errors_of
from fusiond.app.replay.outages import (
    PASSES,
    RECOVERY_S,
    Length,
    Outage,
    OutageLog,
    Stretch,
    Waypoint,
    course,
    parse_length,
    plan,
    quantile,
    report,
    withheld,
)
from fusiond.app.replay.truth import Truth, TruthSample
from fusiond.config import load as config
from fusiond.errors import UsageError
from fusiond.simulation.scenario import parse
from fusiond.units import SECOND
from fusiond_adapters.logs.write import write_drive
from tests.helpers.published import message

SPEED = 10.0  # m/s


def steady(seconds: int) -> list[Waypoint]:
    """A drive at SPEED, with a waypoint a second."""
    return [Waypoint(float(t), SPEED * t) for t in range(seconds + 1)]


@pytest.mark.parametrize(("text", "length"), [("1000m", Length(1000.0, "m")), ("7.5s", Length(7.5, "s"))])
def test_a_length_is_metres_or_seconds(text: str, length: Length) -> None:
    assert parse_length(text) == length


@pytest.mark.parametrize("text", ["1000", "0m", "-5s", "1 km", "m", "1e3m", "nanm"])
def test_what_is_no_length_is_told(text: str) -> None:
    with pytest.raises(UsageError, match="1000m or 60s"):
        parse_length(text)


def test_outages_follow_each_other_after_a_recovery() -> None:
    passes = plan(steady(400), Length(800.0, "m"), begin_s=30.0)
    assert len(passes) == PASSES
    # 80 s each; with 60 s between them, the third would begin at 310 + 10 k s, and end by 400 s only for the first two
    assert [stretch[:2] for stretch in passes[0]] == [(30.0, 110.0), (170.0, 250.0), (310.0, 390.0)]
    assert [stretch[:2] for stretch in passes[1]] == [(40.0, 120.0), (180.0, 260.0), (320.0, 400.0)]
    assert [stretch[:2] for stretch in passes[2]] == [(50.0, 130.0), (190.0, 270.0)]
    for stretches in passes:
        for before, after in pairwise(stretches):
            assert after.start_s >= before.stop_s + RECOVERY_S
        assert all(stretch.distance_m == 800.0 for stretch in stretches)


def test_outages_of_so_many_seconds_need_motion() -> None:
    points = [Waypoint(float(t), 0.0 if t < 100 else SPEED * (t - 100)) for t in range(201)]
    passes = plan(points, Length(40.0, "s"), begin_s=0.0)
    stretches = [stretch for one in passes for stretch in one]
    assert stretches
    assert all(stretch.distance_m >= 1.0 and stretch.stop_s > 100 for stretch in stretches)
    assert all(stretch.stop_s - stretch.start_s == 40.0 for stretch in stretches)


@pytest.mark.parametrize("begin_s", [330.0, 1000.0])
def test_a_drive_that_is_too_short_has_none(begin_s: float) -> None:
    assert plan(steady(400), Length(800.0, "m"), begin_s) == []


def test_the_course_is_the_way_along_the_track() -> None:
    north = 1 / 111_132.0  # deg of latitude a metre, near enough at 45 N
    places = [(0.0, 0.0), (30.0, 0.0), (30.0, 40.0)]
    samples = [
        TruthSample(k * SECOND, 45 + n * north, 11 + e / 78_846.0, 0.0, 0, 0, 0) for k, (n, e) in enumerate(places)
    ]
    points = course(Truth(samples), SECOND)
    assert [point.second for point in points] == [-1.0, 0.0, 1.0]
    assert [point.travelled_m for point in points] == pytest.approx([0, 30, 70], rel=1e-3)
    assert course(Truth([]), 0) == []


def test_the_last_state_of_an_outage_counts() -> None:
    log = OutageLog([Stretch(10.0, 20.0, 200.0), Stretch(80.0, 90.0, 100.0), Stretch(150.0, 160.0, 100.0)])
    state = message()
    assert state.state is not None
    for second, off in ((9.0, 9), (11.0, 1), (19.9, 2), (20.0, 9), (85.0, 4), (120.0, 9), (155.0, 4)):
        true = TruthSample(0, state.state.lat_deg - off * 1e-5, state.state.lon_deg, state.state.height_m, 0, 0, 0)
        log.add(round(second * SECOND), state, errors_of(state, true))
    log.add(156 * SECOND, state, None)  # the truth has a gap
    first, second_one, third = log.ends()
    assert first is not None
    assert first.error_m == pytest.approx(2e-5 * 111_199, rel=1e-3)
    assert first.percent == pytest.approx(first.error_m / 2)
    assert first.sigma_m == pytest.approx(
        (state.state.sigma_position_ned_m[0] ** 2 + state.state.sigma_position_ned_m[1] ** 2) ** 0.5
    )
    assert second_one is not None
    assert second_one.error_m == pytest.approx(4e-5 * 111_199, rel=1e-3)
    assert third is None


def outage(percent: float) -> Outage:
    return Outage(start_s=0, stop_s=1, distance_m=500, error_m=5 * percent, sigma_m=1, inside_95=percent < 3)


def test_the_report_has_the_quantiles() -> None:
    ends = [*(outage(float(percent)) for percent in (4, 2, 3, 1)), None]
    found = report(Length(500, "m"), ends)
    assert found is not None
    assert (found.count, found.without_state, found.length) == (4, 1, "500 m")
    assert (found.p50_percent, found.p68_percent, found.p95_percent, found.max_percent) == (2, 3, 4, 4)
    assert (found.p68_m, found.inside_95) == (15.0, 0.5)
    assert report(Length(500, "m"), [None]) is None


def test_a_quantile_is_the_least_value_that_the_share_does_not_exceed() -> None:
    values = [float(value) for value in range(100, 0, -1)]
    assert [quantile(values, share) for share in (0.001, 0.5, 0.68, 1.0)] == [1.0, 50.0, 68.0, 100.0]


DRIVE = """
[start]
speed_mps = 10.0
[imu]
rate_hz = 50.0
[[segment]]
duration_s = 60
speed_mps = 15.0
turn_deg = 90.0
[[segment]]
duration_s = 60
turn_deg = -60.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive")
    write_drive(parse(DRIVE), path)
    return path


def test_all_receivers_are_withheld(folder: Path) -> None:
    setup = config.load(folder / "fusiond.toml")
    (one,) = withheld([Stretch(1.0, 2.5, 10.0)], setup)
    assert one.sources == {"gps0.position", "gps0.velocity"}
    assert (one.start_ns, one.stop_ns) == (SECOND, 5 * SECOND // 2)


def command(folder: Path, length: str) -> list[str]:
    logs = [str(folder / name) for name in ("drive.tlog", "drive.log")]
    truth = ["--truth", str(folder / "truth.csv"), "--json", str(folder / "summary.json")]
    return ["replay", "--config", str(folder / "fusiond.toml"), *logs, *truth, "--outage-length", length]


def test_a_replay_with_outages(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command(folder, "300m")) == SUCCESS
    out = capsys.readouterr().out
    assert "without GNSS for 300 m, " in out
    summary = json.loads((folder / "summary.json").read_bytes())
    found = summary["outages"]
    assert found["count"] == len(found["outages"]) >= 6
    assert found["without_state"] == 0
    for one in found["outages"]:
        assert one["distance_m"] == pytest.approx(300, abs=16)
        assert one["stop_s"] - one["start_s"] == pytest.approx(one["distance_m"] / 14, rel=0.15)
    assert 0 < found["p68_percent"] <= found["max_percent"] < 2
    assert summary["dead_reckoning"]["count"] == 0  # the replay itself has all fixes
    for angle in ("pitch", "roll"):
        assert 0 < summary["truth"][angle]["p68_deg"] < 0.5


def test_a_drive_without_room_for_an_outage_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command(folder, "5000m")) == SUCCESS
    assert "no stretch of 5000 m with a truth after 60 s with GNSS" in capsys.readouterr().out
