"""The autopilot's own estimate in a log, to compare fusiond's with: `own_estimate(path)`.

.tlog   GLOBAL_POSITION_INT
.bin    XKF1, NKF1 or EKF1 (the first core), from the origin of ORGN; where the log has none, from the origin that puts it on
        the fixes in the median
.ulg    vehicle_local_position with vehicle_attitude

It is for comparing, and no input. Stamps are on the time line of a replay of the same file: when it was received or logged.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pymavlink.dialects.v20.ardupilotmega as dialect

from fusiond.events import FIX_3D, Received, Vector3
from fusiond.maths.wgs84 import radii
from fusiond.units import MICROSECOND
from fusiond_adapters.logs import dataflash, ulog
from fusiond_adapters.logs.autopilot_log import Array
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.tlog import read_tlog
from fusiond_adapters.mavlink.decoder import MAGIC_2, Dialect, message_id

ESTIMATES = ("XKF1", "NKF1", "EKF1")  # of a .bin, the newest first
MESSAGE = dialect.MAVLink_global_position_int_message
UNKNOWN_HEADING = 65535


class OwnState(NamedTuple):
    """What the autopilot held for true at one instant."""

    t_ns: int
    latitude: float  # rad
    longitude: float  # rad
    height: float  # m, above the mean sea level
    velocity_n: Vector3  # m/s, north, east, down
    yaw: float  # rad, clockwise from north; nan where it is not known


def own_estimate(path: str | Path) -> Iterator[OwnState]:
    """The states of a .tlog, .bin or .ulg (.gz, .zst), in the order of the log. Raises LogError, also if there are none."""
    log = LogFile(path)
    readers = {".tlog": _of_tlog, ".bin": _of_dataflash, ".ulg": _of_ulog}
    if log.suffix not in readers:
        raise LogError(f"{log.path}: no autopilot's estimate is in such a log; it is in {', '.join(readers)}")
    count = 0
    for state in readers[log.suffix](log):
        count += 1
        yield state
    if not count:
        raise LogError(f"{log.path}: the autopilot's own estimate is not in it")


# --- .tlog


class _Frames:
    """In place of a decoder of sensors: the position messages of the first system that sends them, as states."""

    def __init__(self) -> None:
        self.dialect = Dialect("ardupilotmega")
        self.states: list[OwnState] = []
        self._system: int | None = None

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        """Takes a frame."""
        if message_id(frame) == MESSAGE.id and self.dialect.sound(frame):
            system = frame[5] if frame[0] == MAGIC_2 else frame[3]
            self._system = self._system or system
            if system == self._system:
                self._take(dialect.MAVLink(None).decode(bytearray(frame)), t_receive_ns)
        return []

    def decode_by_header(
        self, number: int, _counter: int, _system: int, _component: int, frame: bytes, t_receive_ns: int
    ) -> list[Received]:
        """The same, of a frame whose header has been read."""
        return self.decode(frame, t_receive_ns) if number == MESSAGE.id else []

    def _take(self, message: Any, t_ns: int) -> None:
        velocity = (message.vx / 1e2, message.vy / 1e2, message.vz / 1e2)
        yaw = math.nan if message.hdg == UNKNOWN_HEADING else math.radians(message.hdg / 1e2)
        place = math.radians(message.lat / 1e7), math.radians(message.lon / 1e7), message.alt / 1e3
        self.states.append(OwnState(t_ns, *place, velocity, yaw))


def _of_tlog(log: LogFile) -> Iterator[OwnState]:
    frames = _Frames()
    for _ in read_tlog(log, frames):
        yield from frames.states
        frames.states.clear()
    yield from frames.states


# --- .bin


def _of_dataflash(log: LogFile) -> Iterator[OwnState]:
    tables = _gathered(log)
    name = next((name for name in ESTIMATES if name in tables), None)
    if name is None:
        return
    columns = tables[name]
    t_us = dataflash.log_time_us(name, columns)
    local = np.stack([columns[key] for key in ("PN", "PE", "PD")], 1).astype(float)
    origin = _origin(tables, t_us, local)
    if origin is None:
        return
    velocity = np.stack([columns[key] for key in ("VN", "VE", "VD")], 1).astype(float)
    base_ns = dataflash.boot_unix_ns(log)
    yield from _states(base_ns + t_us * MICROSECOND, origin, local, velocity, np.radians(columns["Yaw"].astype(float)))


def _gathered(log: LogFile) -> dict[str, dict[str, Array]]:
    """The columns of the estimate's first core, of the origin, and of the fixes."""
    parts: dict[str, list[Mapping[str, Array]]] = {}
    for records in dataflash.pieces(log, Counter()):
        for name in records.keys() & {*ESTIMATES, "ORGN", "GPS"}:
            columns = records[name].columns
            first = next((columns[key] == 0 for key in ("C", "I") if key in columns and name != "ORGN"), None)
            parts.setdefault(name, []).append({k: c if first is None else c[first] for k, c in columns.items()})
    return {name: {key: np.concatenate([part[key] for part in some]) for key in some[0]} for name, some in parts.items()}


def _origin(tables: Mapping[str, Mapping[str, Array]], t_us: Array, local: Array) -> Vector3 | None:
    """Latitude, longitude [rad] and height [m] of the estimate's origin."""
    if "ORGN" in tables:
        place = tables["ORGN"]
        own = place["Type"] == 0 if "Type" in place else np.ones(len(place["Lat"]), bool)  # 1: home
        if own.any():
            lat_deg, lon_deg, height = (float(place[key][own][-1]) for key in ("Lat", "Lng", "Alt"))
            return math.radians(lat_deg), math.radians(lon_deg), height
    fixes = tables.get("GPS", {})
    good = fixes["Status"] >= FIX_3D if "Status" in fixes else np.zeros(0, bool)
    if not good.any():
        return None
    latitude, longitude = (np.radians(fixes[key][good]) for key in ("Lat", "Lng"))
    when_us = dataflash.log_time_us("GPS", fixes)[good]
    north, east, down = (np.interp(when_us, t_us, part) for part in local.T)
    meridian, transverse = radii(float(np.median(latitude)))
    level = float(np.median(fixes["Alt"][good] + down))
    around = (transverse + level) * math.cos(float(np.median(latitude)))
    return float(np.median(latitude - north / (meridian + level))), float(np.median(longitude - east / around)), level


# --- .ulg


def _of_ulog(log: LogFile) -> Iterator[OwnState]:
    topics = ulog.read_topics(log, (*ulog.RECEIVERS, "vehicle_local_position", "vehicle_attitude"))
    columns, attitude = topics.get(("vehicle_local_position", 0)), topics.get(("vehicle_attitude", 0))
    if columns is None:
        return
    known = columns["xy_global"].astype(bool) if "xy_global" in columns else np.isfinite(columns["ref_lat"])
    t_us, columns = columns["timestamp"].astype(np.int64)[known], {key: column[known] for key, column in columns.items()}
    if not len(t_us):
        return
    latitude, longitude, height = (float(columns[key][-1]) for key in ("ref_lat", "ref_lon", "ref_alt"))
    origin = math.radians(latitude), math.radians(longitude), height
    local = np.stack([columns[key] for key in "xyz"], 1).astype(float)
    velocity = np.stack([columns[f"v{key}"] for key in "xyz"], 1).astype(float)
    yaw = np.full(len(t_us), math.nan)
    if attitude is not None and len(attitude["timestamp"]):
        w, x, y, z = (attitude[f"q[{part}]"].astype(float) for part in range(4))
        near = np.searchsorted(attitude["timestamp"], t_us).clip(max=len(w) - 1)
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))[near]
    yield from _states(ulog.boot_unix_ns(topics) + t_us * MICROSECOND, origin, local, velocity, yaw)


def _states(t_ns: Array, origin: Vector3, local: Array, velocity: Array, yaw: Array) -> Iterator[OwnState]:
    """States out of places about an origin: north, east, down [m]. Near it the Earth is a plane."""
    latitude, longitude, height = origin
    meridian, transverse = radii(latitude)
    north, east, down = local.T
    latitudes = latitude + north / (meridian + height)
    longitudes = longitude + east / ((transverse + height) * math.cos(latitude))
    columns = (t_ns, latitudes, longitudes, height - down, velocity, yaw)
    for t, lat, lon, up, (vn, ve, vd), turn in zip(*(column.tolist() for column in columns), strict=True):
        yield OwnState(t, lat, lon, up, (vn, ve, vd), turn)
