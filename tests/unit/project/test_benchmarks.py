"""The benchmarks run on a short log, and every row of the table has its reference and ratio; inertial rates are as named.
The attackers send what their seed says, and accounts must add up."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import pytest

from benchmarks import hostile, run
from benchmarks.latency import Arrival, Reading
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


def test_what_the_attackers_send_follows_from_the_seed() -> None:
    def sent(seed: int) -> list[bytes]:
        ports = hostile.Ports(1, 2, 3, 4, 5, 6)
        with ExitStack() as stack:
            made = hostile.Attackers(ports, hostile.ATTACKS, seed, stack)
            names = ("0xFE", "tiny", "noise", "unknown", "beginnings", "mutated", "strangers")
            return [made._datagram(name, 0) for _ in range(20) for name in names]

    assert sent(1) == sent(1)
    assert sent(1) != sent(2)


def test_an_account_that_does_not_add_up_fails_the_run() -> None:
    good = hostile.Account("datagrams", 10, {"read": 7, "lost in the kernel": 3})
    bad = hostile.Account("datagrams", 10, {"read": 7, "lost in the kernel": 2})
    reading = Reading([Arrival(0, 1_000_000)] * 5, [(0, 0), (10**9, 0)])
    for accounts, well in (([good], True), ([good, bad], False)):
        result = hostile.Result({"noise": 4}, accounts, reading, [])
        assert result.good() == well
        assert hostile.row("noise", result).endswith(f"| {0 if well else 1} |")
    assert not hostile.Result({}, [good], reading, ["the port was taken once"]).good()
