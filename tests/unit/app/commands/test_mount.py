"""fusiond mount: the printed rotation, and a captured drive."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from fusiond.__main__ import main
from fusiond.maths.rotation import matrix_from_euler
from tests.helpers.mounting import WITHIN, angle_of, folder
from tests.helpers.paths import CAPTURED, ROOT

RAV4 = CAPTURED / "comma2k19-rav4"
TURNED = (170.0, -40.0, 100.0)  # deg: a wrong configuration


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The decoder rotates the samples as configured; the command prints what should have been configured."""
    text = (folder() / "fusiond.toml").read_text().replace("wheels.dbc", str(folder() / "wheels.dbc"))
    path = tmp_path / "car.toml"
    path.write_text(text.replace("[imu.imu0]\n", f"[imu.imu0]\nrotation_deg = {list(TURNED)}\n"))
    logs = [str(folder() / name) for name in ("drive.tlog", "drive.log")]
    assert main(["mount", "--config", str(path), *logs]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "[imu.imu0]"
    roll, pitch, yaw = (math.radians(float(angle)) for angle in re.findall(r"-?\d+\.\d+", lines[1]))
    assert angle_of(matrix_from_euler(roll, pitch, yaw)) < WITHIN
    away = math.degrees(angle_of(matrix_from_euler(*(math.radians(angle) for angle in TURNED))))
    assert float(lines[3].split()[0]) == pytest.approx(away, abs=3.0)


def test_the_command_without_wheels_or_fixes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "car.toml"
    path.write_text('[mavlink.fcu]\n[imu.imu0]\nlink = "fcu"\n')
    assert main(["mount", "--config", str(path), str(folder() / "drive.tlog")]) == 1
    assert "the speed is known from wheels or GNSS for 0 s only" in capsys.readouterr().err


@pytest.mark.skipif(not RAV4.is_dir(), reason="the captured drive is missing")
def test_a_captured_drive(capsys: pytest.CaptureFixture[str]) -> None:
    """Half a minute over the hills of San Francisco, hardly a bend in it; the filter finds a pitch of -3.8 deg."""
    logs = [str(RAV4 / name) for name in ("drive.tlog", "drive.candump.log")]
    assert main(["mount", "--config", str(ROOT / "configs" / "rav4.toml"), *logs]) == 0
    roll, pitch, yaw = (float(a) for a in re.findall(r"-?\d+\.\d+", capsys.readouterr().out.splitlines()[1]))
    assert (roll, pitch, yaw) == (pytest.approx(0.0, abs=3.0), pytest.approx(-3.8, abs=3.0), pytest.approx(0.0, abs=3.0))
