"""fusiond smooth, and replay --smooth: the track, the comparison with the truth, and what cannot be smoothed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fusiond.__main__ import main
from tests.conftest import needs_compiled
from tests.helpers.drive import LOGS, folder
from tests.helpers.paths import CAPTURED, ROOT

RAV4 = CAPTURED / "comma2k19-rav4"


def arguments(*more: str) -> list[str]:
    """The drive goes without GNSS from second 4.5 on."""
    return [str(folder() / "fusiond.toml"), *(str(folder() / name) for name in LOGS), *more]


@needs_compiled
def test_the_smoothed_track(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track, live, again = tmp_path / "smoothed.csv", tmp_path / "track.csv", tmp_path / "again.csv"
    truth = str(folder() / "truth.csv")
    assert main(["smooth", *arguments("--csv", str(track), "--truth", truth, "--json", str(tmp_path / "s.json"))]) == 0
    out = capsys.readouterr().out
    assert "the filter's states compared with the truth" in out and "the smoothed states compared with the truth" in out
    rows = [line.split(",") for line in track.read_text().splitlines()]
    assert len(rows) > 200 and all(float(cell) == float(cell) for row in rows[1:] for cell in row[:-1])
    report = json.loads((tmp_path / "s.json").read_text())
    smoothed, filtered = report["smoothed"], report["truth"]
    assert smoothed["states"] == len(rows) - 1 and smoothed["sigma_m"] < smoothed["filter_sigma_m"]
    assert smoothed["truth"]["position"]["rmse_m"] < filtered["position"]["rmse_m"] + 0.1
    assert smoothed["truth"]["position"]["inside_95"] > 0.9
    assert smoothed["sources"]["gps0.position"]["used"] > 10

    assert main(["replay", *arguments("--csv", str(live), "--smooth", str(again), "-q")]) == 0
    assert again.read_bytes() == track.read_bytes()
    states = {line.partition(",")[0] for line in live.read_text().splitlines()}
    assert {row[0] for row in rows} <= states


@needs_compiled
def test_a_drive_without_a_state(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It stood: no course, no heading."""
    assert main(["smooth", *arguments("--withhold", "gps0:0-100", "--csv", str(tmp_path / "track.csv"))]) == 0
    assert capsys.readouterr().out == "smoothed       nothing: there was no state\n"
    assert len((tmp_path / "track.csv").read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--window", "1-2"], "--window limits the comparison with a truth: give --truth as well"),
        (["--csv", "/nowhere/track.csv"], "there is no folder /nowhere"),
    ],
)
def test_what_cannot_be_done(more: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["smooth", *arguments(*more)]) in (1, 2)
    assert said in capsys.readouterr().err


@needs_compiled
@pytest.mark.skipif(not RAV4.is_dir(), reason="the captured drive comma2k19-rav4 is not beside the project")
def test_a_captured_drive_without_gnss(tmp_path: Path) -> None:
    """Ten seconds without GNSS, bridged from both sides: the shape of the track, speed and attitude."""
    report = tmp_path / "summary.json"
    logs = [str(RAV4 / name) for name in ("drive.tlog", "drive.candump.log")]
    held = ["--truth", str(RAV4 / "truth.csv"), "--withhold", "gps0:12-22", "--window", "12-22"]
    assert main(["smooth", str(ROOT / "configs" / "rav4.toml"), *logs, *held, "-q", "--json", str(report)]) == 0
    found = json.loads(report.read_text())
    filtered, smoothed = found["truth"], found["smoothed"]["truth"]
    assert smoothed["position"]["rmse_offset_removed_m"] < 0.6 * filtered["position"]["rmse_offset_removed_m"]
    assert smoothed["velocity_rmse_mps"] < filtered["velocity_rmse_mps"]
    assert smoothed["heading"]["rmse_deg"] < filtered["heading"]["rmse_deg"]
    assert found["smoothed"]["sigma_m"] < found["smoothed"]["filter_sigma_m"]
