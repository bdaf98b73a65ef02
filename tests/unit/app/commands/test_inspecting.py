"""The commands that look at logs and begin a configuration: inspect, init, imu_noise, gnss_lag."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fusiond import __main__ as command
from fusiond.app.presets import names
from tests.helpers.paths import ROOT

DEMO = ROOT / "fusiond" / "app" / "demo" / "data"
LOGS = [str(DEMO / "drive.tlog.gz"), str(DEMO / "drive.log.gz")]


@pytest.mark.parametrize("car", [None, *names()])
def test_init_writes_what_check_accepts(tmp_path: Path, car: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "car.toml"
    words = ["init", str(target)] + (["--car", car] if car else [])
    assert command.main(words) == command.SUCCESS
    assert command.main(["check", str(target)]) == command.SUCCESS
    assert "can be used" in capsys.readouterr().out
    assert command.main(words) == command.USAGE
    assert "is there already" in capsys.readouterr().err


def test_inspect_writes_facts_and_a_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target, facts = tmp_path / "car.toml", tmp_path / "facts.json"
    assert command.main(["inspect", *LOGS, "--write-config", str(target), "--json", str(facts)]) == command.SUCCESS
    told = capsys.readouterr().out
    assert "drive.tlog.gz: MAVLink" in told and "HIGHRES_IMU" in told
    assert f"next: fusiond check {target}" in told
    assert len(json.loads(facts.read_text())["logs"]) == 2
    assert command.main(["check", str(target)]) == command.SUCCESS


def test_inspect_prints_json_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["inspect", LOGS[0], "--json", "-"]) == command.SUCCESS
    assert json.loads(capsys.readouterr().out)["sources"][0]["name"] == "gps0.position"


def test_inspect_needs_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["inspect", "a.dbc"]) == command.USAGE
    (tmp_path / "x.dat").write_bytes(b"ULog\x01\x12\x35\x01")
    assert command.main(["inspect", str(tmp_path / "x.dat")]) == command.UNUSABLE
    assert "it seems to be a PX4 ULog: name it .ulg" in capsys.readouterr().err


def test_noise_and_lag_of_the_bundled_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = str(tmp_path / "car.toml")
    assert command.main(["inspect", *LOGS, "--write-config", target]) == command.SUCCESS
    assert command.main(["imu_noise", target, LOGS[0], "--window", "20-60"]) == command.SUCCESS
    assert command.main(["gnss_lag", target, *LOGS]) == command.SUCCESS
    told = capsys.readouterr().out
    assert "3996 samples at 99.9 Hz" in told and "accel_noise [m/s^2/sqrt(Hz)]" in told and "GNSS speed lags by" in told
    assert command.main(["gnss_lag", target, LOGS[0]]) == command.UNUSABLE
