"""The configuration: what its tables may hold, and what may not stand together."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, field

from fusiond.toml_file import Name, Section, decode, read_text, refuse

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Seconds = Annotated[float, Meta(gt=0, le=1_000_000)]
Span = Annotated[float, Meta(ge=0, le=1_000_000)]  # s
Milliseconds = Annotated[float, Meta(ge=-1_000_000, le=1_000_000)]
Vector = tuple[float, float, float]
Unit = Literal["m/s", "km/h", "mph", "rad/s", "rpm"]
Encoding = Literal["json", "msgpack"]
ImuMessage = Literal["HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU"]


class Vehicle(Section, frozen=True, kw_only=True):
    """[vehicle]"""

    name: Name = "vehicle"  # names the vehicle in every published key


class Filter(Section, frozen=True, kw_only=True):
    """[filter]: the estimator, its memory and how it starts."""

    horizon_s: Seconds = 1.0  # how late a measurement may be and still be put where it belongs
    snapshot_interval_s: Span = 0.05  # spacing of the filter snapshots that a rewind starts from; 0: every IMU sample
    imu_gap_s: Seconds = 0.2  # an IMU silent for longer is bridged by coasting at constant velocity
    restart_gap_s: Seconds = 30.0  # after a hole in the data of this length the filter aligns anew
    gate_probability: Annotated[float, Meta(gt=0, lt=1)] = 0.999  # share of good innovations that pass the gate
    gnss_reset_s: Seconds = 30.0  # GNSS that was rejected for this long, off alike all the time, is believed again
    gnss_return_s: Seconds = 3.0  # the same where no fix was fused for 10 s before
    v_max_mps: Positive = 60.0  # largest speed of the vehicle: first velocity sigma is a third of it
    heading_deg: Annotated[float, Meta(ge=-360, le=360)] | None = None  # given start heading, clockwise from north
    heading_sigma_deg: Positive = 5.0  # sigma of the given start heading
    heading_spread_deg: Annotated[float, Meta(gt=0, le=30)] = 8.0  # headings this close together are chosen between no more
    course_speed_mps: Positive = 8.0  # above this GNSS speed, at which it never reverses, its course is the start heading
    level_sigma_deg: Positive = 3.0  # sigma of roll and pitch after leveling on the accelerometer
    position_timeout_s: Seconds = 2.0  # without a position fix for this long: dead reckoning
    lost_sigma_m: Positive = 200.0  # horizontal position sigma beyond which the state is called lost
    wheel_scale_sigma: NotNegative = 0.01  # first sigma of a wheel scale (1 = 100 %); 0 freezes it at zero
    wheel_scale_by: Literal["vehicle", "axle", "wheel"] = "vehicle"  # one scale for all wheels, or for each axle or wheel
    wheel_scale_walk: NotNegative = 1e-5  # its random walk [1/sqrt(s)]
    mount_sigma_deg: NotNegative = 1.0  # first sigma of the IMU's pitch and yaw against the vehicle; 0 freezes them
    mount_walk_deg: NotNegative = 1e-3  # its random walk [deg/sqrt(s)]


class Motion(Section, frozen=True, kw_only=True):
    """[motion]: what a wheeled vehicle cannot do, used as measurements."""

    non_holonomic: bool = True  # no sideways or vertical speed at the point below
    point_m: Vector = (0.0, 0.0, 0.0)  # where it holds, from the IMU: the middle of the unsteered axle
    lateral_sigma_mps: Positive = 0.2  # how far the point may slip sideways: sigma of that constraint
    vertical_sigma_mps: Positive = 0.3  # likewise up and down: suspension
    interval_s: Seconds = 0.1  # spacing of constraint, zero velocity and zero rotation updates
    minimum_speed_mps: NotNegative = 1.0  # the non-holonomic constraint rests below this speed
    standstill: bool = True  # use zero velocity and zero rotation when the vehicle stands
    still_wheel_mps: Positive = 0.1  # every wheel at or below this; so fast it may creep unseen
    still_gyro_deg_s: Positive = 0.6  # and the gyro's scatter below this
    still_accel_mps2: Positive = 0.25  # and the accelerometer's scatter below this
    still_after_s: Seconds = 0.5  # for this long
    zero_velocity_sigma_mps: Positive = 0.02  # sigma of the velocity at standstill, per axis
    zero_rotation_sigma_deg_s: Positive = 0.1  # sigma of the angular rate at standstill, per axis


class Mavlink(Section, frozen=True, kw_only=True):
    """[mavlink.NAME]: one MAVLink link; a .tlog given to replay stands for the first of them."""

    connection: str = "udpin:127.0.0.1:14550"  # pymavlink connection string
    baud: Annotated[int, Meta(gt=0)] = 115200  # for serial devices
    dialect: Name = "common"  # pymavlink dialect, "common" or "ardupilotmega"
    system: Annotated[int, Meta(ge=0, le=255)] = 0  # take only this system id; 0: the first autopilot heard
    component: Annotated[int, Meta(ge=0, le=255)] = 0  # take only this component id; 0: every one
    own_system: Annotated[int, Meta(ge=0, le=255)] = 0  # fusiond's own system id, live; 0: that of the autopilot
    own_component: Annotated[int, Meta(ge=1, le=255)] = 191  # fusiond's own component id (191: onboard computer)
    request: bool = True  # live: ask the autopilot for the messages needed, at the rates of [imu] and [gnss]


class Can(Section, frozen=True, kw_only=True):
    """[can.NAME]: one CAN bus."""

    dbc: list[str] = field(default_factory=list)  # DBC files, relative to this file
    log_channel: str | None = None  # the bus's name in a log; default: NAME
    interface: str | None = None  # python-can interface; default: python-can's own configuration
    channel: str | None = None  # python-can channel; default: python-can's own configuration
    config_context: str | None = None  # section of python-can's own configuration file
    fd: bool = False  # CAN FD
    bitrate: Annotated[int, Meta(ge=1000, le=8_000_000)] | None = None  # [bit/s], where the interface does not set it
    delay_ms: Annotated[float, Meta(ge=0, le=1_000_000)] = 0.0  # how old a frame is when it is received


class Imu(Section, frozen=True, kw_only=True):
    """[imu.NAME]: the inertial sensor that carries the state forward. Exactly one."""

    link: Name  # the [mavlink.LINK] it comes by
    message: ImuMessage = "HIGHRES_IMU"  # the message that carries it
    instance: Annotated[int, Meta(ge=0)] = 0  # HIGHRES_IMU's id
    rate_hz: Annotated[float, Meta(gt=0, le=4000)] = 100.0  # samples a second to ask the autopilot for, live
    rotation_deg: Vector = (0.0, 0.0, 0.0)  # roll, pitch, yaw of the sensor's axes against forward-right-down
    delay_ms: Milliseconds = 0.0  # how long before its stamp the sample was true
    accel_noise: Positive = 0.05  # accelerometer noise density, vibration included [m/s^2/sqrt(Hz)]
    gyro_noise: Positive = 2e-3  # gyro noise density [rad/s/sqrt(Hz)]
    accel_bias_sigma: NotNegative = 0.3  # first sigma of the accelerometer bias [m/s^2]
    gyro_bias_sigma: NotNegative = 0.01  # first sigma of the gyro bias [rad/s]
    accel_bias_walk: NotNegative = 1e-3  # accelerometer bias random walk [m/s^2/sqrt(s)]
    gyro_bias_walk: NotNegative = 2e-5  # gyro bias random walk [rad/s/sqrt(s)]
    accel_limit: Positive = 160.0  # a sample beyond this is invalid [m/s^2]
    gyro_limit: Positive = 35.0  # a sample beyond this is invalid [rad/s]


class Gnss(Section, frozen=True, kw_only=True):
    """[gnss.NAME]: a GNSS receiver; it feeds the sources NAME.position and NAME.velocity."""

    link: Name  # the [mavlink.LINK] it comes by
    message: Literal["GPS_RAW_INT", "GPS2_RAW"] = "GPS_RAW_INT"  # the message that carries it
    lever_arm_m: Vector = (0.0, 0.0, 0.0)  # antenna from the IMU: forward, right, down
    delay_ms: Milliseconds = 0.0  # how long before its stamp the position was true
    velocity_delay_ms: Milliseconds = 0.0  # how much longer before its stamp the velocity was true (receivers smooth it)
    lever_arm_sigma_m: NotNegative = 0.0  # first sigma of the lever arm, per axis, which is then learnt; 0 freezes it
    delay_sigma_ms: NotNegative = 0.0  # likewise, delay
    velocity_delay_sigma_ms: NotNegative = 0.0  # likewise, velocity delay
    stamp: Literal["sensor", "arrival"] = "sensor"  # "arrival": ignore the fix's own stamp, use the receipt less delay_ms
    position_sigma_m: Positive = 1.5  # horizontal, where the receiver gives none, and the least it is believed to be
    height_sigma_m: Positive = 3.0  # likewise, vertical
    velocity_sigma_mps: Positive = 0.2  # likewise, per axis
    position_correlation_s: NotNegative = 0.0  # time over which position errors stay alike: weighs dense fixes down
    velocity_correlation_s: NotNegative = 0.0  # likewise, velocity
    use_velocity: bool = True  # fuse speed and course as well
    outliers: Literal["gate", "mixture"] = "gate"  # leave them out, or weigh each fix by how likely it is one
    outlier_share: Annotated[float, Meta(gt=0, lt=0.5)] = 0.05  # of all fixes, where outliers = "mixture"
    noise_least: Positive = 1.0  # the sigmas are learnt from the innovations, down to this multiple of the given ones
    noise_most: Positive = 3.0  # and up to this
    group: Name | None = None  # receivers of one group share part of their error: atmosphere, multipath
    shared_sigma_m: NotNegative = 0.0  # that part of the position's error
    minimum_fix_type: Annotated[int, Meta(ge=2, le=8)] = 3  # GPS_FIX_TYPE that a fix must have at least; 3: 3-D
    interval_s: Positive = 0.2  # expected spacing of fixes


class Wheel(Section, frozen=True, kw_only=True):
    """[wheel.NAME]: one wheel; each is a source of its own."""

    bus: Name  # the [can.BUS] it comes by
    message: str  # message name in the DBC
    signal: str  # signal name in the DBC
    unit: Unit = "km/h"  # of the decoded signal; rad/s and rpm need radius_m
    radius_m: Positive | None = None  # rolling radius
    scale: float = 1.0  # known factor on the signal; negative where it counts backwards
    unsigned: bool = True  # the signal tells the amount only, not the direction
    direction_signal: str | None = None  # a signal whose value reverse_value means driving backwards
    reverse_value: int = 1  # what direction_signal reads when driving backwards
    valid_signal: str | None = None  # a signal that must equal valid_value
    valid_value: int = 0  # what valid_signal must read
    counter_signal: str | None = None  # a rolling counter; a repeated value marks a stale frame
    position_m: Vector = (0.0, 0.0, 0.0)  # the wheel's contact point from the IMU: forward, right, down
    steered: bool = False  # it turns with the steering wheel, so it measures speed along its own track
    sigma_mps: Positive = 0.1  # white noise of one reading
    noise_least: Positive = 1.0  # sigma is learnt from the innovations, down to this multiple of sigma_mps
    noise_most: Positive = 3.0  # and up to this
    group: Name | None = None  # wheels of one group share part of their error: tyres, one axle's slip
    shared_sigma_mps: NotNegative = 0.0  # that part of it
    least_mps: NotNegative = 0.1  # slower than this it reads 0, or anything
    quantum_mps: NotNegative = 0.0  # step of the signal: adds quantum^2/12 to the variance
    correlation_s: NotNegative = 0.0  # time over which its errors (slip, tyre) stay alike
    delay_ms: Milliseconds = 0.0  # how long before its stamp the reading was true (the bus's delay_ms comes on top)


class Publish(Section, frozen=True, kw_only=True):
    """[publish]"""

    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 50.0  # publications a second, of receive time
    encoding: Encoding = "json"  # "json" or "msgpack"


class Zenoh(Section, frozen=True, kw_only=True):
    """[zenoh]: where the state is published. Loopback and no scouting unless said otherwise."""

    mode: Literal["peer", "client", "router"] = "peer"  # a client needs a router, a peer does not
    listen: list[str] = field(default_factory=lambda: ["tcp/127.0.0.1:7447"])  # endpoints to listen on
    connect: list[str] = field(default_factory=list)  # endpoints to connect to
    multicast_scouting: bool = False  # find and be found by others on the local network
    config_file: str | None = None  # Zenoh's own configuration file, read before the keys above


class Live(Section, frozen=True, kw_only=True):
    """[live]: how `fusiond run` treats its inputs."""

    queue_frames: Annotated[int, Meta(ge=16, le=1_000_000)] = 4096  # of each input; when full the oldest is dropped
    reopen_max_s: Annotated[float, Meta(gt=0, le=600)] = 5.0  # longest pause before a lost input is opened again


class Record(Section, frozen=True, kw_only=True):
    """[record]: the black box of `fusiond run`: what was received, as .tlog and candump .log."""

    folder: str | None = None  # such as "/var/lib/fusiond/box"; none: nothing is recorded
    file_mb: Annotated[float, Meta(ge=0.01, le=100_000)] = 64.0  # a file that has grown to this is followed by another
    total_mb: Annotated[float, Meta(ge=0.02, le=10_000_000)] = 1024.0  # the oldest files go when all exceed this together


class Config(Section, frozen=True, kw_only=True):
    """The whole file."""

    vehicle: Vehicle = field(default_factory=Vehicle)
    filter: Filter = field(default_factory=Filter)
    motion: Motion = field(default_factory=Motion)
    publish: Publish = field(default_factory=Publish)
    zenoh: Zenoh = field(default_factory=Zenoh)
    live: Live = field(default_factory=Live)
    record: Record = field(default_factory=Record)
    mavlink: dict[Name, Mavlink] = field(default_factory=dict)
    can: dict[Name, Can] = field(default_factory=dict)
    imu: dict[Name, Imu] = field(default_factory=dict)
    gnss: dict[Name, Gnss] = field(default_factory=dict)
    wheel: dict[Name, Wheel] = field(default_factory=dict)
    directory: str = "."  # set on loading: where relative file names start

    def path(self, name: str) -> Path:
        """A file name of the configuration, resolved against its folder."""
        return Path(self.directory) / name

    def sources(self) -> tuple[str, ...]:
        """Every source of measurements, in the order that breaks ties of time."""
        gnss = [f"{name}.{kind}" for name in self.gnss for kind in ("position", "velocity")]
        return tuple(sorted([*self.imu, *gnss, *self.wheel]))


MOST_SCALES = 4


def wheel_groups(config: Config) -> dict[str, int]:
    """Of each wheel, the number of the scale that it shares with others: with all, with those of its axle, with none.
    Axles are counted from the rear, wheels by name."""
    by = config.filter.wheel_scale_by
    keys = {name: {"vehicle": 0, "axle": wheel.position_m[0], "wheel": name}[by] for name, wheel in config.wheel.items()}
    order = sorted(set(keys.values()), key=lambda key: (isinstance(key, str), key))
    return {name: order.index(key) for name, key in keys.items()}


def calibrated(gnss: Gnss) -> bool:
    """Whether the filter learns anything of a receiver's installation."""
    return max(gnss.lever_arm_sigma_m, gnss.delay_sigma_ms, gnss.velocity_delay_sigma_ms) > 0


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
    for name, wheel in config.wheel.items():
        refer("wheel", name, "bus", wheel.bus, config.can)
    found += _contradictions_on_can(config)
    if len(config.imu) != 1:
        key = ".".join(["imu", *list(config.imu)[1:2]])
        found.append((key, f"exactly one [imu.NAME] is needed, found {len(config.imu)}"))
    taken: dict[str, str] = {}
    for table, named in (("imu", config.imu), ("gnss", config.gnss), ("wheel", config.wheel)):
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


def _contradictions_of_learning(config: Config) -> Iterator[tuple[str, str]]:
    for table, named in (("gnss", config.gnss), ("wheel", config.wheel)):
        for name, source in named.items():
            if source.noise_least > source.noise_most:
                yield f"{table}.{name}.noise_least", f"must not exceed noise_most ({source.noise_most:g})"
    learnt = [name for name, gnss in config.gnss.items() if calibrated(gnss)]
    if len(learnt) > 1:
        yield f"gnss.{learnt[1]}", f"the lever arm and delays of one receiver can be learnt: [gnss.{learnt[0]}]"
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
