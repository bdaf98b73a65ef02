"""A small segment of the form of comma2k19, made here, becomes logs with what was put into it."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from fusiond import __main__ as entry
from fusiond.app.convert import Wanted
from fusiond.app.convert.comma2k19 import convert
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.play import mavlink_records

BOOT_UNIX = 1_533_180_000.25  # s
GPS_LESS_UNIX = -315_964_800 + 18  # s, in 2018
WEEK = 604_800
BOOT = 5000.2  # s since the boot, of the first sample
SECOND = 10**9


def put(path: Path, values: Any) -> None:
    """Write an array, in a file without a suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.save(file, np.asarray(values))


def segment(folder: Path) -> Path:
    """Two seconds in which a camera stands at 0 N, 0 E, level, and looks east."""
    logs, poses = folder / "route|date" / "7" / "processed_log", folder / "route|date" / "7" / "global_pose"
    t = BOOT + np.arange(200) / 100
    put(logs / "IMU/accelerometer/t", t)
    put(logs / "IMU/accelerometer/value", np.column_stack([t - BOOT, 0 * t, 0 * t - 9.75]))
    put(logs / "IMU/gyro/t", t)
    put(logs / "IMU/gyro/value", np.tile([0.125, -0.25, 0.5], (len(t), 1)))
    put(logs / "IMU/magnetometer/t", t[::10])
    put(logs / "IMU/magnetometer/value", np.tile([25.0, 0.0, -50.0], (20, 1)))
    fixes = BOOT + np.array([0.3, 1.3])
    put(logs / "GNSS/live_gnss_ublox/t", fixes)
    unix_ms = (fixes - 0.08 + BOOT_UNIX) * 1e3
    put(logs / "GNSS/live_gnss_ublox/value", [[0.5, -1.25, 10.0, stamp, 33.5, -90.0] for stamp in unix_ms])
    put(logs / "CAN/raw_can/t", BOOT + np.array([0.5, 0.6, 0.7, 0.8]))
    put(logs / "CAN/raw_can/address", [0xAA, 0x581, 0xAA, 0x1F00DAF1])
    put(logs / "CAN/raw_can/src", [0, 0, 128, 1])
    data: NDArray[np.bytes_] = np.array([bytes(range(8)), b"VIN-0001", b"echoed  ", b"\x01" + bytes(7)], dtype="S8")
    put(logs / "CAN/raw_can/data", data)
    frames = BOOT + 0.01 + np.arange(40) / 20
    put(poses / "frame_times", frames)
    since = frames + BOOT_UNIX + GPS_LESS_UNIX
    put(poses / "frame_gps_times", np.column_stack([since // WEEK, since % WEEK]))
    put(poses / "frame_positions", np.tile([6378137.0 + 20.0, 0.0, 0.0], (40, 1)))
    put(poses / "frame_velocities", np.tile([-0.5, 3.0, 4.0], (40, 1)))  # earth-fixed: here up, east, north
    # forward = east = y, right = south = -z, down = -x: the rotation whose columns these are
    put(poses / "frame_orientations", np.tile([0.5, -0.5, -0.5, 0.5], (40, 1)))
    return folder


def messages(path: Path) -> list[tuple[int, Any]]:
    link = common.MAVLink(None)
    return [(t_ns, link.parse_buffer(frame)[0]) for t_ns, frame in mavlink_records(path)]


def test_all_sensors_arrive_with_their_times_and_units(tmp_path: Path) -> None:
    convert(Wanted(segment(tmp_path / "in"), tmp_path / "out", 0.0, math.inf))
    read = messages(tmp_path / "out" / "drive.tlog")
    stamps = [t_ns for t_ns, _ in read]
    assert stamps == sorted(stamps)
    imu = [(t_ns, one) for t_ns, one in read if one.get_type() == "HIGHRES_IMU"]
    assert len(imu) == 200
    t_ns, sample = imu[50]
    assert t_ns == pytest.approx((BOOT + 0.5 + BOOT_UNIX) * SECOND, abs=2000)
    assert sample.time_usec == pytest.approx((BOOT + 0.5) * 1e6, abs=1)
    assert (sample.xacc, sample.zacc) == pytest.approx((0.5, -9.75))
    assert (sample.xgyro, sample.ygyro, sample.zgyro) == (0.125, -0.25, 0.5)
    assert (sample.xmag, sample.zmag, sample.fields_updated) == (0.25, -0.5, 0x1FF)
    assert imu[51][1].fields_updated == 0x3F
    fixes = [(t_ns, one) for t_ns, one in read if one.get_type() == "GPS_RAW_INT"]
    t_ns, fix = fixes[1]
    assert t_ns - fix.time_usec * 1000 == pytest.approx(80e6, abs=2e6)  # received 80 ms after its time
    assert (fix.lat, fix.lon, fix.alt, fix.vel, fix.cog) == (5_000_000, -12_500_000, 33_500, 1000, 27_000)
    times = [one for _, one in read if one.get_type() == "SYSTEM_TIME"]
    assert [one.time_boot_ms for one in times] == [5_001_000, 5_002_000]
    assert times[0].time_unix_usec == pytest.approx((5001 + BOOT_UNIX) * 1e6, abs=2)


def test_frames_keep_their_bus_and_none_names_the_car(tmp_path: Path) -> None:
    convert(Wanted(segment(tmp_path / "in"), tmp_path / "out", 0.0, math.inf))
    lines = (tmp_path / "out" / "drive.candump.log").read_text().splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["can0 0AA#0001020304050607", "can1 1F00DAF1#0100000000000000"]


def test_the_truth_is_the_cameras_pose(tmp_path: Path) -> None:
    convert(Wanted(segment(tmp_path / "in"), tmp_path / "out", 0.0, math.inf))
    with (tmp_path / "out" / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40
    first = {name: float(value) for name, value in rows[0].items()}
    assert first["unix_us"] == pytest.approx((BOOT + 0.01 + BOOT_UNIX) * 1e6, abs=2)
    wanted = {"lat_deg": 0.0, "lon_deg": 0.0, "height_m": 20.0, "vn_mps": 4.0, "ve_mps": 3.0, "vd_mps": 0.5,
              "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0}  # fmt: skip
    assert {name: first[name] for name in wanted} == pytest.approx(wanted, abs=1e-6)


def test_a_part_and_stamps_of_arrival(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["convert", "comma2k19", str(segment(tmp_path / "in")), "-o", str(out), "--start", "0.5", "--stop", "1.5"]
    assert entry.main([*command, "--arrival"]) == 0
    assert "drive.candump.log" in capsys.readouterr().out
    read = messages(out / "drive.tlog")
    assert sum(one.get_type() == "HIGHRES_IMU" for _, one in read) == 100
    (fix,) = (one for _, one in read if one.get_type() == "GPS_RAW_INT")
    assert fix.time_usec == pytest.approx((BOOT + 1.3) * 1e6, abs=1)


def test_what_cannot_be_converted_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="holds no segment of comma2k19"):
        convert(Wanted(tmp_path, tmp_path / "out", 0.0, math.inf))
    folder = segment(tmp_path / "in")
    (folder / "route|date" / "7" / "processed_log" / "IMU" / "gyro" / "value").write_bytes(b"nothing")
    with pytest.raises(LogError, match="gyro/value: cannot be read as an array"):
        convert(Wanted(folder, tmp_path / "out", 0.0, math.inf))
    segment(tmp_path / "in" / "second")
    with pytest.raises(LogError, match="holds 2 segments"):
        convert(Wanted(folder, tmp_path / "out", 0.0, math.inf))
