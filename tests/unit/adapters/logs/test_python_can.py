"""The readers of python-can: every format gives the same wheels, and damage never raises."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest

from fusiond.events import WheelSpeed
from fusiond_adapters.logs.file import LogError
from tests.helpers.logs import START_US, WHEELS, events, written


@pytest.mark.parametrize("suffix", [".log", ".log.gz", ".asc", ".asc.gz", ".blf", ".trc", ".csv", ".csv.gz", ".db"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_every_can_format_gives_the_same_wheels(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"drive{suffix}")
    found, counts = events(path)
    assert [event.source for event in found] == list(WHEELS) * 40
    speeds = [event.payload.speed for event in found if isinstance(event.payload, WheelSpeed)]
    expected = [(3600 + 10 * number + wheel) * 0.01 / 3.6 for number in range(40) for wheel in range(4)]
    assert speeds == pytest.approx(expected)
    since_ms = [(event.t_receive_ns - found[0].t_receive_ns) / 1e6 for event in found[::4]]
    assert since_ms == pytest.approx([12.5 * number for number in range(40)], abs=0.01)
    assert abs(found[0].t_receive_ns / 1e9 - START_US / 1e6) < 1.0  # .asc: python-can writes the start to a second
    assert counts["other ids"] >= 80
    assert counts["decoded"] == 40


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".csv"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_bad_line_costs_at_most_the_next(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"drive{suffix}")
    lines = path.read_text().splitlines()
    middle = len(lines) // 2
    lines[middle] = lines[middle].replace("1", "G").replace("0", "G")
    path.write_text("\n".join(lines))
    found, _ = events(path)
    assert len(found) >= 4 * 39


@pytest.mark.parametrize(("suffix", "count"), [(".blf", 300), (".asc", 150), (".trc", 150), (".csv", 150), (".db", 60)])
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_damaged_can_logs_never_raise(tmp_path: Path, suffix: str, count: int) -> None:
    content, bad, dice = written(tmp_path / f"good{suffix}").read_bytes(), tmp_path / f"bad{suffix}", random.Random(7)
    outcomes: Counter[str] = Counter()
    for _ in range(count):
        broken = bytearray(content[: dice.randrange(1, len(content) + 1)])
        for _ in range(dice.randrange(5)):
            broken[dice.randrange(len(broken))] = dice.randrange(256)
        bad.write_bytes(broken)
        try:
            outcomes["read"] += len(events(bad)[0]) <= 4 * 41
        except LogError:
            outcomes["refused"] += 1
    assert outcomes.total() == count
