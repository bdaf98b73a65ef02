"""Both kernels give the recorded states of the bundled drive, bit for bit: any change is either intended or a defect.

After an intended change, `python -m tests.golden.test_golden` writes the new states, and the commit says by how much they
differ and why that is better.
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np
import pytest

from fusiond.app.demo.demo import DRIVE, LOGS
from fusiond.app.replay.job import Options, replay
from fusiond.config import load as config
from fusiond.filter.kernel import interpreted

GOLDEN = Path(__file__).parent / "demo.csv"


def states(path: Path) -> str:
    """Replay the bundled drive; the CSV of one state a second."""
    replay(
        Options(
            config=config.load(DRIVE / "fusiond.toml"),
            config_name="fusiond.toml",
            logs=[str(DRIVE / log) for log in LOGS],
            csv=path,
            rate_hz=1.0,
        )
    )
    return path.read_text()


def test_golden(tmp_path: Path, compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interpreted, "compiled_available", lambda: compiled)  # as if it were built, or not
    assert states(tmp_path / "demo.csv") == GOLDEN.read_text()


def test_the_golden_states_are_those_of_a_drive() -> None:
    rows = [row for row in csv.DictReader(GOLDEN.read_text().splitlines()) if row["mode"] != "aligning"]
    assert len(rows) > 120
    assert {row["mode"] for row in rows} == {"nominal", "dead_reckoning"}
    assert np.ptp([float(row["lat_deg"]) for row in rows]) > 1e-3


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        GOLDEN.write_text(states(Path(folder) / "demo.csv"))
