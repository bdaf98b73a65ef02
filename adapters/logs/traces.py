"""Writes recordings of others as logs that fusiond reads: a MAVLink .tlog, a candump .log, and a truth .csv."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from fusiond.units import MICROSECOND
from fusiond_adapters.logs.write import ACCEL_AND_GYRO, COMPONENT, TRUTH_COLUMNS, TRUTH_ROW
from fusiond_adapters.mavlink.tlog_record import tlog_record

SYSTEM = 1
MAGNETOMETER = 0x1C0  # HIGHRES_IMU.fields_updated
FIX_3D = 3
UNKNOWN_16 = 65_535
SATELLITES = 15  # of fixes that do not give their number
SECOND_US = 1_000_000
FRAMES = 256  # of a link, until its counter begins anew

Array = NDArray[np.float64]
Stamped = tuple[int, common.MAVLink_message]  # receipt [us, Unix], message


class Fix(NamedTuple):
    """One GNSS fix as the receiver gave it; accuracies are 0 where it gave none."""

    lat_deg: float
    lon_deg: float
    height_m: float
    speed_mps: float
    course_deg: float
    horizontal_m: float = 0.0
    velocity_mps: float = 0.0


class Poses(NamedTuple):
    """A reference track."""

    unix_us: NDArray[np.int64]  # (N,)
    lat_deg: Array  # (N,)
    lon_deg: Array
    height_m: Array
    velocity_n: Array  # (N, 3) m/s, north-east-down
    euler_deg: Array  # (N, 3) roll, pitch, yaw


def imu_message(
    boot_us: int, force: Sequence[float], rate: Sequence[float], gauss: Sequence[float] | None = None
) -> common.MAVLink_message:
    """A sample in forward-right-down: m/s^2, rad/s and, where there is one, the magnetic field."""
    fields = ACCEL_AND_GYRO | (MAGNETOMETER if gauss is not None else 0)
    pressure_and_temperature = (0.0,) * 4
    return common.MAVLink_highres_imu_message(
        boot_us, *force, *rate, *(gauss if gauss is not None else (0.0,) * 3), *pressure_and_temperature, fields
    )


def fix_message(stamp_us: int, fix: Fix) -> common.MAVLink_message:
    """A fix with its stamp, Unix or boot time."""
    height_mm = round(fix.height_m * 1e3)
    return common.MAVLink_gps_raw_int_message(
        time_usec=stamp_us,
        fix_type=FIX_3D,
        lat=round(fix.lat_deg * 1e7),
        lon=round(fix.lon_deg * 1e7),
        alt=height_mm,
        eph=UNKNOWN_16,
        epv=UNKNOWN_16,
        vel=round(fix.speed_mps * 100),
        cog=round(fix.course_deg % 360 * 100) % 36_000,
        satellites_visible=SATELLITES,
        alt_ellipsoid=height_mm,
        h_acc=round(fix.horizontal_m * 1e3),
        vel_acc=round(fix.velocity_mps * 1e3),
    )


def clock_messages(first_us: int, last_us: int, boot_at_us: int) -> Iterator[Stamped]:
    """A heartbeat and the time at each full second of boot time; `boot_at_us` is the Unix time of the boot."""
    first = -((boot_at_us - first_us) // SECOND_US)
    for second in range(first, (last_us - boot_at_us) // SECOND_US + 1):
        t_us = boot_at_us + second * SECOND_US
        yield (
            t_us,
            common.MAVLink_heartbeat_message(
                common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_GENERIC, 0, 0, common.MAV_STATE_ACTIVE, 3
            ),
        )
        yield t_us, common.MAVLink_system_time_message(t_us, second * 1000)


def write_messages(path: Path, messages: Iterable[Stamped]) -> None:
    """A .tlog of messages, put in the order of their receipt. Raises OSError."""
    link = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    with path.open("wb") as file:
        for number, (t_us, message) in enumerate(sorted(messages, key=itemgetter(0))):
            link.seq = number % FRAMES
            file.write(tlog_record(message.pack(link), t_us * MICROSECOND))


def write_frames(path: Path, frames: Iterable[tuple[int, int, int, bytes]]) -> None:
    """A candump .log of frames in their order: receipt [us], number of the bus, identifier, data. Raises OSError."""
    with path.open("w", encoding="ascii", newline="\n") as file:
        for t_us, bus, identifier, data in frames:
            digits = 3 if identifier < 0x800 else 8
            stamp = f"({t_us // SECOND_US}.{t_us % SECOND_US:06d})"
            file.write(f"{stamp} can{bus} {identifier:0{digits}X}#{data.hex().upper()}\n")


def write_poses(path: Path, poses: Poses) -> None:
    """A truth .csv. Raises OSError."""
    places = np.column_stack([poses.lat_deg, poses.lon_deg, poses.height_m, poses.velocity_n, poses.euler_deg])
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(TRUTH_COLUMNS + "\n")
        for t_us, row in zip(poses.unix_us.tolist(), places.tolist(), strict=True):
            if all(map(math.isfinite, row)):
                file.write(TRUTH_ROW % (t_us, *row))
