"""The readers of python-can: every format gives the same wheels, and damage never raises."""

from __future__ import annotations

import random
import sqlite3
import tracemalloc
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest

from fusiond.events import WheelSpeed
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.logs import START_US, WHEELS, configured, events, written


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


ROW = "1700000000.0,0xaa,0,0,0,8,AAAAAAAAAAA="
LONG = 8 << 20  # characters of a line


@pytest.mark.parametrize(
    ("suffix", "head"), [(".asc", "base hex timestamps absolute"), (".trc", ";$FILEVERSION=1.1"), (".csv", "timestamp")]
)
def test_a_text_without_line_ends_is_never_held_as_a_whole(tmp_path: Path, suffix: str, head: str) -> None:
    path = tmp_path / f"drive{suffix}"
    path.write_text(head + "\n" + "1" * LONG)
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match="no CAN frame in it"):
            events(path)
        assert tracemalloc.get_traced_memory()[1] < LONG / 2
    finally:
        tracemalloc.stop()


def test_a_long_line_costs_itself_alone(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(["timestamp", ROW, "x" * (1 << 17), ROW, ROW, ""]))
    found, counts = events(path)
    assert len(found) == 4 * 3
    assert counts == {"frames": 3, "bad lines": 1, "decoded": 3}


@pytest.mark.parametrize("seconds", ["9300000000", "4102444800", "-1"])  # the years 2264, 2100, 1969
def test_a_stamp_that_cannot_be_one_is_left_out_and_told(tmp_path: Path, seconds: str) -> None:
    path = tmp_path / "drive.csv"
    path.write_text("\n".join(["timestamp", ROW, *[ROW.replace("1700000000", seconds)] * 3, ROW, ""]))
    logs = open_logs([path], configured())
    assert len(list(logs)) == 4 * 2
    assert logs.counts[str(path)]["bad stamps"] == 3
    assert logs.warnings == [f"{path}: frames stamped before 1970 or after 2099 are left out"]


COLUMNS = "ts, arbitration_id, extended, remote, error, dlc, data"
ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x, 170, 0, 0, 0, 8, zeroblob(9e8) FROM n"


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        (f"CREATE VIEW messages AS {ENDLESS}", "its 'messages' is a view"),
        ("CREATE TABLE other(x)", "it has no table 'messages'"),
        (f"CREATE TABLE messages({COLUMNS} AS (zeroblob(9e8))); INSERT INTO messages VALUES (1, 2, 0, 0, 0, 8)", "too big"),
    ],
)
def test_a_database_gives_rows_of_a_table_alone(tmp_path: Path, sql: str, message: str) -> None:
    path = tmp_path / "drive.db"
    with closing(sqlite3.connect(path)) as base:
        base.executescript(sql)
    with pytest.raises(LogError, match=message):
        events(path)


def test_a_bad_row_costs_itself_alone(tmp_path: Path) -> None:
    path = tmp_path / "drive.db"
    with closing(sqlite3.connect(path)) as base:
        base.execute(f"CREATE TABLE messages({COLUMNS})")
        good = (1.7e9, 0xAA, 0, 0, 0, 8, bytes(8))
        base.executemany(
            "INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)",
            [good, ("now", *good[1:]), (*good[:1], "0xAA", *good[2:]), (*good[:6], 7.5), good],
        )
        base.commit()
    found, counts = events(path)
    assert len(found) == 4 * 2
    assert counts == {"frames": 2, "bad rows": 3, "decoded": 2}
