"""Reading the configuration: a TOML file to its tables, and what may not stand together in them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fusiond.config.schema import MOST_SCALES, Can, Config, Mavlink, calibrated, wheel_groups
from fusiond.config.toml import decode, read_text, refuse


def load(file: str | Path) -> Config:
    """Read and check a configuration file. Raises ConfigError."""
    path = Path(file)
    return parse(read_text(path), path)


def parse(text: str, path: Path = Path("config.toml")) -> Config:
    """Check the text of a configuration file; `path` serves for messages and relative names. Raises ConfigError."""
    config = decode(text, path, Config, directory=str(path.parent))
    refuse(_contradictions(config), text, path)
    return config


def _contradictions(config: Config) -> list[tuple[str, str]]:
    """What the types cannot say: references between tables, and combinations that make no sense."""
    found: list[tuple[str, str]] = []

    def refer(kind: str, name: str, key: str, target: str, known: dict[str, Mavlink] | dict[str, Can]) -> None:
        if target not in known:
            table = "mavlink" if key == "link" else "can"
            have = ", ".join(sorted(known)) or "none"
            found.append((f"{kind}.{name}.{key}", f"there is no [{table}.{target}]; configured: {have}"))

    for name, imu in config.imu.items():
        refer("imu", name, "link", imu.link, config.mavlink)
    for name, gnss in config.gnss.items():
        refer("gnss", name, "link", gnss.link, config.mavlink)
    found += _contradictions_on_wheels(config)
    for name, wheel in config.wheel.items():
        if wheel.bus is not None:
            refer("wheel", name, "bus", wheel.bus, config.can)
        if wheel.link is not None:
            refer("wheel", name, "link", wheel.link, config.mavlink)
    for name, barometer in config.barometer.items():
        refer("barometer", name, "link", barometer.link, config.mavlink)
    found += _contradictions_on_can(config)
    found += _contradictions_on_ros2(config)
    found += _contradictions_on_mavlink_out(config)
    found += _contradictions_on_signing(config)
    if len(config.imu) != 1:
        key = ".".join(["imu", *list(config.imu)[1:2]])
        found.append((key, f"exactly one [imu.NAME] is needed, found {len(config.imu)}"))
    taken: dict[str, str] = {}
    tables = (("imu", config.imu), ("gnss", config.gnss), ("wheel", config.wheel), ("barometer", config.barometer))
    for table, named in tables:
        for name in named:
            if name in taken:
                found.append((f"{table}.{name}", f"[{taken[name]}.{name}] has this name; each source needs its own"))
            taken.setdefault(name, table)
    found += _contradictions_of_learning(config)
    if config.record.file_mb * 2 > config.record.total_mb:
        found.append(("record.total_mb", f"must be at least twice file_mb ({config.record.file_mb:g} MB)"))
    if config.filter.imu_gap_s >= config.filter.horizon_s:
        found.append(("filter.imu_gap_s", f"must be below horizon_s ({config.filter.horizon_s} s)"))
    return found


CAN_KEYS = ("message", "signal")
GUARD_KEYS = ("direction_signal", "valid_signal", "counter_signal", "checksum", "not_available_from", "base_signal")


def _contradictions_on_wheels(config: Config) -> Iterator[tuple[str, str]]:
    """A wheel comes either by CAN or by MAVLink."""
    for name, wheel in config.wheel.items():
        if (wheel.bus is None) == (wheel.link is None):
            yield f"wheel.{name}", "one of 'bus' (CAN) and 'link' (MAVLink's WHEEL_DISTANCE) is needed, and not both"
        wanted, others = (CAN_KEYS, ("index",)) if wheel.link is None else (("index",), CAN_KEYS + GUARD_KEYS)
        for key in wanted:
            if getattr(wheel, key) is None:
                yield f"wheel.{name}", f"the key '{key}' is missing"
        for key in others:
            if getattr(wheel, key) is not None:
                yield f"wheel.{name}.{key}", f"has no meaning for a wheel that comes by {'link' if wheel.link else 'bus'}"
        if wheel.link is None and wheel.quantum_m:
            yield f"wheel.{name}.quantum_m", "is for wheels that come by link; use quantum_mps"


def _contradictions_on_signing(config: Config) -> Iterator[tuple[str, str]]:
    for name, mavlink in config.mavlink.items():
        if (mavlink.signing_key_file is None) != (mavlink.signing_timestamp_file is None):
            yield f"mavlink.{name}", "signing needs both signing_key_file and signing_timestamp_file"


def _contradictions_on_ros2(config: Config) -> Iterator[tuple[str, str]]:
    ros2 = config.ros2
    if not ros2.enabled:
        return
    if len({ros2.map_frame, ros2.odom_frame, ros2.base_frame}) < 3:
        yield "ros2", "map_frame, odom_frame and base_frame must differ"
    if ros2.origin is not None and not (abs(ros2.origin[0]) <= 90 and abs(ros2.origin[1]) <= 180):
        yield "ros2.origin", "latitude must be in -90 .. 90 and longitude in -180 .. 180 [deg]"
    own = sorted({*config.zenoh.listen} & {*ros2.connect})
    if own and config.zenoh.mode != "router":
        yield "ros2.connect", f"{own[0]} is where [zenoh] listens, and no router: give one of them another port"


def _contradictions_of_learning(config: Config) -> Iterator[tuple[str, str]]:
    for table, named in (("gnss", config.gnss), ("wheel", config.wheel), ("barometer", config.barometer)):
        for name, source in named.items():
            if source.noise_least > source.noise_most:
                yield f"{table}.{name}.noise_least", f"must not exceed noise_most ({source.noise_most:g})"
    learnt = [name for name, gnss in config.gnss.items() if calibrated(gnss)]
    if len(learnt) > 1:
        yield f"gnss.{learnt[1]}", f"the lever arm and delays of one receiver can be learnt: [gnss.{learnt[0]}]"
    for name in list(config.barometer)[1:]:
        yield f"barometer.{name}", f"there is one height offset to learn, that of [barometer.{next(iter(config.barometer))}]"
    if len(set(wheel_groups(config).values())) > MOST_SCALES:
        yield "filter.wheel_scale_by", f"at most {MOST_SCALES} scales, '{config.filter.wheel_scale_by}' makes more"


def _contradictions_on_can(config: Config) -> Iterator[tuple[str, str]]:
    for name, wheel in config.wheel.items():
        if wheel.unit in ("rad/s", "rpm") and wheel.radius_m is None:
            yield f"wheel.{name}.unit", f"{wheel.unit} needs radius_m"
        if wheel.scale == 0:
            yield f"wheel.{name}.scale", "must not be 0"
    for name, can in config.can.items():
        for dbc in can.dbc:
            if not config.path(dbc).is_file():
                yield f"can.{name}.dbc", f"no such file: {config.path(dbc)}"
        if not can.dbc and any(wheel.bus == name for wheel in config.wheel.values()):
            yield f"can.{name}", 'its wheels need a DBC file: dbc = ["FILE.dbc"]'


def _contradictions_on_mavlink_out(config: Config) -> Iterator[tuple[str, str]]:
    autopilot, station = config.autopilot, config.ground_station
    have = ", ".join(sorted(config.mavlink)) or "none"
    for table, link in (("autopilot", autopilot.link), ("ground_station", station.link)):
        if link is not None and link not in config.mavlink:
            yield f"{table}.link", f"there is no [mavlink.{link}]; configured: {have}"
    if autopilot.link is not None and autopilot.rate_hz > config.publish.rate_hz:
        yield "autopilot.rate_hz", f"must be at most publish.rate_hz ({config.publish.rate_hz:g} Hz)"
    if autopilot.kind == "px4" and autopilot.message == "gps_input":
        yield "autopilot.message", "PX4 takes no GPS_INPUT; use odometry or vision_position"
    echo = ("GPS_RAW_INT", "GPS2_RAW")[autopilot.gps_id]
    heard = any(gnss.link == autopilot.link and gnss.message == echo for gnss in config.gnss.values())
    if heard and autopilot.message == "gps_input":
        yield "autopilot.gps_id", f"the autopilot would send it back as {echo}, which a [gnss.NAME] takes for a receiver's"
    if autopilot.set_origin and autopilot.message == "gps_input":
        yield "autopilot.set_origin", "gps_input tells where it is; it has no local origin"
    if station.link is not None and station.connection is not None:
        yield "ground_station.connection", "give link or connection, not both"
