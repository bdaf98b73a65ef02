"""The benchmarks run, on a log of seconds, and every row of the table is there with its reference and its ratio."""

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
    told = capsys.readouterr().out
    lines = [line for line in told.splitlines() if line.startswith("| ")][2:]
    assert len(lines) == len(ROWS)
    for row in ROWS:
        (line,) = [line for line in lines if line.startswith((f"| {row}", f"|   {row}"))]
        assert re.search(r"\| [0-9.]+ x \|", line), line
    assert (tmp_path / "report.md").read_text().strip() == told.strip()


def test_memory_is_that_of_the_child_alone() -> None:
    mine = b"x" * 200_000_000  # which the child's ru_maxrss would begin at
    _, peak_mb = run.run_python("-c", "pass")
    assert peak_mb < len(mine) / 2e6
