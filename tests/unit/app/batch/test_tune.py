"""Tuning a fleet: what drives tell is joined, each vehicle's own is apart, and what makes drives worse is not taken."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusiond.__main__ import main
from fusiond.app.batch.tune import LEAST, by_vehicle, joined, text_with, write_fold
from fusiond.app.tuning.tune import INERTIAL, INSTALLATION, Finding
from fusiond.config import load
from tests.helpers import fleet


def finding(found: float, sigma: float = 0.1, group: str = INERTIAL, key: str = "gyro_noise", untold: str = "") -> Finding:
    return Finding(
        group=group, table="imu.imu0", key=key, unit="x", configured=1.0, found=found, sigma=sigma, untold=untold
    )


def test_a_few_strange_drives_decide_nothing() -> None:
    random = np.random.default_rng(1)
    told = [[finding(value)] for value in [*random.normal(2.0, 0.2, 60).tolist(), 50.0, 80.0, 1e6]]
    told += [[finding(9.0, untold="it was at rest")]] * 100
    (one,) = joined(told)
    assert (one.drives, one.differs) == (63, True)
    assert one.found == pytest.approx(2.0, abs=0.1)
    assert one.sigma == pytest.approx(1.2533 * 0.2 / np.sqrt(63), rel=0.3)
    assert joined(told[: LEAST - 1]) == [] and joined(told, []) == []


def test_the_uncertainty_of_the_median_is_honest() -> None:
    off = []
    for seed in range(300):
        values = np.random.default_rng(seed).normal(2.0, 0.3, 25)
        (one,) = joined([[finding(value)] for value in values.tolist()])
        off.append((one.found - 2.0) / one.sigma)
    assert 0.85 < np.std(off) < 1.2


def test_what_is_a_vehicles_own_is_weighed_by_its_uncertainty() -> None:
    told = [("a", [finding(3.0, 0.1, INSTALLATION, "delay_ms")]), ("a", [finding(6.0, 0.2, INSTALLATION, "delay_ms")]),
            ("b", [finding(1.0, 0.5, INSTALLATION, "delay_ms"), finding(5.0)])]  # fmt: skip
    first, second = by_vehicle(told)
    assert (first.vehicle, first.drives, second.vehicle) == ("a", 2, "b")
    assert first.found == pytest.approx((3.0 * 100 + 6.0 * 25) / 125) and first.sigma == pytest.approx(125**-0.5)


def test_a_fold_reads_the_same_dbc_files(tmp_path: Path) -> None:
    given = fleet.configuration(tmp_path, "car.toml")
    findings = joined([[finding(2e-3)]] * LEAST)
    write_fold(str(given), findings, tmp_path / "elsewhere" / "fold.toml")
    used, fold = load.load(given), load.load(tmp_path / "elsewhere" / "fold.toml")
    assert fold.imu["imu0"].gyro_noise == 2e-3 != used.imu["imu0"].gyro_noise
    assert fold.path(fold.can["car"].dbc[0]) == used.path(used.can["car"].dbc[0]) == tmp_path / "wheels.dbc"
    assert tomllib.loads(text_with(given.read_text(), findings))["can"] == tomllib.loads(given.read_text())["can"]


def test_a_fleet_tells_the_noise_of_its_inertial_sensors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fleet.drives(tmp_path / "fleet", range(5), 60.0)
    start = fleet.configuration(tmp_path, "start.toml", ("accel_noise = 0.003", "accel_noise = 0.03"))
    command = ["batch", str(tmp_path / "fleet"), "--config", str(start), "-o", str(tmp_path / "out"), "--rate", "2"]
    assert main([*command, "--workers", "1", "--tune", str(tmp_path / "tuned.toml")]) == 0
    said = capsys.readouterr().out
    assert "5 of 5 drives tell something" in said and "[imu.imu0] accel_noise" in said
    assert "what is taken, on drives that did not tell it" in said
    tuned = load.load(tmp_path / "tuned.toml")
    assert tuned.imu["imu0"].accel_noise == pytest.approx(0.003, rel=0.3)
    own = pd.read_parquet(tmp_path / "out" / "vehicles.parquet")
    assert set(own["vehicle"]) == {"simulated"} and (own["sigma"] > 0).all() and "delay_ms" in set(own["key"])
    assert main([*command, "--config", "own", "--tune", str(tmp_path / "tuned.toml")]) == 2
