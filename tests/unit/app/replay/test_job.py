"""One `fusiond replay` of logs whose receipt stamps step back: two drives in one file, a host whose clock was set back."""

from __future__ import annotations

import csv
import re
from itertools import pairwise
from pathlib import Path

import pytest

from fusiond.app.replay.comparison import Window
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.summary import Summary, text
from fusiond.config import load as config
from fusiond.simulation.scenario import parse
from fusiond.units import SECOND
from fusiond_adapters.logs.play import mavlink_records
from fusiond_adapters.logs.write import write_drive
from fusiond_adapters.mavlink.tlog_record import STAMP

SCENARIO = """
[start]
speed_mps = 9.0
time_unix_s = {}
[[segment]]
duration_s = 12
turn_deg = 80.0
"""
START = 1_760_000_000
SETTLED = 4.0  # s: the state has started before
LOGS = ("drive.tlog", "drive.log")
LINE = re.compile(r"\((\d+)\.(\d{6})\)(.*)")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two drives, `second` an hour before `first`, and `both`: the files of the first, then the second."""
    folder = tmp_path_factory.mktemp("drives")
    for name, start, seed in (("first", START, 1), ("second", START - 3600, 2)):
        write_drive(parse(SCENARIO.format(start)), folder / name, seed)
    (folder / "both").mkdir()
    for log in LOGS:
        (folder / "both" / log).write_bytes(b"".join((folder / name / log).read_bytes() for name in ("first", "second")))
    return folder


def replayed(folder: Path, setup: Path, truth: Path, window: Window) -> Summary:
    options = Options(
        config=config.load(setup / "fusiond.toml"),
        config_name="fusiond.toml",
        logs=[str(folder / log) for log in LOGS],
        truth=truth / "truth.csv",
        csv=folder / "track.csv",
        mcap=folder / "track.mcap",
        window=window,
    )
    return replay(options)


def set_back(source: Path, target: Path, by_s: float, after_s: float) -> Path:
    """Logs as on a host whose clock is set back after some time of the drive."""
    target.mkdir()
    back_us, step_ns = round(by_s * 1e6), (START + after_s) * SECOND
    with (target / "drive.tlog").open("wb") as file:
        for t_ns, frame in mavlink_records(source / "drive.tlog"):
            file.write(STAMP.pack(t_ns // 1000 - (back_us if t_ns >= step_ns else 0)) + frame)
    with (target / "drive.log").open("w") as file:
        for line in (source / "drive.log").read_text().splitlines():
            found = LINE.fullmatch(line)
            assert found
            t_us = int(found[1] + found[2])
            t_us -= back_us if t_us * 1000 >= step_ns else 0
            file.write(f"({t_us // 10**6}.{t_us % 10**6:06d}){found[3]}\n")
    return target


def lost(summary: Summary) -> int:
    return sum(source.too_old + source.duplicate + source.invalid for source in summary.sources.values())


def test_the_second_drive_of_a_file_is_fused_as_by_itself(drives: Path) -> None:
    """Against its own truth, which lies an hour before that of the first."""
    second = drives / "second"
    own = replayed(second, second, second, Window(SETTLED))
    both = replayed(drives / "both", second, second, Window(12.0 + SETTLED))
    assert lost(both) == 0
    assert both.span.seconds == pytest.approx(24.0, abs=0.3)
    assert own.truth is not None and both.truth is not None
    assert both.truth.rows == pytest.approx(own.truth.rows, abs=10)
    assert both.truth.position.max_m < own.truth.position.max_m + 0.2
    assert both.truth.position.inside_95 >= 0.95


def test_it_is_said_once(drives: Path) -> None:
    both = replayed(drives / "both", drives / "first", drives / "first", Window())
    (step,) = both.steps_back
    assert (step.at_s, step.by_s) == (pytest.approx(12.1, abs=0.1), pytest.approx(3612.0, abs=1.0))
    assert text(both).count("step back by") == 1
    assert (both.final.resets, both.warnings) == (1, [])


def test_the_track_steps_back_once_and_loses_no_line(drives: Path) -> None:
    summary = replayed(drives / "both", drives / "first", drives / "first", Window())
    with (drives / "both" / "track.csv").open() as file:
        stamps = [int(row["unix_us"]) for row in csv.DictReader(file)]
    assert summary.published is not None and summary.published.skipped == 0
    assert len(stamps) == summary.published.rows
    steps = [after - before for before, after in pairwise(stamps)]
    assert sum(step < 0 for step in steps) == 1
    assert (drives / "both" / "track.mcap").stat().st_size > 0


@pytest.mark.parametrize("by_s", [0.3, 20.0, 3600.0, 86_400.0])
def test_a_clock_that_is_set_back_on_the_way_costs_an_alignment_only(drives: Path, tmp_path: Path, by_s: float) -> None:
    """Though GNSS time contradicts the host's from then on."""
    folder = set_back(drives / "first", tmp_path / "set", by_s, after_s=6.0)
    summary = replayed(folder, drives / "first", drives / "first", Window(SETTLED, 5.9))
    assert len(summary.steps_back) == 1
    assert lost(summary) == 0
    assert summary.final.mode.value == "nominal"
    assert summary.published is not None and summary.published.modes["aligning"] < 8 * 50
