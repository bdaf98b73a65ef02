"""A segment of comma2k19 (Schafer et al. 2018, arXiv:1812.05752; github.com/commaai/comma2k19) as logs and a truth.

A segment has a folder `processed_log` of NumPy arrays: stamps `t` in seconds since the device's boot, which are those of
receipt, and values. Its `global_pose` holds the camera's poses after post-processing, and the GPS time of each frame: from
that comes the Unix time of the boot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.app.convert import Wanted
from fusiond.maths.rotation import euler, matrix, normalised
from fusiond.maths.wgs84 import geodetic, mat_ne
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.traces import (
    Fix,
    Poses,
    Stamped,
    clock_messages,
    fix_message,
    imu_message,
    write_frames,
    write_messages,
    write_poses,
)

GPS_EPOCH = 315_964_800  # s, Unix time of 1980-01-06
WEEK = 604_800  # s
LEAP_SECONDS = 18  # GPS less UTC since 2017; the drives are of 2018
MICROTESLA_PER_GAUSS = 100.0
BUSES = 2  # CAN buses of the car; higher numbers are the panda's own
NUMBER_OF_THE_CAR = range(0x580, 0x583)  # frames with its identification number: left out
FRAME = 8  # bytes
US = 1e6

Array = NDArray[np.float64]


def convert(wanted: Wanted) -> list[Path]:
    """Write drive.tlog, drive.candump.log and truth.csv. Raises LogError, OSError."""
    segment = Segment(_segment(wanted.folder), wanted)
    wanted.out.mkdir(parents=True, exist_ok=True)
    tlog, candump, truth = paths = [wanted.out / name for name in ("drive.tlog", "drive.candump.log", "truth.csv")]
    write_messages(tlog, segment.messages(wanted.at_arrival))
    write_frames(candump, segment.frames())
    write_poses(truth, segment.poses())
    return paths


def _segment(folder: Path) -> Path:
    """The folder that has processed_log: this one or the only one below it."""
    if (folder / "processed_log").is_dir():
        return folder
    found = sorted(path.parent for path in folder.rglob("processed_log"))
    if len(found) == 1:
        return found[0]
    if not found:
        raise LogError(f"{folder}: holds no segment of comma2k19, which has a folder processed_log")
    names = ", ".join(str(path.relative_to(folder)) for path in found[:4])
    raise LogError(f"{folder}: holds {len(found)} segments ({names}{', ...' if len(found) > 4 else ''}): name one")


class Segment:
    """The arrays of one segment, and the part of it that is wanted."""

    def __init__(self, folder: Path, wanted: Wanted) -> None:
        self._folder = folder
        self._force_t = self._array("processed_log/IMU/accelerometer/t", 1)
        if not len(self._force_t):
            raise LogError(f"{folder}: has no inertial samples")
        begin = float(self._force_t[0])
        self._start, self._stop = begin + wanted.start_s, begin + wanted.stop_s
        self._frame_t = self._array("global_pose/frame_times", 1)
        self._boot_at = self._boot_time()

    def messages(self, at_arrival: bool) -> Iterator[Stamped]:
        """HIGHRES_IMU, GPS_RAW_INT, and each second HEARTBEAT and SYSTEM_TIME."""
        last = min(self._stop, float(self._force_t[-1]))
        yield from clock_messages(self._unix_us(self._start), self._unix_us(last) - 1, self._unix_us(0.0))
        yield from self._inertial()
        yield from self._fixes(at_arrival)

    def _inertial(self) -> Iterator[Stamped]:
        force, rate = (self._array(f"processed_log/IMU/{name}/value", 2) for name in ("accelerometer", "gyro"))
        fields_t, fields = (self._array(f"processed_log/IMU/magnetometer/{name}", n) for name, n in (("t", 1), ("value", 2)))
        if not len(force) == len(rate) == len(self._force_t):
            raise LogError(f"{self._folder}: accelerometer and gyro have {len(force)} and {len(rate)} samples")
        gauss = dict(zip(np.searchsorted(self._force_t, fields_t).tolist(), fields / MICROTESLA_PER_GAUSS, strict=True))
        for place in self._wanted(self._force_t):
            t, field = float(self._force_t[place]), gauss.get(place)
            message = imu_message(
                int(t * US), force[place].tolist(), rate[place].tolist(), None if field is None else field.tolist()
            )
            yield self._unix_us(t), message

    def _fixes(self, at_arrival: bool) -> Iterator[Stamped]:
        """Of the u-blox: latitude, longitude, speed, Unix time [ms], altitude, bearing."""
        fixes_t = self._array("processed_log/GNSS/live_gnss_ublox/t", 1)
        fixes = self._array("processed_log/GNSS/live_gnss_ublox/value", 2)
        for place in self._wanted(fixes_t):
            lat, lon, speed, unix_ms, height, course = fixes[place].tolist()
            t = float(fixes_t[place])
            stamp_us = int(t * US) if at_arrival else int(unix_ms * 1e3)
            yield self._unix_us(t), fix_message(stamp_us, Fix(lat, lon, height, speed, course))

    def frames(self) -> Iterator[tuple[int, int, int, bytes]]:
        """All frames of the car's buses but those that name the car."""
        where = "processed_log/CAN/raw_can"
        t, identifiers, buses = (self._array(f"{where}/{name}", 1) for name in ("t", "address", "src"))
        data = self._array(f"{where}/data", 1)
        if data.dtype.itemsize != FRAME:
            raise LogError(f"{self._folder}/{where}/data: frames of {data.dtype.itemsize} bytes where {FRAME} are expected")
        content = data.tobytes()
        for place in self._wanted(t):
            bus, identifier = int(buses[place]), int(identifiers[place])
            if bus < BUSES and identifier not in NUMBER_OF_THE_CAR:
                yield self._unix_us(t[place]), bus, identifier, content[FRAME * place : FRAME * (place + 1)]

    def poses(self) -> Poses:
        """The camera's poses: position and velocity earth-fixed, and the quaternion from forward-right-down to there."""
        position, velocity = (self._array(f"global_pose/frame_{name}", 2) for name in ("positions", "velocities"))
        orientation = self._array("global_pose/frame_orientations", 2)
        rows = [_pose(position[place], velocity[place], orientation[place]) for place in self._wanted(self._frame_t)]
        table = np.array(rows).reshape(-1, 9)
        stamps = np.array([self._unix_us(t) for t in self._frame_t[self._wanted(self._frame_t)]], dtype=np.int64)
        return Poses(stamps, table[:, 0], table[:, 1], table[:, 2], table[:, 3:6], table[:, 6:])

    def _boot_time(self) -> float:
        """The Unix time of the device's boot [s]."""
        gps = self._array("global_pose/frame_gps_times", 2)
        if len(gps) != len(self._frame_t) or not len(gps):
            raise LogError(f"{self._folder}: global_pose has {len(gps)} GPS times of {len(self._frame_t)} frames")
        since_epoch = gps[:, 0] * WEEK + gps[:, 1]
        return GPS_EPOCH - LEAP_SECONDS + float(np.median(since_epoch - self._frame_t))

    def _unix_us(self, boot_s: float) -> int:
        return round((float(boot_s) + self._boot_at) * US)

    def _wanted(self, t: Array) -> NDArray[np.intp]:
        return np.flatnonzero((t >= self._start) & (t < self._stop))

    def _array(self, name: str, dimensions: int) -> NDArray[Any]:
        path = self._folder / name
        try:
            found: NDArray[Any] = np.load(path)
        except (OSError, ValueError, EOFError) as error:
            raise LogError(f"{path}: cannot be read as an array of NumPy: {error}") from error
        if found.ndim != dimensions:
            found = found.reshape(len(found), *(-1,) * (dimensions - 1)) if found.ndim else found
        if found.ndim != dimensions:
            raise LogError(f"{path}: has {found.ndim} dimensions where {dimensions} are expected")
        return found


def _pose(position_e: Array, velocity_e: Array, quaternion_eb: Array) -> tuple[float, ...]:
    """Latitude, longitude [deg], height [m], velocity north-east-down [m/s], roll, pitch, yaw [deg]."""
    latitude, longitude, height = geodetic(position_e)
    to_n = mat_ne(position_e)
    roll, pitch, yaw = (math.degrees(angle) for angle in euler(to_n @ matrix(normalised(quaternion_eb))))
    velocity = (to_n @ velocity_e).tolist()
    return math.degrees(latitude), math.degrees(longitude), height, *velocity, roll, pitch, yaw % 360
