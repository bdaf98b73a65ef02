"""A configuration in words: what it does, and probable mistakes in it."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from fusiond.config.plausible import implausible
from fusiond.config.schema import Config
from fusiond.config.sensor import point_in_words
from fusiond.config.toml import Section
from fusiond.events import GnssPosition, Vector3, WheelSpeed
from fusiond.units import MILLISECOND

FAR_M = 20.0  # a lever arm beyond this is probably given in other units


def description(config: Config) -> Iterator[str]:
    """The lines of the listing that `fusiond check` prints."""
    settings, motion = config.filter, config.motion
    yield f"vehicle      {config.vehicle.name}"
    for link, mavlink in config.mavlink.items():
        whose = f"system {mavlink.system}" if mavlink.system else "the first autopilot heard"
        yield f"MAVLink      {link}: {mavlink.connection}, dialect {mavlink.dialect}, {whose}; in replay: a .tlog"
    for bus, can in config.can.items():
        live = ", ".join(filter(None, (can.interface, can.channel, can.config_context))) or "python-can's own settings"
        dbc = ", ".join(can.dbc) or "no DBC"
        yield f"CAN          {bus}: {live}; in a log: channel {can.log_channel or bus}; {dbc}; {can.delay_ms:g} ms old"
    for _, name, section in config.sensors():
        first, *rest = section.description(name)
        yield f"{section.label:<12} {name}: {first}"
        yield from (f"{'':<12} {line}" for line in rest)
    point = point_in_words(motion.point_m)
    constraints = [
        f"no sideways speed at {point} above {motion.minimum_speed_mps:g} m/s" * motion.non_holonomic,
        f"zero velocity and rotation after {motion.still_after_s:g} s at rest" * motion.standstill,
    ]
    yield f"constraints  {'; '.join(filter(None, constraints)) or 'none'}"
    yield f"horizon      {settings.horizon_s:g} s: a measurement late by up to this is put where it belongs in time"
    yield f"start        {_start(config)}"
    publish = config.publish
    yield f"publishes    fusiond/{config.vehicle.name}/state at {publish.rate_hz:g} Hz as {publish.encoding}"
    yield f"Zenoh        {_zenoh(config)}"
    if config.mcap.folder is not None:
        yield f"MCAP         files in {config.path(config.mcap.folder)}, {config.mcap.total_mb:g} MB at most"
    if config.foxglove.enabled:
        yield f"Foxglove     ws://{config.foxglove.host}:{config.foxglove.port}"
    if config.prometheus.enabled:
        yield f"Prometheus   http://{config.prometheus.host}:{config.prometheus.port}/metrics"


def values(config: Config) -> Iterator[tuple[str, object]]:
    """Every dotted key with its value, given or default, in the order of the tables."""
    yield from _values(config, "")


def _values(table: Section | dict[str, object], where: str) -> Iterator[tuple[str, object]]:
    items = table.items() if isinstance(table, dict) else msgspec.structs.asdict(table).items()
    for key, value in items:
        if isinstance(value, Section | dict):
            yield from _values(value, f"{where}{key}.")
        elif key != "directory":
            yield f"{where}{key}", value


def _start(config: Config) -> str:
    settings = config.filter
    if settings.heading_deg is not None:
        given = f"heading {settings.heading_deg:g} +- {settings.heading_sigma_deg:g} deg as given"
        if settings.heading_sigma_deg <= settings.heading_spread_deg:
            return f"at rest or in motion, {given}"
        return f"{given}: too vague to start at once, so the drive decides"
    return f"level from gravity, heading from the GNSS course above {settings.course_speed_mps:g} m/s"


def _zenoh(config: Config) -> str:
    zenoh = config.zenoh
    parts: list[str] = [zenoh.mode]
    parts += [f"listens on {', '.join(zenoh.listen)}"] if zenoh.listen else []
    parts += [f"connects to {', '.join(zenoh.connect)}"] if zenoh.connect else []
    parts += [f"file {zenoh.config_file}"] if zenoh.config_file else []
    return ", ".join([*parts, f"multicast scouting {'on' if zenoh.multicast_scouting else 'off'}"])


def oddities(config: Config) -> Iterator[str]:
    """What is allowed but probably a mistake."""
    payloads = {source.stream.payload for source in config.streams().values()}
    if GnssPosition not in payloads:
        yield "no [gnss.NAME]: without a position the filter never starts"
    if WheelSpeed not in payloads:
        yield "no [wheel.NAME]: without GNSS the position will drift with the IMU alone"
    for where, delay_ms in _delays(config):
        if delay_ms / 1e3 >= config.filter.horizon_s:
            yield (
                f"{where}: its delay of {delay_ms:g} ms is not below filter.horizon_s ({config.filter.horizon_s:g} s):"
                " all its measurements will be too old"
            )
        if delay_ms < 0:
            yield f"{where}: with a delay of {delay_ms:g} ms it would measure the future"
    for name, imu in config.imu.items():
        linked = imu.link is not None and config.autopilot.link == imu.link
        if config.autopilot.kind == "ardupilot" and linked and not (
            imu.delay_ms or imu.delay_sigma_ms
        ):
            yield (
                f"imu.{name}: ArduPilot's low-pass filters delay its samples, by 56 ms on a Rover with INS_GYRO_FILTER 4:"
                " set delay_ms, or delay_sigma_ms to learn the delays"
            )
    yield from _odd_points(config)
    for key, why in implausible(config):
        yield f"{key}: {why}"
    for bus in config.can:
        if not any(config.sensors(bus=bus)):
            yield f"can.{bus}: no sensor comes by this bus, so nothing of it will be read"


def _odd_points(config: Config) -> Iterator[str]:
    for key, point in _points(config):
        if max(map(abs, point)) > FAR_M:
            yield f"{key}: {point_in_words(point)} is far from the IMU; is it in metres?"
        elif not any(point):
            yield f"{key}: 0 0 0 puts it where the IMU is; is it measured?"


def _delays(config: Config) -> Iterator[tuple[str, float]]:
    """Each stream in use, in words, and its delay [ms]."""
    for table, name, _, stream, delay_ns in config.streams().values():
        if stream.enabled:
            which = f" ({stream.suffix.removeprefix('.')})" if stream.suffix else ""
            yield f"{table}.{name}{which}", delay_ns / MILLISECOND


def _points(config: Config) -> Iterator[tuple[str, Vector3]]:
    if config.motion.non_holonomic:
        yield "motion.point_m", config.motion.point_m
    for table, name, section in config.sensors():
        if section.point is not None:
            yield f"{table}.{name}.{section.point}", getattr(section, section.point)
