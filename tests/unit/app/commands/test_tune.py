"""fusiond tune: on a simulated drive whose configuration is wrong by three, and what it cannot do."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from fusiond.__main__ import main
from fusiond.config import load
from fusiond.simulation.scenario import parse
from fusiond_adapters.logs.write import write_drive
from tests.conftest import needs_compiled
from tests.helpers.drive import LOGS, folder

TOWN = [(10, 15, 90), (10, 18, 0), (8, 10, -60), (10, 14, -120), (8, 4, 0), (8, 15, 90)]  # s, m/s, deg
NOISE = """
[start]
speed_mps = 8.0
[imu]
accel_noise = 0.02
gyro_noise = 1e-3
[gnss]
report_accuracy = false
sigma_m = 0.5
drift_sigma_m = 1.0
correlation_s = 8.0
velocity_sigma_mps = 0.15
velocity_correlation_s = 2.0
[wheels]
sigma_mps = 0.05
rate_hz = 20
chatter = false
"""
TRUE = {
    "accel_noise": 0.02,
    "gyro_noise": 1e-3,
    "position_sigma_m": 1.118,
    "position_correlation_s": 8.0,
    "velocity_sigma_mps": 0.15,
    "velocity_correlation_s": 2.0,
    "sigma_mps": 0.05,
}
WRONG = (3.0, 1 / 3, 1 / 3, 3.0, 3.0, 1 / 3, 3.0)  # times the true ones
LEAST_TOLD = 5  # of seven keys


def scenario(rounds: int) -> str:
    segments = [
        f"[[segment]]\nduration_s = {s}\nspeed_mps = {v}\nturn_deg = {turn}\n" for s, v, turn in TOWN * rounds
    ]
    return "".join(segments) + NOISE


@needs_compiled
@pytest.mark.slow
def test_values_that_are_wrong_by_three_are_put_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Within 30 % where the log can tell; and the second half, which was held out, is bridged more honestly."""
    write_drive(parse(scenario(14)), tmp_path)
    text = (tmp_path / "fusiond.toml").read_text()
    for key, factor in zip(TRUE, WRONG, strict=True):
        text = re.sub(rf"(?m)^({key} = )([\d.e-]+)", lambda m, f=factor: f"{m[1]}{float(m[2]) * f:.4g}", text)
    wrong, tuned, out = tmp_path / "wrong.toml", tmp_path / "tuned.toml", tmp_path / "found.json"
    wrong.write_text(text)
    logs = [str(tmp_path / name) for name in ("drive.tlog", "drive.log")]
    assert main(["tune", str(wrong), *logs, "-o", str(tuned), "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    told = [one for one in found["findings"] if one["key"] in TRUE and not one["untold"]]
    assert len({one["key"] for one in told}) >= LEAST_TOLD
    for one in told:
        assert one["found"] == pytest.approx(TRUE[one["key"]], rel=0.3), one["key"]
    before, after = found["before"], found["after"]
    assert after["rmse_m"] <= before["rmse_m"]
    assert abs(after["nees"] - 2) < abs(before["nees"] - 2)
    config = load.load(tuned)
    assert config.imu["imu0"].accel_noise == pytest.approx(0.02, rel=0.1)
    printed = capsys.readouterr().out
    assert "+accel_noise = 0.02" in printed and "held out: " in printed


@needs_compiled
def test_a_short_log_tells_little_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_drive(parse(scenario(1)), tmp_path)
    logs = [str(tmp_path / name) for name in ("drive.tlog", "drive.log")]
    config = str(tmp_path / "fusiond.toml")
    assert main(["tune", config, *logs, "--json", str(tmp_path / "found.json")]) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    assert [one["untold"] for one in found["findings"] if one["key"] == "position_correlation_s"] != [""]
    noise = {one["key"]: one for one in found["findings"]}
    assert noise["accel_noise"]["found"] == pytest.approx(0.02, rel=0.1)
    assert "not told: " in capsys.readouterr().out


def test_a_log_that_is_too_short(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", str(folder() / "fusiond.toml"), *(str(folder() / name) for name in LOGS)]) == 1
    assert "s of measurements: too few to tell anything" in capsys.readouterr().err
