"""The scenario of a simulated drive: TOML to typed, frozen structs, with the same errors as the configuration's.

Seconds (`_s`) count from the start of the drive. Positions on the vehicle (`_m`) are forward, right, down from the
point on the road below the middle of the rear axle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, get_args

from msgspec import Meta, field

from fusiond.config.toml import Name, NotNegative, Positive, Section, Vector, decode, read_text, refuse

Degrees = Annotated[float, Meta(ge=-360, le=360)]
Interval = tuple[float, float]  # [start, stop) s
Share = Annotated[float, Meta(ge=0, lt=1)]
FixType = Literal["single", "dgps", "float", "fixed"]
WheelName = Literal["front_left", "front_right", "rear_left", "rear_right"]
WHEELS: tuple[WheelName, ...] = get_args(WheelName)
SHORTEST_DRIVE_S = 1.0
RAW_MAX_UNSIGNED, RAW_MAX_SIGNED = 32767, 16383  # of a 15-bit wheel signal


class Start(Section, frozen=True, kw_only=True):
    """[start]: where and when the drive begins, and how fast."""

    latitude_deg: Annotated[float, Meta(ge=-89.9, le=89.9)] = 48.137  # WGS-84
    longitude_deg: Annotated[float, Meta(ge=-180, le=180)] = 11.575  # WGS-84
    height_m: float = 560.0  # above the ellipsoid
    heading_deg: Degrees = 0.0  # clockwise from north
    grade_deg: Annotated[float, Meta(ge=-30, le=30)] = 0.0  # slope of the road, upward positive
    speed_mps: float = 0.0  # negative: backwards
    time_unix_s: Annotated[float, Meta(ge=0, le=4e9)] = 1_760_000_000.0  # Unix time of the start, taken to the millisecond


class Segment(Section, frozen=True, kw_only=True):
    """[[segment]]: a piece of the drive; speed, heading and slope pass smoothly to the values at its end."""

    duration_s: Positive  # how long it lasts
    speed_mps: Annotated[float, Meta(ge=-80, le=80)] | None = None  # at the end; default: unchanged
    turn_deg: float = 0.0  # change of heading over the segment, clockwise positive
    grade_deg: Annotated[float, Meta(ge=-30, le=30)] | None = None  # slope of the road at the end; default: unchanged


class Body(Section, frozen=True, kw_only=True):
    """[vehicle]"""

    name: Name = "simulated"  # names the vehicle in the configuration that is written
    wheelbase_m: Positive = 2.7  # front axle to rear axle
    track_m: Positive = 1.55  # left wheels to right wheels
    roll_deg_per_mps2: float = 0.4  # lean of the body out of a bend, per lateral acceleration
    slip_deg_per_mps2: Annotated[float, Meta(ge=0, le=5)] = 0.0  # slip angle of the rear axle, likewise; a car's: 0.4 to 0.7
    steering: Literal["front", "skid"] = "front"  # "skid": no wheel is steered, and all slide sideways in a bend
    skid: Annotated[float, Meta(ge=1, le=5)] = 1.5  # how much more than in a bend without sliding such wheels differ


class Transport(Section, frozen=True, kw_only=True):
    """What happens to a stream of messages on the way to the receiving host."""

    latency_ms: NotNegative = 2.0  # of every message
    jitter_ms: NotNegative = 0.0  # mean of the additional, exponential delay
    loss: Share = 0.0  # probability of losing a message
    reorder: bool = False  # a message may overtake another of its stream


class Reboot(Section, frozen=True, kw_only=True):
    """[[autopilot.reboot]]: the boot clock starts from 0 again."""

    at_s: NotNegative  # when
    silence_s: NotNegative = 3.0  # duration without messages


class Autopilot(Section, frozen=True, kw_only=True):
    """[autopilot]: the clock of the MAVLink stamps, and its beacons SYSTEM_TIME and HEARTBEAT, once a second."""

    boot_s: NotNegative = 60.0  # how long it has been running at the start
    drift_ppm: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0  # how much faster than true time its clock runs
    telemetry: bool = False  # send ATTITUDE and similar messages too, as often as PX4 does to an onboard computer
    reboot: list[Reboot] = field(default_factory=list)
    transport: Transport = field(default_factory=Transport)


class Host(Section, frozen=True, kw_only=True):
    """[host]: the receiving computer."""

    offset_s: float = 0.0  # how far its clock is ahead of Unix time


class Imu(Section, frozen=True, kw_only=True):
    """[imu]: HIGHRES_IMU; each sample is measured at its stamp, and then filtered as an autopilot filters it."""

    rate_hz: Annotated[float, Meta(ge=10, le=2000)] = 100.0  # samples a second
    position_m: Vector = (1.2, 0.0, -0.6)  # where it sits
    mount_deg: Vector = (0.0, 0.0, 0.0)  # roll, pitch, yaw of its axes against the vehicle
    accel_noise: NotNegative = 3e-3  # white noise density [m/s^2/sqrt(Hz)]
    gyro_noise: NotNegative = 2e-4  # white noise density [rad/s/sqrt(Hz)]
    accel_bias: Vector | None = None  # initial bias [m/s^2]; default: random, with the sigma below
    gyro_bias: Vector | None = None  # initial bias [rad/s]; default: random, with the sigma below
    accel_bias_sigma: NotNegative = 0.05  # of a random initial bias [m/s^2]
    gyro_bias_sigma: NotNegative = 2e-3  # of a random initial bias [rad/s]
    accel_bias_walk: NotNegative = 1e-4  # random walk [m/s^2/sqrt(s)]
    gyro_bias_walk: NotNegative = 5e-6  # random walk [rad/s/sqrt(s)]
    accel_resolution: NotNegative = 0.0  # step of the reading [m/s^2]; 0: none
    gyro_resolution: NotNegative = 0.0  # step of the reading [rad/s]; 0: none
    vibration_hz: list[Positive] = field(default_factory=list)  # narrow bands, the same in every axis
    vibration_mps2: NotNegative = 0.0  # amplitude of each band at 10 m/s, grows with speed
    vibration_deg_s: NotNegative = 0.0  # the same on the gyro
    vibration_width_hz: NotNegative = 1.0  # width of a band
    gyro_filter_hz: NotNegative = 0.0  # cutoff of the autopilot's low-pass filter (ArduPilot: INS_GYRO_FILTER); 0: none
    accel_filter_hz: NotNegative = 0.0  # the same of the accelerometer (INS_ACCEL_FILTER)
    silent_s: list[Interval] = field(default_factory=list)  # no samples
    transport: Transport = field(default_factory=Transport)


class Jump(Section, frozen=True, kw_only=True):
    """[[gnss.jump]]: multipath; the position is off by a constant."""

    start_s: NotNegative  # from
    stop_s: NotNegative  # to
    offset_m: Vector  # north, east, down


class Spoof(Section, frozen=True, kw_only=True):
    """[[gnss.spoof]]: the position drifts off at a constant rate, and the velocity agrees with it."""

    start_s: NotNegative  # from
    stop_s: NotNegative = math.inf  # back to the truth then
    rate_mps: Vector  # north, east, down


class Quality(Section, frozen=True, kw_only=True):
    """[[gnss.quality]]: from then on the fixes are of another type, whose errors are white noise and a bias that is drawn at
    the change and stays until the next. In height both are twice as large. They replace the position's other noise."""

    start_s: NotNegative  # from
    fix: FixType  # what the receiver calls the fixes
    sigma_m: NotNegative  # white, horizontal, per axis
    bias_sigma_m: NotNegative = 0.0  # of the bias, horizontal, per axis


class Gnss(Section, frozen=True, kw_only=True):
    """[gnss]: GPS_RAW_INT."""

    rate_hz: Annotated[float, Meta(gt=0, le=50)] = 5.0  # fixes a second
    antenna_m: Vector = (0.8, 0.0, -1.6)  # where the antenna sits
    delay_ms: NotNegative = 100.0  # from the instant of the fix to its arrival at the autopilot
    velocity_lag_ms: NotNegative = 0.0  # velocity is a mean over twice this time
    stamp: Literal["unix", "boot-arrival", "none"] = "unix"  # of the fix; boot time of its arrival; 0
    sigma_m: NotNegative = 0.5  # white, horizontal, per axis
    height_sigma_m: NotNegative = 1.0  # white, vertical
    drift_sigma_m: NotNegative = 0.5  # Gauss-Markov, horizontal, per axis
    height_drift_sigma_m: NotNegative = 1.0  # Gauss-Markov, vertical
    correlation_s: Positive = 60.0  # of the Gauss-Markov part
    velocity_sigma_mps: NotNegative = 0.08  # per axis
    velocity_correlation_s: NotNegative = 0.0  # of the velocity's errors; 0: white
    report_accuracy: bool = True  # fill h_acc, v_acc, vel_acc, else 0 = unknown
    geoid_m: float = 0.0  # height of mean sea level above the ellipsoid
    outage_s: list[Interval] = field(default_factory=list)  # no messages
    no_fix_s: list[Interval] = field(default_factory=list)  # messages without a fix
    frozen_s: list[Interval] = field(default_factory=list)  # the last fix again and again, with new stamps
    jump: list[Jump] = field(default_factory=list)
    spoof: list[Spoof] = field(default_factory=list)
    quality: list[Quality] = field(default_factory=list)
    transport: Transport = field(default_factory=Transport)


class Slip(Section, frozen=True, kw_only=True):
    """[[wheels.slip]]: a wheel turns faster (spin) or slower (lock) than it moves over the road."""

    wheel: WheelName  # which
    start_s: NotNegative  # from
    stop_s: NotNegative  # to
    factor: NotNegative  # reading over true speed


class Stuck(Section, frozen=True, kw_only=True):
    """[[wheels.stuck]]: a wheel's reading stays what it was at the start."""

    wheel: WheelName  # which
    start_s: NotNegative  # from
    stop_s: NotNegative  # to


class Wheels(Section, frozen=True, kw_only=True):
    """[wheels]: one CAN frame with the four wheels' speeds, 15 bits each, a counter and a fault bit."""

    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 100.0  # frames a second
    scale_error: Annotated[float, Meta(gt=-0.5, lt=0.5)] = 0.0  # every wheel reads too high by this fraction (0.01 = 1 %)
    scale_errors: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # each wheel's own, in the order of WHEELS
    sigma_mps: NotNegative = 0.02  # white noise of a reading; a standing wheel has none
    resolution_kmh: Positive = 0.01  # step of the signal
    unsigned: bool = True  # magnitude only, no direction
    least_mps: NotNegative = 0.0  # slower wheels read 0
    slip: list[Slip] = field(default_factory=list)
    stuck: list[Stuck] = field(default_factory=list)
    fault_s: list[Interval] = field(default_factory=list)  # the fault bit is set and the speeds are invalid
    silent_s: list[Interval] = field(default_factory=list)  # no frames
    chatter: bool = True  # other frames on the bus as well (0x025, 0x0B4)
    traffic_hz: Annotated[float, Meta(ge=0, le=10_000)] = 0.0  # frames a second of further ids (a car's: 1000 and more)
    transport: Transport = field(default_factory=lambda: Transport(latency_ms=0.2, jitter_ms=0.3))


class Barometer(Section, frozen=True, kw_only=True):
    """[barometer]: SCALED_PRESSURE, at the IMU."""

    rate_hz: Annotated[float, Meta(ge=0, le=100)] = 0.0  # readings a second; 0: there is none
    sigma_m: NotNegative = 0.3  # white, as a height
    offset_m: float = 60.0  # pressure altitude less height above the ellipsoid, at the start
    offset_walk_m: NotNegative = 0.02  # its random walk [m/sqrt(s)]
    transport: Transport = field(default_factory=Transport)


class Scenario(Section, frozen=True, kw_only=True):
    """The whole file."""

    segment: Annotated[list[Segment], Meta(min_length=1)]
    seed: Annotated[int, Meta(ge=0)] = 1  # same seed, same files
    truth_rate_hz: Positive = 20.0  # rows of truth.csv a second
    start: Start = field(default_factory=Start)
    vehicle: Body = field(default_factory=Body)
    autopilot: Autopilot = field(default_factory=Autopilot)
    host: Host = field(default_factory=Host)
    imu: Imu = field(default_factory=Imu)
    gnss: Gnss = field(default_factory=Gnss)
    wheels: Wheels = field(default_factory=Wheels)
    barometer: Barometer = field(default_factory=Barometer)

    @property
    def duration_s(self) -> float:
        return math.fsum(segment.duration_s for segment in self.segment)

    @property
    def start_ns(self) -> int:
        """Unix time of the start of the drive."""
        return round(self.start.time_unix_s * 1000) * 1_000_000


def load(file: str | Path) -> Scenario:
    """Read and check a scenario file. Raises ConfigError."""
    path = Path(file)
    return parse(read_text(path), path)


def parse(text: str, path: Path = Path("scenario.toml")) -> Scenario:
    """Check the text of a scenario file; `path` serves for messages. Raises ConfigError."""
    scenario = decode(text, path, Scenario)
    refuse([*_impossible_segments(scenario), *_impossible_values(scenario)], text, path)
    return scenario


def _impossible_segments(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """What no car can drive."""
    speed, grade = scenario.start.speed_mps, scenario.start.grade_deg
    for index, segment in enumerate(scenario.segment):
        key = f"segment[{index}]"
        end = speed if segment.speed_mps is None else segment.speed_mps
        end_grade = grade if segment.grade_deg is None else segment.grade_deg
        length = segment.duration_s * (speed + end) / 2
        if speed * end < 0:
            yield f"{key}.speed_mps", f"cannot go from {speed} to {end} m/s; stop (0) in a segment between"
        elif length == 0 and segment.turn_deg != 0:
            yield f"{key}.turn_deg", "must be 0 while the vehicle stands"
        elif length == 0 and end_grade != grade:
            yield f"{key}.grade_deg", f"must stay {grade} while the vehicle stands"
        elif abs(length) < scenario.vehicle.wheelbase_m * abs(math.radians(segment.turn_deg)):
            yield f"{key}.turn_deg", f"too sharp: {segment.turn_deg} deg within {abs(length):.1f} m of road"
        speed, grade = end, end_grade


def _impossible_values(scenario: Scenario) -> Iterator[tuple[str, str]]:
    gnss, wheels = scenario.gnss, scenario.wheels
    lists: dict[str, list[Interval]] = {
        "imu.silent_s": scenario.imu.silent_s,
        "gnss.outage_s": gnss.outage_s,
        "gnss.no_fix_s": gnss.no_fix_s,
        "gnss.frozen_s": gnss.frozen_s,
        "wheels.fault_s": wheels.fault_s,
        "wheels.silent_s": wheels.silent_s,
    }
    events: dict[str, Sequence[Jump | Spoof | Slip | Stuck]] = {
        "gnss.jump": gnss.jump,
        "gnss.spoof": gnss.spoof,
        "wheels.slip": wheels.slip,
        "wheels.stuck": wheels.stuck,
    }
    for key, intervals in lists.items():
        for index, (start, stop) in enumerate(intervals):
            if not 0 <= start < stop:
                yield f"{key}[{index}]", f"[start, stop] must rise from 0 or later; found [{start}, {stop}]"
    for key, entries in events.items():
        for index, entry in enumerate(entries):
            if entry.start_s >= entry.stop_s:
                yield f"{key}[{index}].stop_s", f"must be later than start_s ({entry.start_s})"
    if scenario.duration_s < SHORTEST_DRIVE_S:
        yield "segment[0].duration_s", f"the whole drive must last {SHORTEST_DRIVE_S:g} s or longer"
    starts = [quality.start_s for quality in gnss.quality]
    for index in range(1, len(starts)):
        if starts[index] <= starts[index - 1]:
            yield f"gnss.quality[{index}].start_s", f"must be later than that of the one before ({starts[index - 1]})"
    for index, error in enumerate(wheels.scale_errors):
        if not -0.5 < error < 0.5:
            yield f"wheels.scale_errors[{index}]", "must lie between -0.5 and 0.5"
    fastest = max(abs(s) for s in [scenario.start.speed_mps, *(s.speed_mps or 0.0 for s in scenario.segment)])
    top = (RAW_MAX_UNSIGNED if wheels.unsigned else RAW_MAX_SIGNED) * wheels.resolution_kmh / 3.6
    if fastest > top:
        yield "wheels.resolution_kmh", f"15 bits end at {top:.1f} m/s, below the drive's {fastest} m/s"
