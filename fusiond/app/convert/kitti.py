"""A drive of KITTI's raw data (Geiger et al. 2013; cvlibs.net/datasets/kitti) as logs, a truth and a configuration.

A drive's folder `oxts` has timestamps.txt and data/0000000000.txt and so on, one line of 30 numbers each, as its
dataformat.txt says. Take the unsynchronised drive (`_extract`): it has the 100 Hz of the unit, the other 10 Hz. Positions
and velocities are those of the unit's own fusion with RTK, at the unit. So the truth is what the fixes are taken from: it
judges outages, not the fixes.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusiond.app.convert import Wanted
from fusiond.errors import UsageError
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.traces import (
    SECOND_US,
    Fix,
    Poses,
    Stamped,
    clock_messages,
    fix_message,
    imu_message,
    write_messages,
    write_poses,
)

COLUMNS = 30
LAT, LON, HEIGHT, ROLL, PITCH, YAW = range(6)
NORTH, EAST, UP = 6, 7, 10  # velocity
FORCE, RATE = slice(11, 14), slice(17, 20)  # forward, left, up
POSITION_ACCURACY, VELOCITY_ACCURACY = 23, 24
FIX_US = SECOND_US  # one fix a second
TO_FORWARD_RIGHT_DOWN = np.array([1.0, -1.0, -1.0])
CONFIGURATION = """\
# A KITTI drive, converted by `fusiond convert kitti`. The unit, an OXTS RT3003, gives its fixes at itself.

[vehicle]
name = "kitti"

[mavlink.oxts]
connection = "udpin:127.0.0.1:14550"  # for a live run; a replay reads the .tlog instead

[imu.imu0]
link = "oxts"
accel_noise = 0.02                    # [m/s^2/sqrt(Hz)], with the vibration of a car
gyro_noise = 5e-4                     # [rad/s/sqrt(Hz)]

[gnss.gps0]
link = "oxts"
interval_s = 1.0                      # the rate of the fixes that were taken
"""

Array = NDArray[np.float64]


def convert(wanted: Wanted) -> list[Path]:
    """Write drive.tlog, truth.csv and fusiond.toml. Raises LogError, UsageError, OSError."""
    if wanted.at_arrival:
        raise UsageError("--arrival: the drives of KITTI do not say when a fix arrived")
    unix_us, table = _drive(_oxts(wanted.folder))
    since_s = (unix_us - unix_us[0]) / SECOND_US
    kept = (since_s >= wanted.start_s) & (since_s < wanted.stop_s)
    if not kept.any():
        raise LogError(f"{wanted.folder}: lasts {since_s[-1]:.1f} s, so nothing is left of it")
    unix_us, table = unix_us[kept], table[kept]
    wanted.out.mkdir(parents=True, exist_ok=True)
    tlog, truth, config = paths = [wanted.out / name for name in ("drive.tlog", "truth.csv", "fusiond.toml")]
    write_messages(tlog, _messages(unix_us, table))
    write_poses(truth, _poses(unix_us, table))
    config.write_text(CONFIGURATION, encoding="utf-8")
    return paths


def _oxts(folder: Path) -> Path:
    found = [path for path in (folder, folder / "oxts") if (path / "timestamps.txt").is_file()]
    if not found:
        raise LogError(f"{folder}: holds no oxts/timestamps.txt, so is no drive of KITTI's raw data")
    return found[0]


def _drive(oxts: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) [us] and samples (N, 30). The stamps have no zone, and are taken as UTC."""
    lines = (oxts / "timestamps.txt").read_text(encoding="ascii").splitlines()
    files = sorted((oxts / "data").glob("*.txt"))
    if not files or len(lines) < len(files):
        raise LogError(f"{oxts}: {len(files)} samples and {len(lines)} stamps")
    rows = [_row(path) for path in files]
    stamps = [_unix_us(line, oxts / "timestamps.txt") for line in lines[: len(files)]]
    order = np.argsort(stamps, kind="stable")  # some are exchanged in the unsynchronised drives
    return np.array(stamps, dtype=np.int64)[order], np.array(rows)[order]


def _row(path: Path) -> list[float]:
    try:
        row = [float(cell) for cell in path.read_text(encoding="ascii").split()]
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error
    if len(row) != COLUMNS:
        raise LogError(f"{path}: {len(row)} numbers where {COLUMNS} are expected")
    return row


def _unix_us(line: str, path: Path) -> int:
    """Microseconds of a stamp such as 2011-09-26 13:02:25.594360375."""
    whole, _, fraction = line.strip().partition(".")
    try:
        second = int(datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp())
        return second * SECOND_US + int(f"{fraction:0<6}"[:6])
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error


def _messages(unix_us: NDArray[np.int64], table: Array) -> list[Stamped]:
    boot_us = int(unix_us[0])
    messages = list(clock_messages(boot_us, int(unix_us[-1]), boot_us))
    due_us = boot_us
    for t_us, row in zip(unix_us.tolist(), table, strict=True):
        force, rate = ((row[part] * TO_FORWARD_RIGHT_DOWN).tolist() for part in (FORCE, RATE))
        messages.append((t_us, imu_message(t_us - boot_us, force, rate)))
        if t_us >= due_us:
            due_us += FIX_US * ((t_us - due_us) // FIX_US + 1)
            speed, course = math.hypot(row[NORTH], row[EAST]), math.degrees(math.atan2(row[EAST], row[NORTH]))
            lat, lon, height = row[[LAT, LON, HEIGHT]].tolist()
            fix = Fix(lat, lon, height, speed, course, float(row[POSITION_ACCURACY]), float(row[VELOCITY_ACCURACY]))
            messages.append((t_us, fix_message(t_us, fix)))
    return messages


def _poses(unix_us: NDArray[np.int64], table: Array) -> Poses:
    """Yaw there is 0 to the east and counts to the left; pitch is positive with the front down."""
    velocity = np.column_stack([table[:, NORTH], table[:, EAST], -table[:, UP]])
    roll, pitch, yaw = np.degrees(table[:, [ROLL, PITCH, YAW]]).T
    euler = np.column_stack([roll, -pitch, (90.0 - yaw) % 360])
    return Poses(unix_us, table[:, LAT], table[:, LON], table[:, HEIGHT], velocity, euler)
