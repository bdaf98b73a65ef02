"""The whole configuration: the sections of the filter, the inputs and the sensors, and what follows from all together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, get_args, get_origin, get_type_hints

from msgspec import Meta, field

from fusiond import events
from fusiond.config.car import LateralAccelerometer, ParkedSensor, Steering, YawRateSensor
from fusiond.config.outputs import Autopilot, Foxglove, GroundStation, Mcap, Prometheus, Publish, Record, Ros2, Zenoh
from fusiond.config.sensor import (
    INERTIAL,
    Sensor,
    Signal,
    Stream,
    delay_in_words,
    messages_of,
    point_in_words,
    signal_contradictions,
    vector_in_words,
)
from fusiond.config.toml import Name, NotNegative, Positive, Section, Vector
from fusiond.events import GnssPosition, GnssVelocity, GnssYaw, ImuSample, Pressure, WheelSpeed
from fusiond.units import MILLISECOND

Seconds = Annotated[float, Meta(gt=0, le=1_000_000)]
Span = Annotated[float, Meta(ge=0, le=1_000_000)]  # s
Milliseconds = Annotated[float, Meta(ge=-1_000_000, le=1_000_000)]
WHEEL_DISTANCE = "WHEEL_DISTANCE"  # the MAVLink message of all wheels
CAN_KEYS = ("message", "signal")  # of a wheel that comes by CAN
GUARD_KEYS = (
    "direction_signal", "forward_values", "valid_signal", "counter_signal", "checksum", "not_available_from", "base_signal",
)  # fmt: skip
STAMPS = {"sensor": "by its own stamp", "arrival": "by its arrival"}
Estimate = Literal["mean", "median", "map"]
Unit = Literal["m/s", "km/h", "mph", "rad/s", "rpm"]
SpeedUnit = Literal["m/s", "km/h", "mph", "kn"]
AccelUnit = Literal["m/s^2", "g", "mg"]
RateUnit = Literal["rad/s", "deg/s"]
Signals = tuple[Signal, Signal, Signal]
PressureMessage = Literal["SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3"]
Checksum = Literal["toyota", "honda", "hyundai", "tesla"]
GnssMessage = Literal["GPS_RAW_INT", "GPS2_RAW"]
ImuMessage = Literal["HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU"]


class Vehicle(Section, frozen=True, kw_only=True):
    """[vehicle]"""

    name: Name = "vehicle"  # names the vehicle in every published key
    geoid_m: float = 0.0  # height of the geoid above the ellipsoid; subtracted where MAVLink wants heights above the sea


class Filter(Section, frozen=True, kw_only=True):
    """[filter]: the estimator, its history and how it starts."""

    horizon_s: Seconds = 1.0  # how late a measurement may be and still be fused at its own time
    snapshot_interval_s: Span = 0.05  # spacing of the filter snapshots that a rewind starts from; 0: every IMU sample
    imu_gap_s: Seconds = 0.2  # an IMU that is silent for longer is bridged by coasting
    restart_gap_s: Seconds = 30.0  # after a gap of this length in the data the filter aligns again
    gate_probability: Annotated[float, Meta(gt=0, lt=1)] = 0.999  # share of good measurements that pass the innovation gate
    spoof_cost: Positive = 3.0  # what a metre costs by which a lying receiver pulls the state, against the next
    estimate: Estimate = "mean"  # what is published while rivals contend: mean, median, or map, the likeliest rival
    dead_reckoning_cost: Positive = 1.0  # what a metre costs by which dead reckoning drifts off a receiver that was right
    v_max_mps: Positive = 60.0  # top speed of the vehicle: the initial velocity sigma is a third of it
    heading_deg: Annotated[float, Meta(ge=-360, le=360)] | None = None  # heading at the first start, clockwise from north
    heading_sigma_deg: Positive = 5.0  # sigma of the given start heading
    heading_spread_deg: Annotated[float, Meta(gt=0, le=30)] = 8.0  # the choice of a heading ends below this spread
    course_speed_mps: Positive = 8.0  # above this GNSS speed the vehicle never reverses: its course starts the heading
    level_sigma_deg: Positive = 3.0  # sigma of roll and pitch after leveling on the accelerometer
    position_timeout_s: Seconds = 2.0  # without a position fix for this long the mode is dead reckoning
    lost_sigma_m: Positive = 200.0  # horizontal position sigma above which the mode is lost
    wheel_scale_sigma: NotNegative = 0.01  # initial sigma of a wheel scale (1 = 100 %); 0: not estimated
    wheel_scale_by: Literal["vehicle", "axle", "wheel"] = "vehicle"  # one scale for all wheels, or for each axle or wheel
    wheel_scale_walk: NotNegative = 1e-5  # its random walk [1/sqrt(s)]
    mount_sigma_deg: NotNegative = 1.0  # initial sigma of the IMU's pitch and yaw against the vehicle; 0: not estimated
    mount_walk_deg: NotNegative = 1e-3  # its random walk [deg/sqrt(s)]


class Motion(Section, frozen=True, kw_only=True):
    """[motion]: what a wheeled vehicle cannot do, used as measurements."""

    non_holonomic: bool = True  # no sideways or vertical speed at the point below
    point_m: Vector = (0.0, 0.0, 0.0)  # where that is so, from the IMU: the middle of the unsteered axle
    lateral_sigma_mps: Positive = 0.2  # sigma of the sideways speed: slip
    vertical_sigma_mps: Positive = 0.3  # sigma of the vertical speed: suspension
    slip_sigma_deg_per_mps2: NotNegative = 0.5  # initial sigma of the slip angle in bends, learnt where the IMU's delay is
    interval_s: Seconds = 0.1  # spacing of constraint, zero velocity and zero rotation updates
    minimum_speed_mps: NotNegative = 0.3  # the non-holonomic constraint is not used below this speed
    standstill: bool = True  # use zero velocity and zero rotation when the vehicle stands
    still_wheel_mps: Positive = 0.1  # every wheel at or below this speed, at which it may creep unseen
    still_gyro_deg_s: Positive = 0.6  # standard deviation of the gyro below this
    still_accel_mps2: Positive = 0.25  # standard deviation of the accelerometer below this
    still_after_s: Seconds = 0.5  # all of it for this long
    zero_velocity_sigma_mps: Positive = 0.02  # sigma of the velocity at standstill, per axis
    zero_rotation_sigma_deg_s: Positive = 0.1  # sigma of the angular rate at standstill, per axis


class Mavlink(Section, frozen=True, kw_only=True):
    """[mavlink.NAME]: one MAVLink link. In a replay an unnamed .tlog is the first of them."""

    connection: str = "udpin:127.0.0.1:14550"  # pymavlink connection string
    baud: Annotated[int, Meta(gt=0)] = 115200  # for serial devices
    dialect: Name = "common"  # pymavlink dialect, "common" or "ardupilotmega"
    system: Annotated[int, Meta(ge=0, le=255)] = 0  # accept only this system id; 0: the first autopilot heard
    component: Annotated[int, Meta(ge=0, le=255)] = 0  # accept only this component id; 0: all
    own_system: Annotated[int, Meta(ge=0, le=255)] = 0  # fusiond's own system id, live; 0: that of the autopilot
    own_component: Annotated[int, Meta(ge=1, le=255)] = 191  # fusiond's own component id (191: onboard computer)
    request: bool = True  # live: ask the autopilot for the messages needed, at the sensors' rates
    timesync: bool = True  # live: measure the autopilot's clock by TIMESYNC round trips
    signing_key_file: str | None = None  # 32 bytes or 64 hex digits: sign what is sent, accept only what is signed with it
    signing_timestamp_file: str | None = None  # file that keeps the last signing timestamp over restarts
    accept_unsigned: bool = False  # with a key: accept unsigned frames too; wrongly signed ones are never accepted


class Can(Section, frozen=True, kw_only=True):
    """[can.NAME]: one CAN bus."""

    dbc: list[str] = field(default_factory=list)  # DBC files, relative to this file
    log_channel: str | None = None  # the bus's name in a log; default: NAME
    interface: str | None = None  # python-can interface; default: python-can's own configuration
    channel: str | None = None  # python-can channel; default: python-can's own configuration
    config_context: str | None = None  # section of python-can's own configuration file
    fd: bool = False  # CAN FD
    bitrate: Annotated[int, Meta(ge=1000, le=8_000_000)] | None = None  # [bit/s], if the interface does not set it
    delay_ms: Annotated[float, Meta(ge=0, le=1_000_000)] = 0.0  # age of a frame when it is received
    j1939: bool = False  # match 29-bit ids by PGN, of any priority and sender; implied if the DBC says J1939


class Imu(Sensor, frozen=True, kw_only=True):
    """[imu.NAME]: the IMU that propagates the state. Exactly one. It comes by MAVLink (link, message) or by CAN (bus and
    the signals)."""

    label: ClassVar[str] = "IMU"
    required: ClassVar[bool] = True

    link: Name | None = None  # the [mavlink.LINK] that carries it
    message: ImuMessage = "HIGHRES_IMU"  # the message that carries it
    instance: Annotated[int, Meta(ge=0)] = 0  # HIGHRES_IMU's id
    bus: Name | None = None  # the [can.BUS] that carries it, in place of link
    accel_signals: Signals | None = None  # specific force along its axes x, y, z, each MESSAGE.SIGNAL of the DBC
    gyro_signals: Signals | None = None  # angular rate about them
    accel_unit: AccelUnit = "m/s^2"  # of accel_signals
    gyro_unit: RateUnit = "rad/s"  # of gyro_signals
    valid_signals: list[Signal] = field(default_factory=list)  # signals that must all equal valid_value
    valid_value: int = 1  # what they must read
    rate_hz: Annotated[float, Meta(gt=0, le=4000)] = 100.0  # samples a second to request from the autopilot, live
    rotation_deg: Vector = (0.0, 0.0, 0.0)  # mounting roll, pitch, yaw of the sensor's axes against forward-right-down
    delay_ms: Milliseconds = 0.0  # how long before its stamp the sample was measured
    delay_sigma_ms: NotNegative = 0.0  # initial sigma of the gyro's delay, and of the accelerometer's; 0: not estimated
    accel_noise: Positive = 0.05  # accelerometer noise density, vibration included [m/s^2/sqrt(Hz)]
    gyro_noise: Positive = 2e-3  # gyro noise density [rad/s/sqrt(Hz)]
    accel_bias_sigma: NotNegative = 0.3  # initial sigma of the accelerometer bias [m/s^2]
    gyro_bias_sigma: NotNegative = 0.01  # initial sigma of the gyro bias [rad/s]
    accel_bias_walk: NotNegative = 1e-3  # accelerometer bias random walk [m/s^2/sqrt(s)]
    gyro_bias_walk: NotNegative = 2e-5  # gyro bias random walk [rad/s/sqrt(s)]
    accel_limit: Positive = 160.0  # a sample beyond this is invalid [m/s^2]
    gyro_limit: Positive = 35.0  # a sample beyond this is invalid [rad/s]

    def streams(self) -> tuple[Stream, ...]:
        return (Stream(INERTIAL, ImuSample, self.delay_ms),)

    def messages(self) -> dict[str, float]:
        return {self.message: self.rate_hz} if self.bus is None else messages_of(self.signals())

    def signals(self) -> tuple[str, ...]:
        """The signals of the bus that it reads."""
        return (*(self.accel_signals or ()), *(self.gyro_signals or ()), *self.valid_signals)

    def contradictions(self) -> Iterator[tuple[str, str]]:
        yield from signal_contradictions(self, ("accel_signals", "gyro_signals"), ("valid_signals",))

    def description(self, name: str) -> Iterator[str]:
        learnt = f" +- {self.delay_sigma_ms:g} ms, learnt" if self.delay_sigma_ms else ""
        yield f"{self.origin()}, {delay_in_words(self.delay_ms)}{learnt}"
        yield f"turned by {vector_in_words(self.rotation_deg)} deg (roll, pitch, yaw) against forward-right-down"
        yield f"noise {self.accel_noise:g} m/s^2/sqrt(Hz), {self.gyro_noise:g} rad/s/sqrt(Hz)"


class Gnss(Sensor, frozen=True, kw_only=True):
    """[gnss.NAME]: a GNSS receiver; it feeds the sources NAME.position and NAME.velocity. It comes by MAVLink (link,
    message) or by CAN (bus and the signals, which may be of several messages)."""

    label: ClassVar[str] = "GNSS"
    point: ClassVar[str] = "lever_arm_m"

    link: Name | None = None  # the [mavlink.LINK] that carries it
    message: GnssMessage = "GPS_RAW_INT"  # the message that carries it
    bus: Name | None = None  # the [can.BUS] that carries it, in place of link
    latitude_signal: Signal | None = None  # [deg], MESSAGE.SIGNAL of the DBC, as all these
    longitude_signal: Signal | None = None  # [deg]
    height_signal: Signal | None = None  # [m]
    speed_signal: Signal | None = None  # speed over ground, in speed_unit
    course_signal: Signal | None = None  # course over ground [deg], clockwise from north
    north_signal: Signal | None = None  # velocity north, in speed_unit, in place of speed and course
    east_signal: Signal | None = None  # velocity east
    down_signal: Signal | None = None  # velocity down, where it gives it
    speed_unit: SpeedUnit = "m/s"  # of the speed, or the velocity
    position_sigma_signal: Signal | None = None  # accuracy of the position, horizontal [m]
    height_sigma_signal: Signal | None = None  # accuracy of the height [m]
    velocity_sigma_signal: Signal | None = None  # accuracy of the speed, in speed_unit
    course_sigma_signal: Signal | None = None  # accuracy of the course [deg]
    time_signal: Signal | None = None  # time of the fix [s], of any zero; without it the receipt is its stamp
    fix_type_signal: Signal | None = None  # its kind of fix; without it each is 3-D
    fix_types: list[Annotated[int, Meta(ge=0, le=8)]] = field(default_factory=list)  # GPS_FIX_TYPE by its value
    valid_signals: list[Signal] = field(default_factory=list)  # what comes with one that is not valid_value is invalid
    valid_value: int = 1  # what they must read
    lever_arm_m: Vector = (0.0, 0.0, 0.0)  # antenna from the IMU: forward, right, down
    delay_ms: Milliseconds = 0.0  # how long before its stamp the position was measured
    velocity_delay_ms: Milliseconds = 0.0  # additional delay of the velocity (receivers smooth it)
    lever_arm_sigma_m: NotNegative = 0.0  # initial sigma of the lever arm, per axis; 0: not estimated
    delay_sigma_ms: NotNegative = 0.0  # initial sigma of the delay; 0: not estimated
    velocity_delay_sigma_ms: NotNegative = 0.0  # the same, of the velocity delay
    stamp: Literal["sensor", "arrival"] = "sensor"  # "arrival": ignore the fix's stamp, use the receipt less delay_ms
    stamp_sigma_ms: Annotated[float, Meta(ge=0, le=1000)] = 10.0  # error of that stamp and delay against the IMU's stamps
    position_sigma_m: Positive = 1.5  # horizontal, where the receiver gives none, and a lower bound to what it gives
    height_sigma_m: Positive = 3.0  # the same, vertical
    dgps_sigma_m: Positive = 0.8  # in place of position_sigma_m, if less, while the fix type is DGPS: SBAS, corrections
    dgps_height_sigma_m: Positive = 1.6  # and of height_sigma_m
    float_sigma_m: Positive = 0.3  # while it is RTK float, or PPP
    float_height_sigma_m: Positive = 0.6  # and of height_sigma_m
    fixed_sigma_m: Positive = 0.02  # while it is RTK fixed
    fixed_height_sigma_m: Positive = 0.03  # and of height_sigma_m
    velocity_sigma_mps: Positive = 0.2  # the same for the velocity, per axis
    position_correlation_s: NotNegative = 30.0  # correlation time of the position's slow error; 0: all its errors are white
    position_white_share: Annotated[float, Meta(ge=0.01, le=1)] = 0.2  # of its variance; the rest is the slow error's
    velocity_correlation_s: NotNegative = 2.0  # correlation time of velocity errors: dense ones weigh less
    use_velocity: bool = True  # fuse speed and course as well
    outliers: Literal["gate", "mixture"] = "gate"  # reject them, or weight each fix by its likelihood of being one
    outlier_share: Annotated[float, Meta(gt=0, lt=0.5)] = 0.05  # of all fixes, with outliers = "mixture"
    noise_least: Positive = 1.0  # the sigmas are learnt from the innovations, down to this multiple of the configured ones
    noise_most: Positive = 3.0  # and up to this
    group: Name | None = None  # receivers of one group share part of their error: atmosphere, multipath
    shared_sigma_m: NotNegative = 0.0  # that part of the position's error
    minimum_fix_type: Annotated[int, Meta(ge=2, le=8)] = 3  # lowest GPS_FIX_TYPE that is used; 3: 3-D
    interval_s: Positive = 0.2  # expected spacing of fixes

    def streams(self) -> tuple[Stream, ...]:
        outlier_share = self.outlier_share if self.outliers == "mixture" else 0.0
        position = Stream(
            "gnss_position",
            GnssPosition,
            self.delay_ms,
            suffix=".position",
            sigma=self.position_sigma_m,
            group=self.group,
            shared_sigma=self.shared_sigma_m,
            noise_min=self.noise_least,
            noise_max=self.noise_most,
            outlier_share=outlier_share,
            companion=".velocity",
        )
        velocity = Stream(
            "gnss_velocity",
            GnssVelocity,
            self.delay_ms + self.velocity_delay_ms,
            suffix=".velocity",
            enabled=self.gives_velocity,
            correlation_s=self.velocity_correlation_s,
            sigma=self.velocity_sigma_mps,
            noise_min=self.noise_least,
            noise_max=self.noise_most,
            outlier_share=outlier_share,
        )
        return position, velocity

    def sigmas(self, fix_type: int) -> tuple[float, float]:
        """The least sigmas [m], horizontal and vertical, of a fix of a GPS_FIX_TYPE."""
        least = (self.position_sigma_m, self.height_sigma_m)
        match fix_type:
            case events.FIX_DGPS:
                least = (self.dgps_sigma_m, self.dgps_height_sigma_m)
            case events.FIX_FLOAT | events.FIX_PPP:
                least = (self.float_sigma_m, self.float_height_sigma_m)
            case events.FIX_FIXED | events.FIX_STATIC:
                least = (self.fixed_sigma_m, self.fixed_height_sigma_m)
        return min(least[0], self.position_sigma_m), min(least[1], self.height_sigma_m)

    def messages(self) -> dict[str, float]:
        return {self.message: 1 / self.interval_s} if self.bus is None else messages_of(self.signals())

    def position_signals(self) -> tuple[str, ...]:
        """The signals of a bus that make a position; empty where they are not all given."""
        return _all((self.latitude_signal, self.longitude_signal, self.height_signal))

    def velocity_signals(self) -> tuple[str, ...]:
        """The signals of a bus that make a velocity: north, east and perhaps down, or speed and course. Empty without."""
        down = () if self.down_signal is None else (self.down_signal,)
        return _all((self.north_signal, self.east_signal, *down)) or _all((self.speed_signal, self.course_signal))

    @property
    def gives_velocity(self) -> bool:
        """Whether it is configured to feed NAME.velocity."""
        return self.use_velocity and (self.bus is None or bool(self.velocity_signals()))

    def signals(self) -> tuple[str, ...]:
        """The signals of a bus that it reads."""
        one = (getattr(self, key) for key in GNSS_SIGNALS)
        return (*(signal for signal in one if signal is not None), *self.valid_signals)

    def contradictions(self) -> Iterator[tuple[str, str]]:
        yield from signal_contradictions(self, GNSS_SIGNALS[:3], (*GNSS_SIGNALS[3:], "valid_signals", "fix_types"))
        given = [key for key in GNSS_SIGNALS[3:8] if getattr(self, key) is not None]
        if given and self.velocity_signals() != tuple(getattr(self, key) for key in given):
            yield given[0], "a velocity is speed_signal and course_signal, or north_signal and east_signal (and down_signal)"

    def description(self, name: str) -> Iterator[str]:
        yield f"{self.origin()}, {STAMPS[self.stamp]}, {delay_in_words(self.delay_ms)}"
        yield f"feeds {name}.position: sigma {self.position_sigma_m:g} m, in height {self.height_sigma_m:g} m"
        fixed, height = self.sigmas(events.FIX_FIXED)
        yield f"while it is RTK fixed: sigma {fixed:g} m, in height {height:g} m"
        if self.gives_velocity:
            delay = delay_in_words(self.delay_ms + self.velocity_delay_ms)
            yield f"feeds {name}.velocity: sigma {self.velocity_sigma_mps:g} m/s, {delay}"
        yield f"antenna at {point_in_words(self.lever_arm_m)} from the IMU"


GNSS_SIGNALS = (  # the keys of Gnss that name one signal: of the position, of the velocity, others
    "latitude_signal", "longitude_signal", "height_signal",
    "speed_signal", "course_signal", "north_signal", "east_signal", "down_signal",
    "position_sigma_signal", "height_sigma_signal", "velocity_sigma_signal", "course_sigma_signal",
    "time_signal", "fix_type_signal",
)  # fmt: skip


def _all(signals: tuple[str | None, ...]) -> tuple[str, ...]:
    """The signals if all are given, else none."""
    given = tuple(signal for signal in signals if signal is not None)
    return given if len(given) == len(signals) else ()


class DualAntenna(Sensor, frozen=True, kw_only=True):
    """[dual_antenna.NAME]: the yaw that a GNSS receiver with two antennas gives."""

    label: ClassVar[str] = "GNSS yaw"

    link: Name  # the [mavlink.LINK] that carries it
    message: GnssMessage = "GPS_RAW_INT"  # the message whose field `yaw` carries it; a [gnss.NAME] may read it as well
    offset_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0  # baseline from forward, clockwise; 0: autopilot corrects it
    delay_ms: Milliseconds = 0.0  # how long before its stamp the yaw was measured; it may differ from the position's
    stamp: Literal["sensor", "arrival"] = "sensor"  # "arrival": ignore the message's stamp, use the receipt less delay_ms
    sigma_deg: Positive = 0.5  # where the receiver gives none, and the smallest value taken from it
    correlation_s: NotNegative = 1.0  # correlation time of its errors: multipath
    noise_least: Positive = 1.0  # sigma is learnt from the innovations, down to this multiple of sigma_deg
    noise_most: Positive = 3.0  # and up to this
    minimum_fix_type: Annotated[int, Meta(ge=2, le=8)] = 3  # lowest GPS_FIX_TYPE of a yaw that is used; 6: RTK fixed
    interval_s: Positive = 0.2  # expected spacing of the messages

    def streams(self) -> tuple[Stream, ...]:
        return (
            Stream(
                "gnss_yaw",
                GnssYaw,
                self.delay_ms,
                correlation_s=self.correlation_s,
                sigma=math.radians(self.sigma_deg),
                noise_min=self.noise_least,
                noise_max=self.noise_most,
            ),
        )

    def messages(self) -> dict[str, float]:
        return {self.message: 1 / self.interval_s}

    def description(self, name: str) -> Iterator[str]:
        yield f"{self.origin()}, {STAMPS[self.stamp]}, {delay_in_words(self.delay_ms)}"
        yield f"sigma {self.sigma_deg:g} deg, baseline {self.offset_deg:g} deg clockwise from forward"


class Barometer(Sensor, frozen=True, kw_only=True):
    """[barometer.NAME]: a static pressure sensor, used as a height with an unknown offset. At most one."""

    label: ClassVar[str] = "barometer"
    only_one: ClassVar[str] = "there is one height offset to learn"

    link: Name  # the [mavlink.LINK] that carries it
    message: PressureMessage = "SCALED_PRESSURE"  # the message that carries it
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 10.0  # readings a second to request from the autopilot, live
    delay_ms: Milliseconds = 0.0  # how long before its stamp the reading was measured
    sigma_m: Positive = 1.0  # noise of one reading, as a height: wind, draught, effect of speed on static pressure
    correlation_s: NotNegative = 1.0  # correlation time of its errors
    noise_least: Positive = 1.0  # sigma is learnt from the innovations, down to this multiple of sigma_m
    noise_most: Positive = 3.0  # and up to this
    offset_sigma_m: Positive = 100.0  # initial sigma of the height offset, which is estimated: weather and geoid
    offset_walk_m: NotNegative = 0.1  # its random walk [m/sqrt(s)]: weather, and deviation from the standard atmosphere

    def streams(self) -> tuple[Stream, ...]:
        return (
            Stream(
                "barometric_height",
                Pressure,
                self.delay_ms,
                correlation_s=self.correlation_s,
                sigma=self.sigma_m,
                noise_min=self.noise_least,
                noise_max=self.noise_most,
            ),
        )

    def messages(self) -> dict[str, float]:
        return {self.message: self.rate_hz}

    def description(self, name: str) -> Iterator[str]:
        yield f"{self.origin()}, {delay_in_words(self.delay_ms)}"
        yield f"sigma {self.sigma_m:g} m about a height offset that is learnt"


class Wheel(Sensor, frozen=True, kw_only=True):
    """[wheel.NAME]: one wheel, a source of its own. It comes by CAN (bus, message, signal) or by MAVLink's
    WHEEL_DISTANCE (link, index)."""

    label: ClassVar[str] = "wheel"
    point: ClassVar[str] = "position_m"

    bus: Name | None = None  # the [can.BUS] that carries it
    message: str | None = None  # message name in the DBC
    signal: str | None = None  # signal name in the DBC
    link: Name | None = None  # the [mavlink.LINK] that carries its WHEEL_DISTANCE, in place of bus, message and signal
    index: Annotated[int, Meta(ge=0, le=15)] | None = None  # its place in WHEEL_DISTANCE, from 0
    quantum_m: NotNegative = 0.0  # step of WHEEL_DISTANCE: adds quantum^2/6 over the interval's square to the variance
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 10.0  # WHEEL_DISTANCE messages a second to request, live
    unit: Unit = "km/h"  # of the decoded signal; rad/s and rpm need radius_m
    radius_m: Positive | None = None  # rolling radius
    scale: float = 1.0  # known factor on the signal; negative if its sign is reversed
    unsigned: bool = True  # the signal has no sign: it does not give the direction
    direction_signal: str | None = None  # a signal, also MESSAGE.SIGNAL of another frame, that tells the direction or gear
    reverse_value: int = 1  # what direction_signal reads when driving backwards
    forward_values: list[int] | None = None  # and when driving forwards; with others it is unknown; default: all others
    valid_signal: str | None = None  # a signal that must equal valid_value
    valid_value: int = 0  # what valid_signal must read
    counter_signal: str | None = None  # a rolling counter; a repeated value means a stale frame
    checksum: Checksum | None = None  # the frame ends with the checksum of this maker
    not_available_from: int | None = None  # raw values of the signal from here on mean "error" or "not available"
    base_signal: str | None = None  # a signal in the same unit that is added: J1939's axle speed under a relative one
    position_m: Vector = (0.0, 0.0, 0.0)  # the wheel's contact point from the IMU: forward, right, down
    steered: bool = False  # it is steered, so it measures speed along its own track
    sigma_mps: Positive = 0.1  # white noise of one reading
    noise_least: Positive = 1.0  # sigma is learnt from the innovations, down to this multiple of sigma_mps
    noise_most: Positive = 3.0  # and up to this
    group: Name | None = None  # wheels of one group share part of their error: tyres, one axle's slip
    shared_sigma_mps: NotNegative = 0.0  # that part of it
    least_mps: NotNegative = 0.1  # below this speed its reading is unreliable, or 0
    quantum_mps: NotNegative = 0.0  # step of the signal: adds quantum^2/12 to the variance
    correlation_s: NotNegative = 0.0  # correlation time of its errors (slip, tyre)
    delay_ms: Milliseconds = 0.0  # how long before its stamp the reading was measured (the bus's delay_ms is added)

    def streams(self) -> tuple[Stream, ...]:
        return (
            Stream(
                "wheel_speed",
                WheelSpeed,
                self.delay_ms,
                correlation_s=self.correlation_s,
                sigma=self.sigma_mps,
                group=self.group,
                shared_sigma=self.shared_sigma_mps,
                noise_min=self.noise_least,
                noise_max=self.noise_most,
            ),
        )

    def messages(self) -> dict[str, float]:
        return {WHEEL_DISTANCE: self.rate_hz} if self.message is None else {self.message: 0.0}

    def origin(self) -> str:
        if self.link is not None:
            return f"{WHEEL_DISTANCE}[{self.index}] of {self.link}"
        return f"{self.message}.{self.signal} of {self.bus}"

    def description(self, name: str) -> Iterator[str]:
        unit = f" in {self.unit}" if self.bus is not None else ""
        yield f"{self.origin()}{unit}, {delay_in_words(self.delay_ms)}"
        kind = "steered" if self.steered else "not steered"
        sign = "amount only" if self.unsigned and not self.direction_signal else "with direction"
        factor = f", times {self.scale:g}" if self.scale != 1 else ""
        yield f"at {point_in_words(self.position_m)}, {kind}, {sign}{factor}, sigma {self.sigma_mps:g} m/s"
        guards = (
            (self.valid_signal, f"must be {self.valid_value}"),
            (self.counter_signal, "must change"),
            (self.checksum, "checksum must be right"),
            (self.direction_signal, f"= {self.reverse_value} means backwards"),
        )
        guarded = ", ".join(f"{signal} {rule}" for signal, rule in guards if signal)
        if guarded:
            yield guarded

    def contradictions(self) -> Iterator[tuple[str, str]]:
        if (self.bus is None) == (self.link is None):
            yield "", "one of 'bus' (CAN) and 'link' (MAVLink's WHEEL_DISTANCE) is needed, and not both"
        needed, others = (CAN_KEYS, ("index",)) if self.link is None else (("index",), CAN_KEYS + GUARD_KEYS)
        for key in needed:
            if getattr(self, key) is None:
                yield "", f"the key '{key}' is missing"
        for key in others:
            if getattr(self, key) is not None:
                yield key, f"has no meaning for a wheel that comes by {'link' if self.link else 'bus'}"
        if self.link is None and self.quantum_m:
            yield "quantum_m", "is for wheels that come by link; use quantum_mps"
        if self.unit in ("rad/s", "rpm") and self.radius_m is None:
            yield "unit", f"{self.unit} needs radius_m"
        if self.scale == 0:
            yield "scale", "must not be 0"


class Live(Section, frozen=True, kw_only=True):
    """[live]: how `fusiond run` treats its inputs."""

    queue_frames: Annotated[int, Meta(ge=16, le=1_000_000)] = 1024  # capacity of each input's queue; when full it is thinned
    reopen_max_s: Annotated[float, Meta(gt=0, le=600)] = 5.0  # longest pause before a lost input is opened again


class State(Section, frozen=True, kw_only=True):
    """[state]: the state that `fusiond run` keeps on disk, for a hot start."""

    file: str | None = None  # such as "/var/lib/fusiond/state.json"; none: every start is a cold one
    every_s: Annotated[float, Meta(ge=1, le=86400)] = 10.0  # interval between writes; it is also written at the end
    max_age_s: Annotated[float, Meta(gt=0, le=1e9)] = 604800.0  # an older state is ignored; default: a week


class ConfiguredSensor(NamedTuple):
    """A sensor's table [table.name] of the configuration."""

    table: str
    name: str
    section: Sensor


class Source(NamedTuple):
    """A source of measurements: the table that describes it, and which of the sensor's streams it is."""

    table: str
    name: str
    section: Sensor
    stream: Stream
    delay_ns: int  # of the stream, with the delay of the bus


class Config(Section, frozen=True, kw_only=True):
    """The whole file."""

    vehicle: Vehicle = field(default_factory=Vehicle)
    filter: Filter = field(default_factory=Filter)
    motion: Motion = field(default_factory=Motion)
    publish: Publish = field(default_factory=Publish)
    zenoh: Zenoh = field(default_factory=Zenoh)
    live: Live = field(default_factory=Live)
    record: Record = field(default_factory=Record)
    state: State = field(default_factory=State)
    autopilot: Autopilot = field(default_factory=Autopilot)
    ground_station: GroundStation = field(default_factory=GroundStation)
    mcap: Mcap = field(default_factory=Mcap)
    foxglove: Foxglove = field(default_factory=Foxglove)
    prometheus: Prometheus = field(default_factory=Prometheus)
    ros2: Ros2 = field(default_factory=Ros2)
    mavlink: dict[Name, Mavlink] = field(default_factory=dict)
    can: dict[Name, Can] = field(default_factory=dict)
    imu: dict[Name, Imu] = field(default_factory=dict)
    gnss: dict[Name, Gnss] = field(default_factory=dict)
    wheel: dict[Name, Wheel] = field(default_factory=dict)
    barometer: dict[Name, Barometer] = field(default_factory=dict)
    dual_antenna: dict[Name, DualAntenna] = field(default_factory=dict)
    yaw_rate: dict[Name, YawRateSensor] = field(default_factory=dict)
    steering: dict[Name, Steering] = field(default_factory=dict)
    lateral_acceleration: dict[Name, LateralAccelerometer] = field(default_factory=dict)
    parked: dict[Name, ParkedSensor] = field(default_factory=dict)
    directory: str = "."  # set on loading: where relative file names start

    def path(self, name: str) -> Path:
        """A file name of the configuration, resolved against its folder."""
        return Path(self.directory) / name

    def sensors(self, **by: str) -> Iterator[ConfiguredSensor]:
        """Every sensor, by kind in the order of the tables above. `link="NAME"` or `bus="NAME"` selects one input."""
        for table in sensor_tables():
            named: dict[str, Sensor] = getattr(self, table)
            for name, section in named.items():
                if by.items() <= section.inputs().items():
                    yield ConfiguredSensor(table, name, section)

    def streams(self) -> dict[str, Source]:
        """Every source of measurements by its name, in the order of `sensors`. KeyError if a bus is not configured."""
        found = {}
        for table, name, section in self.sensors():
            bus = section.inputs().get("bus")
            bus_ms = 0.0 if bus is None else self.can[bus].delay_ms
            for stream in section.streams():
                delay_ns = round((stream.delay_ms + bus_ms) * MILLISECOND)
                found[name + stream.suffix] = Source(table, name, section, stream, delay_ns)
        return found

    def sources(self) -> tuple[str, ...]:
        """The names of the sources of measurements, in the order that breaks ties between equal stamps."""
        return tuple(sorted(name + stream.suffix for _, name, section in self.sensors() for stream in section.streams()))


@cache
def sensor_tables() -> dict[str, type[Sensor]]:
    """The tables of Config that describe sensors, with the kind of each: the fields that are a dict of Sensor."""
    hints = get_type_hints(Config)
    kinds = {table: get_args(hint)[1] for table, hint in hints.items() if get_origin(hint) is dict}
    return {table: kind for table, kind in kinds.items() if issubclass(kind, Sensor)}


MAX_SCALES = 4


def wheel_groups(config: Config) -> dict[str, int]:
    """The number of each wheel's scale. All wheels share one, or those of an axle, or none do. Axles are numbered from the
    rear, wheels by name."""
    by = config.filter.wheel_scale_by
    keys = {name: {"vehicle": 0, "axle": wheel.position_m[0], "wheel": name}[by] for name, wheel in config.wheel.items()}
    order = sorted(set(keys.values()), key=lambda key: (isinstance(key, str), key))
    return {name: order.index(key) for name, key in keys.items()}


def calibrated(gnss: Gnss) -> bool:
    """Whether the filter estimates a receiver's lever arm or delays."""
    return max(gnss.lever_arm_sigma_m, gnss.delay_sigma_ms, gnss.velocity_delay_sigma_ms) > 0
