"""Reader of .ulg, the logs of PX4, by pyulog (extra `ulog`). The wanted topics are held in memory as columns.

Used are sensor_combined, sensor_gps or vehicle_gps_position, vehicle_air_data or sensor_baro, and wheel_encoders (0 is the
right wheel, 1 the left one). Their angle times the wheel's `radius_m` is its distance. Counts: `dropouts` (spells that the
logger missed), `corrupt`, `decoded`.
"""

from __future__ import annotations

import importlib.util
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fusiond.config.schema import Barometer, DualAntenna, Gnss, Imu, Wheel
from fusiond.config.sensor import Sensor
from fusiond.events import FIX_3D, Received
from fusiond.units import MICROSECOND
from fusiond_adapters.logs.autopilot_log import (
    Array,
    AutopilotLog,
    Samples,
    gnss_fields,
    imu_fields,
    instance,
    pressure_fields,
    wheel_fields,
)
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading
from fusiond_adapters.mavlink.sensors import Handler

if TYPE_CHECKING:
    from fusiond_adapters.logs.survey import Survey

IMU, AIR, BAROMETER, ENCODERS = "sensor_combined", "vehicle_air_data", "sensor_baro", "wheel_encoders"
RECEIVERS = ("sensor_gps", "vehicle_gps_position")  # the first that the log has
TOPICS = (IMU, *RECEIVERS, AIR, BAROMETER, ENCODERS)
LEAST_PASCAL = 2000.0  # old logs have millibar
STANDARD_CELSIUS = 15.0
DAMAGE = (TypeError, ValueError, LookupError, AttributeError, EOFError, OSError, struct.error)  # of pyulog's reader

Topics = Mapping[tuple[str, int], Mapping[str, Array]]  # by name and instance


def open_log(opening: Opening) -> Reading:
    """The reading of a .ulg, by default of the first link. Raises LogError."""
    decoder = AutopilotLog(opening)
    return Reading("mavlink", [decoder], _events(opening.file, decoder))


def _events(log: LogFile, decoder: AutopilotLog) -> Iterator[list[Received]]:
    topics = read_topics(log, TOPICS)
    decoder.base_ns = boot_unix_ns(topics)
    samples = (_samples(section, handler, topics) for section, handler in decoder.sensors)
    yield from decoder.events(one for one in samples if one is not None)


def survey(found: Survey) -> None:
    """Add what is in a .ulg to a survey: a stream for each topic, by instance. Raises LogError."""
    found.protocol = "mavlink"
    topics = read_topics(found.file, ())
    base_ns = boot_unix_ns(topics)
    for (name, number), columns in topics.items():
        t_ns = base_ns + columns["timestamp"].astype(np.int64) * MICROSECOND
        found.add_all("autopilot", f"{name}[{number}]", t_ns.tolist())
    found.senders["autopilot"] = "PX4"


def read_topics(log: LogFile, names: tuple[str, ...]) -> Topics:
    """Topics of a log, or all, by name and instance. Raises LogError if it is none, or pyulog is missing."""
    if importlib.util.find_spec("pyulog") is None:
        raise LogError(f"{log.path}: reading .ulg needs the extra ulog: pip install 'fusiond[ulog]'")
    from pyulog import ULog  # noqa: PLC0415 - an extra, imported only where such a file is read
    from pyulog.exceptions import ULogException  # noqa: PLC0415

    with log.unzipped() as path, path.open("rb") as file:
        try:
            found: Any = ULog(file, list(names) or None)
        except (*DAMAGE, ULogException) as error:
            raise LogError(f"{log.path}: is not a ULog: {error}") from error
    if found.dropouts:
        log.counts["dropouts"] = len(found.dropouts)
        missed_s = sum(one.duration for one in found.dropouts) / 1e3
        log.warnings.append(f"{log.path}: its logger missed {len(found.dropouts)} spells, {missed_s:.2f} s in all")
    if found.file_corruption:
        log.counts["corrupt"] = 1
        log.warnings.append(f"{log.path}: is damaged; what follows the damage may be missing")
    return {(one.name, one.multi_id): one.data for one in found.data_list}


def boot_unix_ns(topics: Topics) -> int:
    """Unix time of the boot, by the first fix; 0 if there is none. A log does not tell how late a fix came."""
    for (name, _), columns in topics.items():
        if name in RECEIVERS and "time_utc_usec" in columns:
            unix_us, t_us = columns["time_utc_usec"].astype(np.int64), columns["timestamp"].astype(np.int64)
            good = (columns["fix_type"] >= FIX_3D) & (unix_us > 0)
            if good.any():
                return int((unix_us - t_us)[good][0]) * MICROSECOND
    return 0


def _samples(section: Sensor, handler: Handler, topics: Topics) -> Samples | None:
    """The samples of a sensor, where the log has them."""
    make: Callable[[Any, Array, Mapping[str, Array]], Mapping[str, Array]]
    match section:
        case Imu():
            columns = topics.get((IMU, instance(section)))
            make = _imu
        case Gnss() | DualAntenna():
            number = instance(section)
            columns = next((topics[name, number] for name in RECEIVERS if (name, number) in topics), None)
            make = _gnss
        case Barometer():
            columns = topics.get((AIR, instance(section)), topics.get((BAROMETER, instance(section))))
            make = _barometer
        case Wheel():
            columns = topics.get((ENCODERS, 0))
            make = _wheels
        case _:
            return None
    if columns is None:
        return None
    t_us = columns["timestamp"].astype(np.int64)
    return Samples(handler, t_us, t_us, make(section, t_us, columns))


def _imu(section: Any, t_us: Array, columns: Mapping[str, Array]) -> Mapping[str, Array]:
    return imu_fields(section, t_us, vector(columns, "accelerometer_m_s2"), vector(columns, "gyro_rad"))


def _gnss(_section: Any, t_us: Array, columns: Mapping[str, Array]) -> Mapping[str, Array]:
    place = np.stack(
        [columns["latitude_deg"], columns["longitude_deg"], columns["altitude_msl_m"]]
        if "latitude_deg" in columns
        else [columns["lat"] / 1e7, columns["lon"] / 1e7, columns["alt"] / 1e3],
        1,
    )
    motion = np.stack([columns["vel_m_s"], np.degrees(columns["cog_rad"])], 1).astype(float)
    sigmas = np.stack([columns[key] for key in ("eph", "epv", "s_variance_m_s")], 1).astype(float)
    yaw = np.degrees(np.nan_to_num(columns["heading"].astype(float))) if "heading" in columns else None
    stamps = columns["time_utc_usec"].astype(np.int64)
    return gnss_fields(stamps, columns["fix_type"], place, np.nan_to_num(motion), np.nan_to_num(sigmas), yaw)


def _barometer(_section: Any, t_us: Array, columns: Mapping[str, Array]) -> Mapping[str, Array]:
    pressure = columns.get("baro_pressure_pa", columns.get("pressure", np.zeros(len(t_us)))).astype(float)
    names = [key for key in ("baro_temp_celcius", "ambient_temperature", "temperature") if key in columns]
    celsius = columns[names[0]].astype(float) if names else np.full(len(t_us), STANDARD_CELSIUS)
    hundred = 100.0 if len(pressure) and np.median(pressure) < LEAST_PASCAL else 1.0
    return pressure_fields(t_us, pressure * hundred, celsius)


def _wheels(section: Any, t_us: Array, columns: Mapping[str, Array]) -> Mapping[str, Array]:
    return wheel_fields(t_us, vector(columns, "wheel_angle", 2) * (section.radius_m or 1.0))


def vector(columns: Mapping[str, Array], name: str, size: int = 3) -> Array:
    """The parts name[0], name[1], ... of a vector: (n, size)."""
    return np.stack([columns[f"{name}[{part}]"] for part in range(size)], 1).astype(float)
