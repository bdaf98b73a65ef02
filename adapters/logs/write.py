"""Writes a simulated drive to files in the real wire formats: .tlog, candump .log and DBC, with truth and configuration."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from fusiond.simulation import wheels
from fusiond.simulation.barometer import CENTI_CELSIUS
from fusiond.simulation.drive import Drive, simulate
from fusiond.simulation.gnss import UNKNOWN_16
from fusiond.simulation.matching import configuration, dbc
from fusiond.simulation.scenario import Scenario
from fusiond.simulation.transport import Stamps
from fusiond.simulation.truth import Truth
from fusiond.simulation.wire import SYSTEM, Telemetry
from fusiond.units import MICROSECOND, SECOND
from fusiond_adapters.mavlink.tlog_record import tlog_record

COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
ACCEL_AND_GYRO = 0x3F  # HIGHRES_IMU.fields_updated
HDOP, VDOP, SATELLITES = 80, 120, 14  # of a fix; the first two in hundredths
CHANNEL = "can0"
LINES_AT_ONCE = 4096  # of one id that are formatted together
TRUTH_COLUMNS = "unix_us,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg"
TRUTH_ROW = "%d,%.9f,%.9f,%.4f,%.5f,%.5f,%.5f,%.5f,%.5f,%.5f\n"

Stamped = Iterator[tuple[int, int, common.MAVLink_message]]  # receipt [us], frame counter, message


def write_drive(scenario: Scenario, directory: str | Path, seed: int | None = None) -> list[Path]:
    """Simulate a drive and write it; `seed` replaces the scenario's. The folder is created if missing.

    Returns the files: drive.tlog, drive.log, wheels.dbc, truth.csv, fusiond.toml. Raises OSError.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    drive = simulate(scenario, seed)
    names = ("drive.tlog", "drive.log", "wheels.dbc", "truth.csv", "fusiond.toml")
    tlog, candump, dbc_file, truth, config = paths = [folder / name for name in names]
    write_tlog(drive, tlog)
    write_candump(drive, candump)
    write_truth(drive.truth, scenario.truth_rate_hz, truth)
    dbc_file.write_text(dbc(scenario), encoding="utf-8")
    config.write_text(configuration(scenario, dbc_file.name), encoding="utf-8")
    return paths


def write_tlog(drive: Drive, path: Path) -> None:
    """The MAVLink messages in the order of receipt, as MAVLink 2 frames after their stamps."""
    link = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    telemetry = (_telemetry(drive.truth, stream) for stream in drive.telemetry)
    streams = (_imu(drive), _gnss(drive), _system_time(drive), _heartbeats(drive), _pressure(drive), *telemetry)
    with path.open("wb") as file:
        for t_us, counter, message in heapq.merge(*streams, key=itemgetter(0)):
            link.seq = counter
            file.write(tlog_record(message.pack(link), t_us * MICROSECOND))


def _imu(drive: Drive) -> Stamped:
    imu = drive.imu
    columns = (imu.t_receive_us, imu.counter, imu.time_us, imu.specific_force_b, imu.angular_rate_b)
    unused = (0.0,) * 7  # magnetometer, pressures, temperature
    for t_us, counter, time_us, force, rate in zip(*(column.tolist() for column in columns), strict=True):
        yield t_us, counter, common.MAVLink_highres_imu_message(time_us, *force, *rate, *unused, ACCEL_AND_GYRO, 0)


def _gnss(drive: Drive) -> Stamped:
    gnss, fixes = drive.gnss, drive.gnss.fixes
    fields = (fixes.fix_type, fixes.lat, fixes.lon, fixes.alt, fixes.alt_ellipsoid, fixes.vel, fixes.cog)
    columns = (gnss.t_receive_us, gnss.counter, gnss.time_us, *fields, fixes.h_acc, fixes.v_acc)
    for t_us, counter, time_us, fix_type, lat, lon, alt, ellipsoid, vel, cog, h_acc, v_acc in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        known = vel != UNKNOWN_16
        yield t_us, counter, common.MAVLink_gps_raw_int_message(
            time_usec=time_us,
            fix_type=fix_type,
            lat=lat,
            lon=lon,
            alt=alt,
            eph=HDOP if known else UNKNOWN_16,
            epv=VDOP if known else UNKNOWN_16,
            vel=vel,
            cog=cog,
            satellites_visible=SATELLITES if known else 0,
            alt_ellipsoid=ellipsoid,
            h_acc=h_acc,
            v_acc=v_acc,
            vel_acc=fixes.vel_acc,
        )


def _system_time(drive: Drive) -> Stamped:
    columns = (drive.time.t_receive_us, drive.time.counter, drive.time.unix_us, drive.time.boot_ms)
    for t_us, counter, unix_us, boot_ms in zip(*(column.tolist() for column in columns), strict=True):
        yield t_us, counter, common.MAVLink_system_time_message(unix_us, boot_ms)


def _heartbeats(drive: Drive) -> Stamped:
    columns = (drive.heartbeats.t_receive_us, drive.heartbeats.counter)
    for t_us, counter in zip(*(column.tolist() for column in columns), strict=True):
        yield t_us, counter, common.MAVLink_heartbeat_message(
            type=common.MAV_TYPE_GROUND_ROVER,
            autopilot=common.MAV_AUTOPILOT_GENERIC,
            base_mode=0,
            custom_mode=0,
            system_status=common.MAV_STATE_ACTIVE,
            mavlink_version=3,
        )


def _pressure(drive: Drive) -> Stamped:
    columns = (drive.barometer.t_receive_us, drive.barometer.counter, drive.barometer.boot_ms, drive.barometer.hectopascal)
    for t_us, counter, boot_ms, hectopascal in zip(*(column.tolist() for column in columns), strict=True):
        yield t_us, counter, common.MAVLink_scaled_pressure_message(boot_ms, hectopascal, 0.0, CENTI_CELSIUS)


def _telemetry(truth: Truth, stream: Telemetry) -> Stamped:
    make = TELEMETRY[stream.message]
    columns = (stream.t_receive_us, stream.counter, stream.boot_ms, stream.instant)
    for t_us, counter, boot_ms, row in zip(*(column.tolist() for column in columns), strict=True):
        yield t_us, counter, make(truth, row, boot_ms)


def _attitude(truth: Truth, row: int, boot_ms: int) -> common.MAVLink_message:
    return common.MAVLink_attitude_message(boot_ms, *truth.euler[row].tolist(), *truth.angular_rate_b[row].tolist())


def _global_position(truth: Truth, row: int, boot_ms: int) -> common.MAVLink_message:
    lat, lon = (round(math.degrees(angle[row]) * 1e7) for angle in (truth.latitude, truth.longitude))
    height_mm, velocity = round(truth.height[row] * 1e3), (round(v * 1e2) for v in truth.velocity_n[row].tolist())
    heading = round(math.degrees(truth.euler[row, 2]) * 1e2) % 36_000
    return common.MAVLink_global_position_int_message(boot_ms, lat, lon, height_mm, 0, *velocity, heading)


def _local_position(truth: Truth, row: int, boot_ms: int) -> common.MAVLink_message:
    down = truth.height[0] - truth.height[row]
    return common.MAVLink_local_position_ned_message(boot_ms, 0.0, 0.0, down, *truth.velocity_n[row].tolist())


def _altitude(truth: Truth, row: int, boot_ms: int) -> common.MAVLink_message:
    height = truth.height[row]
    return common.MAVLink_altitude_message(boot_ms * 1000, height, height, height - truth.height[0], 0.0, 0.0, 0.0)


def _vfr_hud(truth: Truth, row: int, _boot_ms: int) -> common.MAVLink_message:
    heading, climb = round(math.degrees(truth.euler[row, 2])) % 360, -truth.velocity_n[row, 2]
    return common.MAVLink_vfr_hud_message(0.0, truth.speed[row], heading, 50, truth.height[row], climb)


def _servos(_truth: Truth, _row: int, boot_ms: int) -> common.MAVLink_message:
    return common.MAVLink_servo_output_raw_message(boot_ms * 1000, 0, *(1500,) * 8)


def _sys_status(_truth: Truth, _row: int, _boot_ms: int) -> common.MAVLink_message:
    return common.MAVLink_sys_status_message(3, 3, 3, 420, 12_600, 350, 87, 0, 0, 0, 0, 0, 0)


TELEMETRY: dict[str, Callable[[Truth, int, int], common.MAVLink_message]] = {  # from truth, its row, and boot time [ms]
    "ATTITUDE": _attitude,
    "GLOBAL_POSITION_INT": _global_position,
    "LOCAL_POSITION_NED": _local_position,
    "ALTITUDE": _altitude,
    "VFR_HUD": _vfr_hud,
    "SERVO_OUTPUT_RAW": _servos,
    "SYS_STATUS": _sys_status,
}


def write_candump(drive: Drive, path: Path) -> None:
    """The CAN frames in the order of receipt, as `candump -L` writes them."""
    frames = drive.wheels
    data = wheels.frames(frames.raw, frames.fault, frames.counter)
    streams = [
        _lines(wheels.FRAME_ID, frames.t_receive_us, data),
        *(_lines(other.identifier, other.t_receive_us, other.data) for other in drive.chatter),
    ]
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(line for _, line in heapq.merge(*streams, key=itemgetter(0)))


def _lines(identifier: int, t_receive_us: Stamps, data: NDArray[np.uint64]) -> Iterator[tuple[int, str]]:
    for begin in range(0, len(data), LINES_AT_ONCE):
        block = slice(begin, begin + LINES_AT_ONCE)
        for t_us, word in zip(t_receive_us[block].tolist(), data[block].tolist(), strict=True):
            yield t_us, f"({t_us // 1_000_000}.{t_us % 1_000_000:06d}) {CHANNEL} {identifier:03X}#{word:016X}\n"


def write_truth(truth: Truth, rate_hz: float, path: Path) -> None:
    """The truth of the IMU, at most `rate_hz` lines a second; `unix_us` is the receiving host's time."""
    interval_ns = int(np.diff(truth.t_ns[:2]).sum()) or 1
    every = max(1, round(SECOND / rate_hz / interval_ns))
    angles = np.degrees(np.column_stack([truth.latitude, truth.longitude, truth.euler]))[::every]
    columns = (truth.t_ns // MICROSECOND, truth.height, truth.velocity_n)
    stamps, heights, velocities = (column[::every].tolist() for column in columns)
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(TRUTH_COLUMNS + "\n")
        for t_us, height, velocity, (lat, lon, *attitude) in zip(
            stamps, heights, velocities, angles.tolist(), strict=True
        ):
            file.write(TRUTH_ROW % (t_us, lat, lon, height, *velocity, *attitude))
