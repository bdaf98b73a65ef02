"""fusiond compare: of two configurations, of two files; and what cannot be compared."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from fusiond.__main__ import main
from fusiond.app.compare import series as series_module
from fusiond.app.compare.differences import differences, text
from fusiond.app.compare.series import NUMBERS, Series, SeriesError, of_autopilot, of_replay
from fusiond.config.load import load
from fusiond.messages.csv import csv_header
from fusiond.units import SECOND
from fusiond_adapters.logs.own_estimate import OwnState
from tests.conftest import needs_compiled
from tests.helpers.drive import LOGS, folder
from tests.helpers.paths import CAPTURED

T0 = 1_700_000_000 * SECOND
COPTER = CAPTURED / "flight-logs" / "copter-log171.bin"
STATE = {"lat_deg": 48.0, "lon_deg": 179.9999, "height_m": 500.0, "vn_mps": 10.0, "yaw_deg": 179.9}
SIGMAS = {"sigma_n_m": 0.3, "sigma_e_m": 0.4, "sigma_d_m": 1.0, "sigma_v_mps": 0.1, "sigma_yaw_deg": 0.5}


def series(name: str, seconds: np.ndarray, **changes: object) -> Series:
    columns = dict.fromkeys(NUMBERS, 0.0) | STATE | SIGMAS | changes
    numbers = np.stack([np.broadcast_to(np.asarray(columns[c], dtype=float), len(seconds)) for c in NUMBERS], axis=1)
    stamps = (T0 + np.round(seconds * SECOND)).astype(np.int64).tolist()
    return Series.of(name, stamps, numbers.tolist(), ["nominal"] * len(seconds))


def test_what_differs_when_and_by_how_much() -> None:
    """B is 2 m north from second 4 to 6, across the date line, and turned by 0.4 deg across the half turn."""
    t = np.arange(0, 10, 0.1)
    north = np.where((t >= 4) & (t < 6), 2.0, 0.0)
    other = series("B", t, lat_deg=48.0 + north / 111_200.0, lon_deg=-180.0, yaw_deg=-179.7, sigma_yaw_deg=1.0)
    found = differences(series("A", t), other)
    place = found.quantities["horizontal position"]
    east = 0.0001 * 111_320 * np.cos(np.radians(48.0)) * 1.0016
    assert place.max == pytest.approx(np.hypot(2.0, east), rel=0.01) and 3.9 <= place.max_at_s <= 6
    assert place.max_sigmas == pytest.approx(place.max / np.hypot(0.5, 0.5), rel=1e-6)
    heading = found.quantities["heading"]
    assert (heading.rms, heading.max, heading.sigma_ratio) == (pytest.approx(0.4), pytest.approx(0.4), pytest.approx(2.0))
    assert found.quantities["height"].max == 0 and found.alone == (0, 0) and found.states == 100
    stretches = [one for one in found.apart if one.what == "horizontal position"]
    assert stretches and stretches[0].start_s == pytest.approx(0.0 if east > 1.5 else 4.0)
    assert "heading" in text(found) and "B less A" in text(found)


def test_other_rates_are_interpolated_and_what_sticks_out_is_told() -> None:
    fast, slow = np.arange(0, 20, 0.02), np.arange(5, 25, 0.5)
    lat = 48.0 + 1e-4 * fast
    found = differences(series("A", fast, lat_deg=lat), series("B", slow, lat_deg=48.0 + 1e-4 * slow))
    assert found.states == 30 and found.alone == (274, 10)
    assert found.quantities["horizontal position"].max < 1e-6
    assert found.apart == [] and "nowhere further apart" in text(found)


def test_a_gap_is_not_bridged_and_modes_are_told() -> None:
    gapped = series("B", np.concatenate([np.arange(0, 5, 1.0), np.arange(15, 20, 1.0)]))
    gapped.mode[:2] = "lost"
    found = differences(series("A", np.arange(0, 20, 0.1)), gapped)
    assert found.states == 10
    (mode,) = [one for one in found.apart if one.what == "mode"]
    assert (mode.start_s, mode.stop_s, mode.most) == (0.0, 1.0, "nominal and lost")


def test_a_track_without_sigmas() -> None:
    t = np.arange(0, 5, 0.1)
    bare = series("B", t, height_m=501.0, yaw_deg=np.nan, **dict.fromkeys(SIGMAS, np.nan))
    found = differences(series("A", t), bare)
    assert found.quantities["height"].rms == pytest.approx(1.0)
    assert found.quantities["height"].max_sigmas is None and "heading" not in found.quantities
    assert [one.what for one in found.apart] == []


def test_nothing_in_common() -> None:
    with pytest.raises(SeriesError, match="A and B have no instant in common"):
        differences(series("A", np.arange(0, 5, 0.1)), series("B", np.arange(10, 15, 0.1)))


def logs() -> list[str]:
    return [str(folder() / name) for name in LOGS]


@needs_compiled
def test_two_configurations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The other one thinks that the antenna is 1 m further back."""
    one = folder() / "fusiond.toml"
    text_of = one.read_text().replace("wheels.dbc", str(folder() / "wheels.dbc"))
    lines = text_of.splitlines()
    place = next(i for i, line in enumerate(lines) if line.startswith("lever_arm_m"))
    x, y, z = json.loads(lines[place].partition("=")[2].partition("#")[0])
    lines[place] = f"lever_arm_m = {[x - 1.0, y, z]}"
    other = tmp_path / "other.toml"
    other.write_text("\n".join(lines))
    out = tmp_path / "differences.json"
    assert main(["compare", str(one), str(other), *logs(), "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert 0.3 < found["quantities"]["horizontal position"]["rms"] < 1.5
    assert found["quantities"]["horizontal velocity"]["rms"] < 0.5
    assert "states compared" in capsys.readouterr().out


@needs_compiled
def test_a_configuration_and_its_own_track(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, track = str(folder() / "fusiond.toml"), tmp_path / "track.csv"
    assert main(["replay", config, *logs(), "--csv", str(track), "-q"]) == 0
    assert main(["compare", config, str(track), *logs()]) == 0
    out = capsys.readouterr().out
    assert "nowhere further apart" in out and "  horizontal position  0.000       0.000  0.000     m" in out


@needs_compiled
def test_the_autopilots_own(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It is 3 m higher than fusiond, and has no sigmas. Its log is read by its first name, without that of a link."""
    read: list[str] = []

    def own(path: str) -> list[OwnState]:
        read.append(path)
        track = of_replay("fusiond", load(folder() / "fusiond.toml"), logs())
        lat, lon, height = (track.column(c).tolist() for c in ("lat_deg", "lon_deg", "height_m"))
        rows = zip(track.t_ns.tolist(), map(math.radians, lat), map(math.radians, lon), height, strict=True)
        return [OwnState(t, phi, lam, h + 3.0, (0.0, 0.0, 0.0), math.nan) for t, phi, lam, h in rows]

    monkeypatch.setattr(series_module, "own_estimate", own)
    assert main(["compare", str(folder() / "fusiond.toml"), *logs()]) == 0
    out = capsys.readouterr().out
    assert read == logs()[:1] and "the autopilot's own" in out and "heading" not in out
    (height,) = [line.split() for line in out.splitlines() if line.startswith("  height")]
    assert height[1:4] == ["3.000"] * 3 and height[6:] == ["-"] * 4


@pytest.mark.skipif(not COPTER.is_file(), reason="the captured flight is not beside the project")
def test_the_autopilots_own_in_a_captured_log() -> None:
    found = of_autopilot(str(COPTER))
    assert len(found.t_ns) > 1000 and np.isfinite(found.column("lat_deg")).all() and np.ptp(found.column("lat_deg")) < 0.1


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ([], "give one or two configurations or tracks"),
        (["a.csv", "b.csv", "c.csv"], "give one or two configurations or tracks (.toml, .csv), not 3"),
        (["a.toml", "b.csv"], "give the logs of the drive as well"),
        (["a.csv"], "give the logs of the drive as well"),
    ],
)
def test_what_cannot_be_compared(files: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", *(files or ["drive.tlog"])]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("a,b\n1,2\n", "no column unix_us, lat_deg"),
        (csv_header() + "\n" + "1," * 14 + "x,nominal\n", "could not convert string to float: 'x'"),
        (csv_header() + "\n", "no states to compare"),
        (None, "cannot be read"),
    ],
)
def test_tracks_that_are_none(
    written: str | None, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "track.csv"
    if written is not None:
        path.write_text(written)
    assert main(["compare", str(path), str(path)]) == 1
    assert said in capsys.readouterr().err
