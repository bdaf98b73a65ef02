"""The benchmarks run on a short log, and every row of the table has its reference and ratio; inertial rates are as named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import run
from fusiond.filter.kernel.interpreted import compiled_available

ROWS = [
    "predict: one propagation",
    "update: GNSS position",
    "update: GNSS velocity",
    "update: steered wheel",
    "update: wheel",
    *(f"fix {late} ms late, IMU {rate} Hz" for rate in (200, 400) for late in (50, 100, 200, 500, 900)),
    "one event of that rewind",
    "import the core",
    "import all of replay",
    "fusiond --version",
    "replay of 0.2 min",
    "the same, faster than real time",
    "peak memory of that replay",
]


@pytest.mark.skipif(not compiled_available(), reason="the kernel was not compiled here")
def test_every_row_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run.main(["--minutes", "0.2", "--repeats", "1", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if line.startswith("| ")][2:]
    assert len(lines) == len(ROWS)
    for row in ROWS:
        (line,) = [line for line in lines if line.startswith((f"| {row}", f"|   {row}"))]
        assert re.search(r"\| [0-9.]+ x \|", line), line
    assert (tmp_path / "report.md").read_text().strip() == printed.strip()


@pytest.mark.parametrize("imu_hz", [200, 400])
def test_the_inertial_sensor_of_the_rewinds_has_the_rate_of_its_row(imu_hz: int) -> None:
    fusion, _ = run.running(imu_hz, 2.0, compiled=compiled_available())
    assert sum(fusion.outcomes()["imu0"].values()) == 2 * imu_hz
    assert sum(fusion.outcomes()["rear_left"].values()) == 200
    assert sum(fusion.outcomes()["gps0.position"].values()) == 10


def test_memory_is_that_of_the_child_alone() -> None:
    mine = b"x" * 200_000_000  # the child's ru_maxrss would start at this
    _, peak_mb = run.run_python("-c", "pass")
    assert peak_mb < len(mine) / 2e6
