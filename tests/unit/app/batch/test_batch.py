"""A whole batch: every drive has its row, from every engine the same bytes, whatever is killed; and the verdict."""

from __future__ import annotations

import io
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import duckdb
import fsspec
import pandas as pd
import polars as pl
import pytest

from fusiond.__main__ import main
from fusiond.app.batch.batch import ROWS, SUMMARY, Order, Result, run
from fusiond.app.batch.engines import Cluster, Engine, LocalPool, Numbered
from fusiond.app.batch.job import OWN, Answer, Limits, Options
from fusiond.app.batch.row import Row
from fusiond.app.batch.table import read_rows
from fusiond.config import load, recorded
from tests.helpers import fleet

LIMITS = Limits(seconds=1.0, memory_mb=300.0)
OPTIONS = Options(rate_hz=5.0)
REASONS = [  # of the bad drives, in their order
    ("failed", "drive.log: is empty"),
    ("failed", "drive.tlog: no MAVLink frame in it; is it a .tlog?"),
    ("failed", "no state: "),
    ("timed out", "more than 1 s of processor time"),
    ("out of memory", "more than 300 MB"),
]


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten drives, five of them bad."""
    folder = tmp_path_factory.mktemp("fleet")
    made = fleet.drives(folder, range(10))
    for drive, spoil in zip(made, (fleet.empty, fleet.garbage, fleet.lost_imu, fleet.endless, fleet.hungry), strict=False):
        spoil(drive)
    return folder


def order(drives: Path, out: Path, **more: object) -> Order:
    return Order([str(drives)], out, options=OPTIONS, limits=LIMITS, **more)  # type: ignore[arg-type]


def done(wanted: Order, engine: Engine) -> tuple[Result, bytes]:
    with engine:
        result = run(wanted, engine, io.StringIO())
    return result, (wanted.folder / ROWS).read_bytes()


@pytest.fixture(scope="module")
def undisturbed(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """The folder and the rows of a batch by one worker."""
    out = tmp_path_factory.mktemp("out")
    result, content = done(order(drives, out), LocalPool(1))
    assert result.made == 10
    return out, content


def test_every_drive_has_its_row_and_the_right_reason(undisturbed: tuple[Path, bytes]) -> None:
    rows = [row for _, _, row in read_rows(undisturbed[0] / ROWS)]
    for row, (status, reason) in zip(rows, [*REASONS, *[("ok", "")] * 5], strict=True):
        assert row.status == status and row.reason.startswith(reason) and bool(row.reason) == bool(reason)
    good = rows[-1]
    assert good.reference == "truth" and good.config == "fusiond.toml" and good.vehicle == "simulated"
    assert good.position_rmse_m is not None and 0.05 < good.position_rmse_m < 3.0
    assert good.nees is not None and good.states > 50 and good.nominal is not None and good.nominal > 0.5
    assert {source.name for source in good.sources} >= {"imu0", "gps0.position", "rear_left"}
    assert {one.name for one in good.calibration} >= {"wheel_scale", "mount_pitch_deg"}
    assert good.seconds == pytest.approx(12.0, abs=0.5) and good.distance_m == pytest.approx(135, abs=15)


@pytest.mark.parametrize("engine", ["local", "dask"])
def test_every_engine_gives_the_same_bytes(
    engine: str, drives: Path, undisturbed: tuple[Path, bytes], tmp_path: Path
) -> None:
    _, content = done(order(drives, tmp_path), LocalPool(3) if engine == "local" else Cluster(None, 2))
    assert content == undisturbed[1]


def test_a_batch_that_is_killed_goes_on(drives: Path, undisturbed: tuple[Path, bytes], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fusiond", "batch", str(drives), "-o", str(tmp_path), "--rate", "5"]
    command += ["--seconds", "1", "--memory", "300", "--workers", "2"]
    dice = random.Random(5)
    for _ in range(3):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            time.sleep(dice.uniform(0.2, 3.0))
            process.send_signal(signal.SIGKILL)
    done_now = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "10 drives: 5 ok, 3 failed, 1 timed out, 1 out of memory" in done_now.stdout
    assert (tmp_path / ROWS).read_bytes() == undisturbed[1]


def test_what_is_done_is_not_done_again(drives: Path, undisturbed: tuple[Path, bytes]) -> None:
    out, content = undisturbed
    assert done(order(drives, out), LocalPool(1))[1] == content
    result, again = done(order(drives, out), LocalPool(1))
    assert (result.made, again) == (0, content)
    wider = Order([str(drives)], out, options=OPTIONS, limits=Limits(seconds=1.2, memory_mb=300.0))
    result, _ = done(wider, LocalPool(1))
    assert result.made == 2  # those that ran into the other limits
    other = Order([str(drives)], out, options=Options(rate_hz=4.0), limits=LIMITS)
    with LocalPool(1) as engine:
        taken = Dry()
        run(other, taken, io.StringIO())
        assert taken.count == 10
        run(order(drives, out), engine, io.StringIO())
    assert (out / ROWS).read_bytes() == content


class Dry(Engine):
    """Answers at once, without a replay."""

    def __init__(self) -> None:
        self.count = 0

    def answers(self, jobs: Iterable[Numbered]) -> Iterator[tuple[str, Answer]]:
        for key, job in jobs:
            self.count += 1
            yield key, Answer(row=Row(status="ok", **job.known()))

    def close(self) -> None:
        """Nothing runs."""


def test_a_worse_configuration_ends_with_a_status_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet.drives(tmp_path / "fleet", range(20, 34), 20.0)
    old = fleet.configuration(tmp_path, "old.toml")
    new = fleet.configuration(tmp_path, "new.toml", ("position_sigma_m = 0.539", "position_sigma_m = 1.617"))
    command = ["batch", str(tmp_path / "fleet"), "-o", str(tmp_path / "out"), "--rate", "2", "--workers", "1"]
    command += ["--reports", "1"]
    assert main([*command, "--config", str(new), "--baseline", str(old)]) == 3
    said = capsys.readouterr().out
    assert "NEW is significantly worse" in said and "14 drives: 14 ok" in said
    page = (tmp_path / "out" / SUMMARY).read_text()
    assert "NEW is significantly worse" in page and page.count("<svg") == 5
    assert not re.search(r"""(?:src|href)=["'](?!#)""", page.replace("xlink:href", "href").replace('<a href="reports/', ""))
    ((drive, where),) = re.findall(r'<a href="(.*?)">(.*?)</a>', page)
    assert "<html" in (tmp_path / "out" / drive).read_text() and where.startswith(str(tmp_path / "fleet"))
    command[-1] = "0"
    assert main([*command, "--config", str(old), "--baseline", str(old)]) == 0
    assert "no significant difference" in capsys.readouterr().out
    assert main([*command, "--config", str(old), "--baseline", str(tmp_path / "out" / ROWS)]) == 2  # would be overwritten
    elsewhere = [*command[:3], str(tmp_path / "other"), *command[4:]]
    assert main([*elsewhere, "--config", str(new), "--baseline", str(tmp_path / "out" / ROWS)]) == 3


def test_rows_are_read_by_others_in_a_line(undisturbed: tuple[Path, bytes]) -> None:
    path = str(undisturbed[0] / ROWS)
    counts = Counter(ok=5, failed=3) | Counter({"timed out": 1, "out of memory": 1})
    assert dict(duckdb.sql(f"select status, count(*) from '{path}' group by all").fetchall()) == counts
    assert pd.read_parquet(path)["status"].value_counts().to_dict() == counts
    assert dict(pl.read_parquet(path)["status"].value_counts().iter_rows()) == counts


def test_tracks_and_outages(tmp_path: Path) -> None:
    (drive,) = fleet.drives(tmp_path / "fleet", range(1), 150.0)
    options = Options(rate_hz=5.0, outage="100m", tracks=True)
    wanted = Order([str(drive)], tmp_path / "out", config=OWN, options=options)
    done(wanted, LocalPool(1))
    ((_, key, row),) = read_rows(tmp_path / "out" / ROWS)
    assert row.track == f"{key}.parquet"
    track = pd.read_parquet(tmp_path / "out" / "tracks" / row.track)
    assert len(track) > 200 and track["error_north_m"].abs().max() < 5
    (outage,) = row.outages
    assert 100 <= outage.distance_m < 105 and 60 <= outage.start_s < outage.stop_s < 120 and outage.error_m < 3
    (drive / "truth.csv").unlink()
    done(wanted, LocalPool(1))
    ((_, _, blind),) = read_rows(tmp_path / "out" / ROWS)
    assert (blind.reference, blind.position_rmse_m) == ("", None)
    assert blind.distance_m == pytest.approx(row.distance_m, rel=0.02)
    assert blind.outages[0].error_m == pytest.approx(outage.error_m, abs=1.5)
    assert row.outage_68_percent is not None and 0 < row.outage_68_percent < 5


@pytest.mark.parametrize("where", ["folder", "store"])
def test_recordings_of_a_black_box_are_taken_as_they_lie(where: str, tmp_path: Path) -> None:
    """With the configuration that each was recorded with, whose DBC files lie beside it under other names."""
    made = fleet.drives(tmp_path / "drives", range(2))
    box = tmp_path / "box"
    box.mkdir()
    for number, drive in enumerate(made, 1):
        for second, name in enumerate(("fcu.tlog", "can.log")):
            source = drive / ("drive.tlog" if name == "fcu.tlog" else "drive.log")
            (box / f"{number:04d}-20260301T08000{second}.000000Z-{name}").write_bytes(source.read_bytes())
        for name, content in recorded.files(load.load(drive / "fusiond.toml")):
            (box / f"{number:04d}-20260301T080000.000000Z-{name}").write_bytes(content)
    given = str(box)
    if where == "store":
        store = fsspec.filesystem("local")  # by an URL, so that each drive's process fetches its files
        given = store.unstrip_protocol(given)
    done(Order([given], tmp_path / "out", options=OPTIONS), LocalPool(1))
    found = list(read_rows(tmp_path / "out" / ROWS))
    assert [(name.rpartition("/")[2], row.status, row.reason) for name, _, row in found] == [
        ("0001", "ok", ""), ("0002", "ok", ""),
    ]  # fmt: skip
    assert all(row.config == "config.json" and row.states > 50 for _, _, row in found)
    assert "front_left" in {source.name for source in found[0][2].sources if source.fused}


def test_without_a_truth_the_smoother_is_the_reference(tmp_path: Path) -> None:
    (drive,) = fleet.drives(tmp_path / "fleet", range(1), 60.0)
    done(Order([str(drive)], tmp_path / "out", options=OPTIONS), LocalPool(1))
    ((_, _, true),) = read_rows(tmp_path / "out" / ROWS)
    (drive / "truth.csv").unlink()
    wanted = Order([str(drive)], tmp_path / "out", baseline=OWN, options=Options(rate_hz=5.0, smooth=True))
    done(wanted, LocalPool(1))
    ((_, _, row),) = read_rows(tmp_path / "out" / ROWS)
    ((_, _, old),) = read_rows(tmp_path / "out" / "baseline.parquet")
    assert row == old and row.reference == "smoother"
    assert row.position_rmse_m is not None and 0.01 < row.position_rmse_m < 2.0
    assert (true.reference, row.states) == ("truth", true.states)


@pytest.mark.parametrize(
    ("arguments", "code", "why"),
    [
        (["nowhere"], 1, "nowhere: nothing there"),
        (["."], 1, r".: no logs there"),
        ([".", "--config", "none.toml"], 2, "none.toml: cannot be read"),
        ([".", "--outage", "5km"], 2, "'5km' is not the length of an outage"),
        ([".", "--baseline", "none.parquet"], 1, "none.parquet: there is no such file"),
        ([".", "--workers", "0"], 2, "'0' is not a whole number of at least 1"),
        ([".", "--scheduler", "tcp://127.0.0.1:1"], 1, "no Dask scheduler answers"),
    ],
)
def test_what_cannot_begin_is_told(
    arguments: list[str], code: int, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    try:
        ended = main(["batch", *arguments, "-o", "out"])
    except SystemExit as wrong_usage:
        ended = int(str(wrong_usage.code))
    assert (ended, why in capsys.readouterr().err) == (code, True)
