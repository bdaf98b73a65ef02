"""Reading the configuration: from a TOML file, or a black box's JSON, to its tables, and the contradictions between them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fusiond.config import recorded
from fusiond.config.schema import MAX_SCALES, Config, calibrated, sensor_tables, wheel_groups
from fusiond.config.sensor import INPUTS
from fusiond.config.toml import ConfigError, decode, line_of, meant, read_text, refuse

BY_PORT = ("tcp", "udp", "tls", "quic", "ws")  # protocols of Zenoh whose address is HOST:PORT
PROTOCOLS = (*BY_PORT, "unixsock-stream", "unixpipe", "serial", "vsock")
MAX_PORT = 65535


def load(file: str | Path) -> Config:
    """Read and check a configuration file. Raises ConfigError."""
    path = Path(file)
    return parse(read_text(path), path)


def parse(text: str, path: Path = Path("config.toml")) -> Config:
    """Check the text of a configuration file; `path` serves for messages and relative names. Raises ConfigError."""
    kept = path.suffix == ".json"
    config = recorded.parse(text, path) if kept else decode(text, path, Config, directory=str(path.parent))
    refuse(contradictions(config), text, path)
    return config


@contextmanager
def located(file: str | Path) -> Iterator[None]:
    """Inside, a ConfigError whose lines begin with a key gets the file and the line of each."""
    try:
        yield
    except ConfigError as error:
        path = Path(file)
        text = read_text(path)
        lines = str(error).splitlines()
        raise ConfigError("\n".join(f"{path}:{line_of(one.partition(': ')[0], text)}: {one}" for one in lines)) from error


def contradictions(config: Config) -> Iterator[tuple[str, str]]:
    """What types cannot express: references between tables, and combinations that make no sense."""
    yield from _contradictions_on_counts(config)
    yield from _contradictions_on_sensors(config)
    yield from _contradictions_on_can(config)
    yield from _contradictions_on_endpoints("zenoh", "listen", config.zenoh.listen)
    yield from _contradictions_on_endpoints("zenoh", "connect", config.zenoh.connect)
    yield from _contradictions_on_ros2(config)
    yield from _contradictions_on_mavlink_out(config)
    yield from _contradictions_on_signing(config)
    yield from _contradictions_on_learning(config)
    if config.record.file_mb * 2 > config.record.total_mb:
        yield "record.total_mb", f"must be at least twice file_mb ({config.record.file_mb:g} MB)"
    if config.filter.imu_gap_s >= config.filter.horizon_s:
        yield "filter.imu_gap_s", f"must be below horizon_s ({config.filter.horizon_s} s)"


def _contradictions_on_sensors(config: Config) -> Iterator[tuple[str, str]]:
    names: dict[str, str] = {}  # of the sensors so far, with their tables
    origins: dict[tuple[str, str], str] = {}  # table and origin: the sensor that reads it
    for table, name, section in config.sensors():
        for key, complaint in section.contradictions():
            yield ".".join(filter(None, (table, name, key))), complaint
        for key, target in section.inputs().items():
            yield from _reference(config, f"{table}.{name}.{key}", INPUTS[key], target)
        for stream in section.streams():
            if stream.noise_min > stream.noise_max:
                yield f"{table}.{name}.noise_least", f"must not exceed noise_most ({stream.noise_max:g})"
        if name in names:
            yield f"{table}.{name}", f"[{names[name]}.{name}] has this name; each sensor needs its own"
        names[name] = table
        first = origins.setdefault((table, section.origin()), name)
        if first != name:
            yield f"{table}.{name}", f"reads the same as [{table}.{first}]: {section.origin()}"


def _reference(config: Config, key: str, table: str, name: str) -> Iterator[tuple[str, str]]:
    """A complaint where a key names a table that is not there."""
    known = getattr(config, table)
    if name not in known:
        yield key, f"there is no [{table}.{name}]{meant(name, known)}; configured: {', '.join(sorted(known)) or 'none'}"


def _contradictions_on_counts(config: Config) -> Iterator[tuple[str, str]]:
    """How many sensors of a kind there may be."""
    for table, kind in sensor_tables().items():
        names = list(getattr(config, table))
        if kind.required and len(names) != 1:
            yield ".".join([table, *names[1:2]]), f"exactly one [{table}.NAME] is needed, found {len(names)}"
        elif kind.only_one is not None and len(names) > 1:
            yield f"{table}.{names[1]}", f"{kind.only_one}, that of [{table}.{names[0]}]"


def _contradictions_on_signing(config: Config) -> Iterator[tuple[str, str]]:
    for name, mavlink in config.mavlink.items():
        if (mavlink.signing_key_file is None) != (mavlink.signing_timestamp_file is None):
            yield f"mavlink.{name}", "signing needs both signing_key_file and signing_timestamp_file"


def _contradictions_on_endpoints(table: str, key: str, endpoints: list[str]) -> Iterator[tuple[str, str]]:
    """Endpoints of Zenoh that it would not take, or take and never use."""
    for place, one in enumerate(endpoints):
        protocol, slash, address = one.partition("/")
        if not slash:
            protocol, address = "tcp", one if ":" in one else f"{one}:0"
        named, where = f"{table}.{key}[{place}]", address.partition("?")[0].partition("#")[0]
        host, _, port = where.rpartition(":")
        if protocol not in PROTOCOLS:
            near = meant(protocol, PROTOCOLS)
            yield named, f"'{one}': unknown protocol{near}; known: {', '.join(PROTOCOLS)}"
        elif not where:
            yield named, f"'{one}': an endpoint is PROTOCOL/ADDRESS, such as tcp/127.0.0.1:7447"
        elif protocol in BY_PORT and not (host and port.isdecimal() and int(port) <= MAX_PORT):
            yield named, f"'{one}': HOST:PORT is needed after the slash, with a port up to {MAX_PORT}"


def _contradictions_on_ros2(config: Config) -> Iterator[tuple[str, str]]:
    ros2 = config.ros2
    if not ros2.enabled:
        return
    yield from _contradictions_on_endpoints("ros2", "connect", ros2.connect)
    if len({ros2.map_frame, ros2.odom_frame, ros2.base_frame}) < 3:
        yield "ros2", "map_frame, odom_frame and base_frame must differ"
    if ros2.origin is not None and not (abs(ros2.origin[0]) <= 90 and abs(ros2.origin[1]) <= 180):
        yield "ros2.origin", "latitude must be in -90 .. 90 and longitude in -180 .. 180 [deg]"
    own = sorted({*config.zenoh.listen} & {*ros2.connect})
    if own and config.zenoh.mode != "router":
        yield "ros2.connect", f"{own[0]} is where [zenoh] listens, and no router: give one of them another port"


def _contradictions_on_learning(config: Config) -> Iterator[tuple[str, str]]:
    learnt = [name for name, gnss in config.gnss.items() if calibrated(gnss)]
    if len(learnt) > 1:
        yield f"gnss.{learnt[1]}", f"the lever arm and delays of one receiver can be learnt: [gnss.{learnt[0]}]"
    if len(set(wheel_groups(config).values())) > MAX_SCALES:
        yield "filter.wheel_scale_by", f"at most {MAX_SCALES} scales, '{config.filter.wheel_scale_by}' makes more"


def _contradictions_on_can(config: Config) -> Iterator[tuple[str, str]]:
    for name, can in config.can.items():
        for dbc in can.dbc:
            if not config.path(dbc).is_file():
                yield f"can.{name}.dbc", f"no such file: {config.path(dbc)}"
        if not can.dbc and any(config.sensors(bus=name)):
            yield f"can.{name}", 'its sensors need a DBC file: dbc = ["FILE.dbc"]'


def _contradictions_on_mavlink_out(config: Config) -> Iterator[tuple[str, str]]:
    autopilot, station = config.autopilot, config.ground_station
    for table, link in (("autopilot", autopilot.link), ("ground_station", station.link)):
        if link is not None:
            yield from _reference(config, f"{table}.link", "mavlink", link)
    if autopilot.link is not None and autopilot.rate_hz > config.publish.rate_hz:
        yield "autopilot.rate_hz", f"must be at most publish.rate_hz ({config.publish.rate_hz:g} Hz)"
    if autopilot.kind == "px4" and autopilot.message == "gps_input":
        yield "autopilot.message", "PX4 takes no GPS_INPUT; use odometry or vision_position"
    echo = ("GPS_RAW_INT", "GPS2_RAW")[autopilot.gps_id]
    if autopilot.link is not None and autopilot.message == "gps_input":
        for sensor in config.sensors(link=autopilot.link):
            if echo in sensor.section.messages():
                reader = f"[{sensor.table}.{sensor.name}]"
                yield "autopilot.gps_id", f"the autopilot would send it back as {echo}, which {reader} reads"
    if autopilot.set_origin and autopilot.message == "gps_input":
        yield "autopilot.set_origin", "gps_input has no local origin: it gives latitude and longitude"
    if station.link is not None and station.connection is not None:
        yield "ground_station.connection", "give link or connection, not both"
