"""fusiond as a library: arrays or data frames of a drive in, its track as arrays out.

    track = fuse(TOML, {"imu0": imu, "gps0": fixes, "rear_left": wheel}, smooth=True)
    track.frame().plot(x="east_m", y="north_m")

Each sensor of the configuration gets a table: a mapping of names to arrays, or a data frame of pandas. COLUMNS says which
columns there are. Times are `t` in seconds, of any beginning that all tables share, or `t_ns`, whole nanoseconds. A row
whose numbers are not finite is INVALID, and counted.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusiond.config import load
from fusiond.config.schema import Config, Source
from fusiond.config.toml import ConfigError, decode
from fusiond.errors import UsageError
from fusiond.estimator.archive import Archive, Spool
from fusiond.estimator.fusion import Fusion
from fusiond.estimator.smoother import Smoother
from fusiond.estimator.solution import Solution, SolutionState
from fusiond.events import (
    FIX_3D,
    GnssPosition,
    GnssVelocity,
    GnssYaw,
    ImuSample,
    Measurement,
    Payload,
    Pressure,
    WheelSpeed,
)
from fusiond.maths.rotation import matrix_from_euler
from fusiond.maths.typed import Array, Stamps
from fusiond.maths.wgs84 import radii
from fusiond.units import SECOND

if TYPE_CHECKING:
    import pandas as pd

Table = Mapping[str, ArrayLike] | Any  # columns by their names; a data frame is one
Flags = NDArray[np.bool_]
LINK = "arrays"  # stands for the link of sensors that have none
T, T_NS, RECEIVED = "t", "t_ns", "t_receive"  # s; ns; s: when it was received, by default when it was measured


class ArrayError(UsageError):
    """A table that cannot be used; the message names sensor and column."""


class Column(NamedTuple):
    """A column that a sensor's table has, or may have: its name, and what it is."""

    name: str
    about: str
    needed: bool = True


COLUMNS: dict[str, tuple[Column, ...]] = {  # by the kind of the sensor's table in the configuration
    "imu": (
        *(Column(f"accel_{axis}", "specific force [m/s^2]: z is -9.8 when level and at rest") for axis in "xyz"),
        *(Column(f"gyro_{axis}", "angular rate [rad/s]") for axis in "xyz"),
    ),
    "gnss": (
        Column("lat_deg", "latitude [deg], WGS-84"),
        Column("lon_deg", "longitude [deg]"),
        Column("height_m", "height [m] above the ellipsoid"),
        Column("sigma_m", "of the position, horizontal, per axis [m]", needed=False),
        Column("sigma_height_m", "of the height [m]", needed=False),
        Column("fix_type", "MAVLink's GPS_FIX_TYPE: 3 3D, 4 differential, 5 RTK float, 6 RTK fixed", needed=False),
        Column("vn_mps", "velocity north [m/s]", needed=False),
        Column("ve_mps", "velocity east [m/s]", needed=False),
        Column("vd_mps", "velocity down [m/s]", needed=False),
        Column("sigma_v_mps", "of the velocity, per axis [m/s]", needed=False),
    ),
    "wheel": (Column("speed_mps", "speed of the wheel's circumference [m/s], positive forward"),),
    "barometer": (
        Column("pressure_pa", "absolute pressure [Pa]"),
        Column("temperature_k", "of the sensor [K]", needed=False),
    ),
    "dual_antenna": (
        Column("yaw_deg", "of the baseline, clockwise from north [deg]"),
        Column("sigma_yaw_deg", "of that [deg]", needed=False),
    ),
}


@dataclass(frozen=True)
class Track:
    """The states of a drive, one a row: N of them."""

    t_ns: Stamps  # (N,)
    t: Array  # (N,) s, on the time line of the input
    mode: NDArray[np.str_]  # (N,) nominal, dead_reckoning, lost
    lat_deg: Array  # (N,) WGS-84
    lon_deg: Array  # (N,)
    height_m: Array  # (N,)
    north_m: Array  # (N,) from the first state
    east_m: Array  # (N,)
    velocity_n: Array  # (N, 3) m/s, north-east-down
    quaternion_nb: Array  # (N, 4) w, x, y, z: body to north-east-down
    roll_pitch_yaw_deg: Array  # (N, 3)
    angular_rate_b: Array  # (N, 3) rad/s, freed of bias
    acceleration_b: Array  # (N, 3) m/s^2, specific force freed of bias
    gyro_bias: Array  # (N, 3) rad/s
    accel_bias: Array  # (N, 3) m/s^2
    wheel_scale: Array  # (N,) 1: 0.01 if wheels read 1 % too high
    covariance: Array  # (N, 9, 9) of position [m], velocity [m/s], attitude [rad], each north, east, down
    outcomes: dict[str, dict[str, int]]  # by source: counts of FUSED, REJECTED, INVALID, ...

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def sigmas(self) -> Array:
        """Standard deviations (N, 9), in the order of the covariance."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))

    def frame(self) -> pd.DataFrame:
        """The track as a data frame of pandas, indexed by t [s]: a column for each number but the covariances. ImportError
        without pandas."""
        import pandas as pd  # noqa: PLC0415 - only this needs it

        columns: dict[str, Any] = {}
        for field in fields(self):
            values = getattr(self, field.name)
            if field.name in ("t", "covariance", "outcomes"):
                continue
            if values.ndim == 1:
                columns[field.name] = values
            for k, axis in enumerate(AXES.get(field.name, ()) if values.ndim == 2 else ()):
                columns[axis] = values[:, k]
        names = [f"sigma_{what}_{axis}" for what in ("position", "velocity", "attitude") for axis in "ned"]
        columns |= dict(zip(names, self.sigmas.T, strict=True))
        return pd.DataFrame(columns, index=pd.Index(self.t, name="t"))


AXES = {  # columns of the data frame
    "velocity_n": ("vn_mps", "ve_mps", "vd_mps"),
    "quaternion_nb": ("qw", "qx", "qy", "qz"),
    "roll_pitch_yaw_deg": ("roll_deg", "pitch_deg", "yaw_deg"),
    "angular_rate_b": ("rate_x_rps", "rate_y_rps", "rate_z_rps"),
    "acceleration_b": ("force_x_mps2", "force_y_mps2", "force_z_mps2"),
    "gyro_bias": ("gyro_bias_x_rps", "gyro_bias_y_rps", "gyro_bias_z_rps"),
    "accel_bias": ("accel_bias_x_mps2", "accel_bias_y_mps2", "accel_bias_z_mps2"),
}


def fuse(
    configuration: Config | Path | str,
    tables: Mapping[str, Table],
    *,
    smooth: bool = False,
    rate_hz: float | None = None,
    at: ArrayLike | None = None,
) -> Track:
    """Fuse the tables of a drive, by the names of the configuration's sensors, into its track.

    The configuration is the name of a file, its text, or a Config; `configured` says what it may leave out. States are those
    of the filter, from what was received by then; with `smooth` each is from the whole drive (docs/smoothing.md). They are
    wanted `at` these times [s], or `rate_hz` times a second; by default as often as the configuration publishes. Instants
    without a state, before the alignment, are left out.

    Raises ConfigError, ArrayError.
    """
    config = configured(configuration)
    events = _events(config, tables)
    instants = _instants(events, rate_hz or config.publish.rate_hz, at)
    fusion = Fusion(config)
    solutions = list(_smoothed(fusion, events, instants) if smooth else _filtered(fusion, events, instants))
    return _track([found for found in solutions if found.state is not None], fusion.outcomes())


def configured(configuration: Config | Path | str) -> Config:
    """A configuration from the name of a TOML file, from its text, or as it is. Sensors of a text need no link or bus, and
    wheels no message and signal. Raises ConfigError."""
    if isinstance(configuration, Config):
        return configuration
    if isinstance(configuration, Path) or "\n" not in configuration:
        return load.load(configuration)
    try:
        raw = tomllib.loads(configuration)
    except ValueError as error:
        raise ConfigError(f"configuration: not valid TOML: {error}") from error
    for kind in COLUMNS:
        sensors = raw.get(kind, {})
        for number, section in enumerate(sensors.values() if isinstance(sensors, dict) else ()):
            if isinstance(section, dict) and not {"link", "bus"} & set(section):
                section.update({"link": LINK} | ({"index": number} if kind == "wheel" else {}))
    if isinstance(links := raw.setdefault("mavlink", {}), dict):
        links.setdefault(LINK, {})
    try:
        config = msgspec.convert(raw, Config)
    except msgspec.ValidationError as error:
        decode(configuration, Path("configuration"), Config)  # says it better, with the line
        raise ConfigError(f"configuration: {error}") from error
    if complaints := [f"configuration: {key}: {what}" for key, what in load.contradictions(config)]:
        raise ConfigError("\n".join(complaints))
    return config


# --- Tables to events


def _events(config: Config, tables: Mapping[str, Table]) -> list[Measurement]:
    """The events of all tables, in their order of receipt."""
    sensors = {name: kind for kind in COLUMNS for name in getattr(config, kind)}
    for name in tables:
        if name not in sensors:
            raise ArrayError(f"{name}: no such sensor is configured; there are {', '.join(sensors)}")
    (imu,) = config.imu
    if imu not in tables:
        raise ArrayError(f"{imu}: the table of the inertial sensor is missing")
    streams = config.streams()
    events = [event for name, table in tables.items() for event in _rows(name, sensors[name], table, streams)]
    events.sort(key=lambda event: (event.t_receive_ns, *event.key))
    return events


def _rows(name: str, kind: str, table: Table, streams: Mapping[str, Source]) -> Iterator[Measurement]:
    """The events of one table."""
    columns = _columns(name, kind, table)
    stamps = _stamps(name, T_NS if T_NS in columns else T, columns)
    received = _stamps(name, RECEIVED, columns) if RECEIVED in columns else stamps
    for source, found in streams.items():
        if found.name != name:
            continue
        payloads = PAYLOADS[found.stream.payload]
        given = zip(stamps.tolist(), received.tolist(), payloads(columns, found.section), strict=True)
        for number, (t_ns, t_receive_ns, payload) in enumerate(given):
            if payload is not None:
                yield Measurement(t_ns - found.delay_ns, source, number, t_receive_ns, payload)


def _columns(name: str, kind: str, table: Table) -> dict[str, NDArray[Any]]:
    """The columns of a table as arrays of one length. A table (N, 3) under the name of three columns becomes these."""
    known = {column.name for column in COLUMNS[kind]} | {T, T_NS, RECEIVED}
    found: dict[str, NDArray[Any]] = {}
    for key in table.keys() if hasattr(table, "keys") else ():
        values = np.asarray(table[key])
        if values.ndim == 2 and values.shape[1] == 3 and f"{key}_x" in known:
            found |= {f"{key}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
        else:
            found[str(key)] = values
    if not found:
        raise ArrayError(f"{name}: a mapping of names to arrays, or a data frame, is needed, not {type(table).__name__}")
    missing = [column.name for column in COLUMNS[kind] if column.needed and column.name not in found]
    if not {T, T_NS} & set(found):
        missing.append(f"{T} or {T_NS}")
    if missing:
        raise ArrayError(f"{name}: no column {', '.join(missing)}; it has {', '.join(found)}")
    lengths = {key: values.shape for key, values in found.items() if key in known}
    if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise ArrayError(f"{name}: columns of one length are needed: {', '.join(f'{k} {s}' for k, s in lengths.items())}")
    return {key: found[key] for key in lengths}


def _stamps(name: str, key: str, columns: Mapping[str, NDArray[Any]]) -> Stamps:
    """The stamps of a column [ns]: whole nanoseconds, instants of NumPy, or seconds."""
    values = columns[key]
    if np.issubdtype(values.dtype, np.datetime64):
        return values.astype("datetime64[ns]").astype(np.int64)
    if key == T_NS:
        if not np.issubdtype(values.dtype, np.integer):
            raise ArrayError(f"{name}: {key}: whole nanoseconds are needed, not {values.dtype}")
        return values.astype(np.int64)
    numbers = _numbers(name, key, values)
    if not np.isfinite(numbers).all() or not (np.abs(numbers) < 9e9).all():
        raise ArrayError(f"{name}: {key}: seconds must be finite and below 9e9; nanoseconds go into a column {T_NS}")
    whole = np.floor(numbers)
    return np.asarray(whole.astype(np.int64) * SECOND + np.round((numbers - whole) * SECOND).astype(np.int64))


def _numbers(name: str, key: str, values: NDArray[Any]) -> Array:
    try:
        return values.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ArrayError(f"{name}: {key}: not numbers: {error}") from error


def _lists(columns: Mapping[str, NDArray[Any]], *names: str) -> Iterator[tuple[float | None, ...]]:
    """The rows of some columns, of which any may be missing: None, as is what is not a number."""
    count = len(next(iter(columns.values())))
    found = []
    for name in names:
        values = _numbers("table", name, columns[name]) if name in columns else np.full(count, np.nan)
        found.append([None if value != value else value for value in values.tolist()])  # noqa: PLR0124 - NaN
    return zip(*found, strict=True)


def _inertial(columns: Mapping[str, NDArray[Any]], section: Any) -> Iterator[Payload | None]:
    """The sensor's axes are turned into the body's."""
    turn = matrix_from_euler(*(math.radians(angle) for angle in section.rotation_deg))
    names = [column.name for column in COLUMNS["imu"]]
    numbers = np.stack([_numbers("imu", name, columns[name]) for name in names], axis=1)
    for row in np.concatenate([numbers[:, :3] @ turn.T, numbers[:, 3:] @ turn.T], axis=1).tolist():
        yield ImuSample((row[0], row[1], row[2]), (row[3], row[4], row[5]))


def _positions(columns: Mapping[str, NDArray[Any]], _: Any) -> Iterator[Payload | None]:
    names = ("lat_deg", "lon_deg", "height_m", "sigma_m", "sigma_height_m", "fix_type")
    for lat, lon, height, sigma, vertical, fix in _lists(columns, *names):
        if lat is None or lon is None or height is None:
            yield None
        else:
            yield GnssPosition(math.radians(lat), math.radians(lon), height, sigma, vertical, int(fix or FIX_3D))


def _velocities(columns: Mapping[str, NDArray[Any]], _: Any) -> Iterator[Payload | None]:
    for north, east, down, sigma in _lists(columns, "vn_mps", "ve_mps", "vd_mps", "sigma_v_mps"):
        yield None if north is None or east is None else GnssVelocity(north, east, down, sigma)


def _yaws(columns: Mapping[str, NDArray[Any]], _: Any) -> Iterator[Payload | None]:
    for yaw, sigma in _lists(columns, "yaw_deg", "sigma_yaw_deg"):
        spread = None if sigma is None else math.radians(sigma)
        yield None if yaw is None else GnssYaw(math.radians(yaw), spread)


def _speeds(columns: Mapping[str, NDArray[Any]], _: Any) -> Iterator[Payload | None]:
    for (speed,) in _lists(columns, "speed_mps"):
        yield None if speed is None else WheelSpeed(speed)


def _pressures(columns: Mapping[str, NDArray[Any]], _: Any) -> Iterator[Payload | None]:
    for pressure, temperature in _lists(columns, "pressure_pa", "temperature_k"):
        yield None if pressure is None else Pressure(pressure, ROOM_K if temperature is None else temperature)


ROOM_K = 293.15  # K, where no temperature is given: it does not enter the height
PAYLOADS = {
    ImuSample: _inertial,
    GnssPosition: _positions,
    GnssVelocity: _velocities,
    GnssYaw: _yaws,
    WheelSpeed: _speeds,
    Pressure: _pressures,
}


# --- Events to the track


def _instants(events: list[Measurement], rate_hz: float, at: ArrayLike | None) -> Stamps:
    """The instants of the states: those asked for, or regular ones from the first receipt to the last."""
    if at is not None:
        wanted = _stamps("at", T, {T: np.atleast_1d(np.asarray(at))})
        return np.unique(wanted)
    if not events:
        return np.empty(0, dtype=np.int64)
    if not rate_hz > 0:
        raise ArrayError(f"rate_hz: {rate_hz} is not a rate")
    begin, end = events[0].t_receive_ns, events[-1].t_receive_ns
    count = int((end - begin) / SECOND * rate_hz) + 1
    return begin + np.round(np.arange(count) * (SECOND / rate_hz)).astype(np.int64)


def _filtered(fusion: Fusion, events: list[Measurement], instants: Stamps) -> Iterator[Solution]:
    """The filter's state at each instant, from what was received by then."""
    pending = iter(instants.tolist())
    due = next(pending, None)
    for event in events:
        while due is not None and event.t_receive_ns > due:
            yield fusion.solution_at(due)
            due = next(pending, None)
        fusion.fuse(event)
    if due is not None and events and due <= events[-1].t_receive_ns:
        yield fusion.solution_at(due)


def _smoothed(fusion: Fusion, events: list[Measurement], instants: Stamps) -> Iterator[Solution]:
    """The smoothed state at each instant."""
    archive = Archive(fusion.params, Spool.in_memory())
    fusion.history.archive = archive.add
    for event in events:
        fusion.fuse(event)
    fusion.history.finish()
    archive.finish()
    smoother = Smoother(archive, instants)
    smoother.smooth()
    yield from smoother.solutions()


def _track(found: list[Solution], outcomes: dict[str, dict[str, int]]) -> Track:
    """States as arrays."""
    states: list[SolutionState] = [one.state for one in found if one.state is not None]

    def of(name: str, width: int) -> Array:
        return np.array([getattr(state, name) for state in states], dtype=np.float64).reshape(len(states), width)

    latitude, longitude, height = (of(name, 1)[:, 0] for name in ("latitude", "longitude", "height"))
    north, east = np.zeros(len(states)), np.zeros(len(states))
    if states:
        meridian, transverse = radii(float(latitude[0]))
        north = (latitude - latitude[0]) * (meridian + height[0])
        turned = (longitude - longitude[0] + np.pi) % (2 * np.pi) - np.pi
        east = turned * (transverse + height[0]) * np.cos(latitude[0])
    t_ns = np.array([one.t_ns for one in found], dtype=np.int64)
    return Track(
        t_ns=t_ns,
        t=t_ns / SECOND,
        mode=np.array([one.mode.value for one in found], dtype=np.str_),
        lat_deg=np.degrees(latitude),
        lon_deg=np.degrees(longitude),
        height_m=height,
        north_m=north,
        east_m=east,
        velocity_n=of("velocity_n", 3),
        quaternion_nb=of("quaternion_nb", 4),
        roll_pitch_yaw_deg=np.degrees([state.euler() for state in states]).reshape(-1, 3),
        angular_rate_b=of("angular_rate_b", 3),
        acceleration_b=of("acceleration_b", 3),
        gyro_bias=of("gyro_bias", 3),
        accel_bias=of("accel_bias", 3),
        wheel_scale=of("wheel_scale", 1)[:, 0],
        covariance=np.array([state.covariance for state in states]).reshape(-1, 9, 9),
        outcomes=outcomes,
    )
