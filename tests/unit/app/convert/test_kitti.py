"""A small drive of the form of KITTI's raw data, made here, becomes logs that replay."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from fusiond.app.convert import Wanted
from fusiond.app.convert.kitti import convert
from fusiond.config import load as config
from fusiond.errors import UsageError
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.play import mavlink_records


def drive(folder: Path, samples: int = 250) -> Path:
    """A drive to the north-west, nose 0.01 rad down, left side 0.02 rad up."""
    (folder / "oxts" / "data").mkdir(parents=True)
    stamps = []
    for k in range(samples):
        stamps.append(f"2011-09-26 13:02:{25 + k // 100:02d}.{k % 100:02d}5360375")
        row = [0.0] * 30
        row[:6] = [49.5, 8.25, 112.5, 0.02, 0.01, 0.75 * math.pi]
        row[6:11] = [3.0, -3.0, math.sqrt(18), 0.0, 0.25]
        row[11:14], row[17:20] = [0.5, 1.0, 9.75], [0.125, 0.25, -0.5]
        row[23:25] = [0.05, 0.02]
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(repr, row)))
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    return folder


def messages(path: Path, kind: str) -> list[Any]:
    link = common.MAVLink(None)
    read = (link.parse_buffer(frame)[0] for _, frame in mavlink_records(path))
    return [one for one in read if one.get_type() == kind]


def test_axes_stamps_and_rates(tmp_path: Path) -> None:
    tlog, truth, _ = convert(Wanted(drive(tmp_path / "in"), tmp_path / "out", 0.0, math.inf))
    imu = messages(tlog, "HIGHRES_IMU")
    assert len(imu) == 250 and imu[1].time_usec == 10_000
    sample = imu[0]  # forward, right, down
    assert (sample.xacc, sample.yacc, sample.zacc) == (0.5, -1.0, -9.75)
    assert (sample.xgyro, sample.ygyro, sample.zgyro) == (0.125, -0.25, 0.5)
    fixes = messages(tlog, "GPS_RAW_INT")
    assert [fix.time_usec for fix in fixes] == [1_317_042_145_005_360 + k * 1_000_000 for k in range(3)]
    fix = fixes[0]
    assert (fix.lat, fix.lon, fix.alt_ellipsoid, fix.vel, fix.cog) == (495_000_000, 82_500_000, 112_500, 424, 31_500)
    assert (fix.h_acc, fix.vel_acc) == (50, 20)
    with truth.open() as file:
        first = next(csv.DictReader(file))
    attitude = [float(first[name]) for name in ("roll_deg", "pitch_deg", "yaw_deg")]
    assert attitude == pytest.approx([math.degrees(0.02), -math.degrees(0.01), 315.0], abs=1e-4)
    assert [float(first[name]) for name in ("vn_mps", "ve_mps", "vd_mps")] == [3.0, -3.0, -0.25]


def test_the_configuration_is_valid(tmp_path: Path) -> None:
    *_, path = convert(Wanted(drive(tmp_path / "in"), tmp_path / "out", 0.5, 1.5))
    assert config.load(path).sources() == ("gps0.position", "gps0.velocity", "imu0")
    assert len(messages(tmp_path / "out" / "drive.tlog", "HIGHRES_IMU")) == 100


def test_what_cannot_be_converted_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is no drive of KITTI"):
        convert(Wanted(tmp_path, tmp_path / "out", 0.0, math.inf))
    folder = drive(tmp_path / "in", samples=3)
    with pytest.raises(UsageError, match="--arrival"):
        convert(Wanted(folder, tmp_path / "out", 0.0, math.inf, at_arrival=True))
    with pytest.raises(LogError, match="nothing is left of it"):
        convert(Wanted(folder, tmp_path / "out", 60.0, math.inf))
    (folder / "oxts" / "data" / "0000000001.txt").write_text("1 2 3")
    with pytest.raises(LogError, match="3 numbers where 30 are expected"):
        convert(Wanted(folder, tmp_path / "out", 0.0, math.inf))
