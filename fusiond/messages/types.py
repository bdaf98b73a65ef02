"""The types of the published messages, with the meaning and unit of every field.

No message has a number that is not finite. Messages are immutable: a reader in any thread sees the state and the
covariance of one instant.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from fusiond.config.outputs import Encoding
from fusiond.estimator.solution import Mode

SCHEMA_VERSION = 1  # raised when a field is removed or changes its meaning, unit or type; not when one is added

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Block = tuple[float, float, float, float, float, float, float, float, float]  # 3 x 3, row by row


def _about(text: str) -> Meta:
    return Meta(description=text)


class Message(Struct, frozen=True, kw_only=True):
    """A published message."""


class OutcomeCounts(Message, frozen=True, kw_only=True):
    """Measurements offered since the start, counted by their latest outcome."""

    fused: Annotated[int, _about("used")] = 0
    rejected: Annotated[int, _about("outside the innovation gate")] = 0
    too_old: Annotated[int, _about("older than the horizon")] = 0
    duplicate: Annotated[int, _about("received before")] = 0
    invalid: Annotated[int, _about("declared or found unusable")] = 0
    waiting: Annotated[int, _about("newer than the newest IMU sample, held until the IMU catches up")] = 0
    gathered: Annotated[int, _about("taken to align, when there was no state yet")] = 0


class State(Message, frozen=True, kw_only=True):
    """Position, velocity, attitude and sensor errors of the IMU; a sigma is one standard deviation."""

    lat_deg: Annotated[float, _about("latitude [deg], WGS-84")]
    lon_deg: Annotated[float, _about("longitude [deg], WGS-84")]
    height_m: Annotated[float, _about("height [m] above the ellipsoid, or the sea where the receiver gives only that")]
    velocity_ned_mps: Annotated[Triple, _about("velocity over ground [m/s], north, east, down")]
    quaternion_nb: Annotated[Quaternion, _about("attitude: w, x, y, z of the rotation that takes b to n")]
    roll_deg: Annotated[float, _about("roll [deg], Z-Y-X convention, (-180, 180]")]
    pitch_deg: Annotated[float, _about("pitch [deg], [-90, 90]")]
    yaw_deg: Annotated[float, _about("yaw [deg], clockwise from north, (-180, 180]")]
    angular_rate_b_rps: Annotated[Triple, _about("angular rate [rad/s] in b, corrected for bias")]
    acceleration_b_mps2: Annotated[
        Triple, _about("specific force [m/s^2] in b, corrected for bias: (0, 0, -9.8) level and at rest")
    ]
    gyro_bias_rps: Annotated[Triple, _about("gyro bias [rad/s] in b")]
    accel_bias_mps2: Annotated[Triple, _about("accelerometer bias [m/s^2] in b")]
    wheel_scale: Annotated[float, _about("fraction by which all wheels read too high: 0.01 is 1 %")]
    mount_deg: Annotated[tuple[float, float], _about("mounting pitch and yaw [deg] of the IMU in the vehicle")]
    covariance_position_m2: Annotated[Block, _about("position covariance [m^2] in n, 3 x 3 row by row")]
    covariance_velocity_m2ps2: Annotated[Block, _about("velocity covariance [m^2/s^2] in n, 3 x 3 row by row")]
    covariance_attitude_rad2: Annotated[
        Block, _about("attitude covariance [rad^2], small rotations about the axes of n, 3 x 3 row by row")
    ]
    sigma_position_ned_m: Annotated[Triple, _about("position sigmas [m], north, east, down")]
    sigma_velocity_mps: Annotated[
        float, _about("horizontal velocity sigma per axis [m/s]: root mean square of the north and the east sigma")
    ]
    sigma_yaw_deg: Annotated[float, _about("sigma of the rotation about down [deg]")]
    sigma_gyro_bias_rps: Annotated[Triple, _about("gyro bias sigmas [rad/s]")]
    sigma_accel_bias_mps2: Annotated[Triple, _about("accelerometer bias sigmas [m/s^2]")]
    sigma_wheel_scale: Annotated[float, _about("sigma of wheel_scale")]
    sigma_mount_deg: Annotated[tuple[float, float], _about("sigmas of mount_deg [deg]")]


class StateAtInstant(Message, frozen=True, kw_only=True):
    """The common layout of StateMessage and SettledMessage."""

    schema: Annotated[int, _about("version of this message's layout")] = SCHEMA_VERSION
    vehicle: Annotated[str, _about("name of the vehicle")]
    t_ns: Annotated[int, _about("instant the state is valid for [ns], Unix time of the receiving host")]
    mode: Annotated[Mode, _about("aligning (no state yet), nominal, dead_reckoning or lost")]
    age_ms: Annotated[
        float | None, _about("t_ns less the stamp of the newest IMU sample used [ms]; null before the first")
    ]
    resets: Annotated[int, _about("number of resets, that is jumps of the state")]
    fault: Annotated[str | None, _about("why the state was withheld; null otherwise")] = None
    heading_confirmed: Annotated[
        bool, _about("whether the drive or two antennas have confirmed the heading; before, it is given or stored")
    ] = True
    state: Annotated[State | None, _about("the state; null while there is none")]
    outcomes: Annotated[OutcomeCounts, _about("outcomes of the measurements so far")]


class StateMessage(StateAtInstant, frozen=True, kw_only=True):
    """The state at one instant, on fusiond/<vehicle>/state."""


class SettledMessage(StateAtInstant, frozen=True, kw_only=True):
    """The state at the horizon, which no late measurement can change any more, on fusiond/<vehicle>/settled."""


OutcomeName = Literal["fused", "rejected", "too_old", "duplicate", "invalid", "waiting", "gathered"]
SourceStatus = Literal["nominal", "noisy", "biased", "frozen", "absent"]
EventKind = Literal["mode", "reset", "source_lost", "source_found", "source_status", "clock"]
Severity = Literal["info", "notice", "warning", "critical"]


class InnovationMessage(Message, frozen=True, kw_only=True):
    """How one measurement was judged, as soon as that is known, on fusiond/<vehicle>/innovations/<source>."""

    schema: Annotated[int, _about("version of this message's layout")] = SCHEMA_VERSION
    vehicle: Annotated[str, _about("name of the vehicle")]
    source: Annotated[str, _about("source of the measurement")]
    t_ns: Annotated[int, _about("instant of the measurement, aligned [ns]")]
    t_receive_ns: Annotated[int, _about("when it was received [ns]")]
    outcome: Annotated[OutcomeName, _about("its outcome, which a late measurement of another source can still change")]
    test_ratio: Annotated[float | None, _about("squared innovation over its limit, 1 at the gate; null if not tested")]
    innovation: Annotated[
        tuple[float, ...], _about("measurement less prediction, in the measurement's unit; empty if not tested")
    ]
    variance: Annotated[tuple[float, ...], _about("variances that the filter expects of the innovation, per axis")]
    reason: Annotated[str | None, _about("why it is invalid; null otherwise")] = None


class EventMessage(Message, frozen=True, kw_only=True):
    """An event that an operator may want to see at once, on fusiond/<vehicle>/events."""

    schema: Annotated[int, _about("version of this message's layout")] = SCHEMA_VERSION
    vehicle: Annotated[str, _about("name of the vehicle")]
    t_ns: Annotated[int, _about("when it was detected [ns]")]
    kind: Annotated[EventKind, _about("mode, reset, source_lost, source_found, source_status or clock")]
    severity: Annotated[Severity, _about("info, notice, warning or critical")]
    subject: Annotated[str, _about("the mode entered, the source or the clock; empty for a reset")]
    text: Annotated[str, _about("one line of text")]


class Quantiles(Message, frozen=True, kw_only=True):
    """Quantiles of the latest few thousand latencies; number and sum of all so far."""

    p50: Annotated[float, _about("median [ms]")]
    p90: Annotated[float, _about("90 % are below [ms]")]
    p99: Annotated[float, _about("99 % are below [ms]")]
    max: Annotated[float, _about("largest [ms]")]
    count: Annotated[int, _about("number of all so far")]
    sum: Annotated[float, _about("their sum [ms]")]


class LatencyHealth(Message, frozen=True, kw_only=True):
    """Latencies inside the daemon; null before the first."""

    fused: Annotated[Quantiles | None, _about("from the receipt of a measurement to the end of its fusion [ms]")] = None
    published: Annotated[
        Quantiles | None, _about("from the instant of a publication to its handover to the outputs [ms]")
    ] = None


class ClockHealth(Message, frozen=True, kw_only=True):
    """Alignment of the clock that a source stamps with."""

    name: Annotated[str, _about("the clock: unix, <link>/<system>/boot, or arrival if there is no stamp")]
    method: Annotated[str, _about("unix, timesync, system_time, least_offset or arrival")]
    offset_ms: Annotated[float, _about("common time line less the clock's stamp [ms]")]
    drift_ppm: Annotated[float, _about("how much faster the host's clock runs")]
    jitter_ms: Annotated[float, _about("mean of receipt less aligned stamp since the last re-alignment [ms]")]
    resets: Annotated[int, _about("re-alignments after a jump or a reboot")]
    strays: Annotated[int, _about("implausible stamps")]
    note: Annotated[str, _about("why no better method is in use")] = ""
    bounds_ms: Annotated[
        tuple[float, float] | None, _about("between which the offset lies for certain, by TIMESYNC and receipts [ms]")
    ] = None
    faults: Annotated[int, _about("how often these bounds contradicted each other: a clock has moved")] = 0


class Probabilities(Message, frozen=True, kw_only=True):
    """Probabilities of the conditions that a source can be in; they sum to 1."""

    nominal: Annotated[float, _about("as configured")]
    noisy: Annotated[float, _about("noisier than configured")]
    biased: Annotated[float, _about("offset to one side")]
    frozen: Annotated[float, _about("repeats one value")]
    absent: Annotated[float, _about("sends nothing")]


class SourceHealth(Message, frozen=True, kw_only=True):
    """One source of measurements."""

    outcomes: Annotated[OutcomeCounts, _about("outcomes of its measurements so far")]
    present: Annotated[bool, _about("whether anything was received from it in the last 2 s")]
    age_ms: Annotated[float | None, _about("since its last receipt [ms]; null before the first")] = None
    rate_hz: Annotated[float, _about("receipts per second, recently")] = 0.0
    test_ratio: Annotated[float | None, _about("of its last measurement, 1 at the gate; null if none was tested")] = None
    nis_mean: Annotated[
        float | None, _about("mean over the horizon of the squared innovations per axis, in sigmas: 1 is as expected")
    ] = None
    clock: Annotated[ClockHealth | None, _about("the clock it stamps with; null before the first measurement")] = None
    probabilities: Annotated[Probabilities | None, _about("of its conditions; null if it is not judged")] = None
    status: Annotated[SourceStatus | None, _about("its likeliest condition; null if it is not judged")] = None
    reason: Annotated[str | None, _about("reason for that status; null if there is none")] = None


class InputHealth(Message, frozen=True, kw_only=True):
    """One link or bus."""

    received: Annotated[int, _about("frames received")]
    dropped: Annotated[int, _about("frames dropped because the queue was full")]
    counts: Annotated[dict[str, int], _about("other counts of its frames and of the link, by kind")]


class OutputHealth(Message, frozen=True, kw_only=True):
    """One output."""

    offered: Annotated[int, _about("messages put into its queue")]
    dropped: Annotated[int, _about("messages dropped, the oldest first, because the output was slow or away")]
    latency_ms: Annotated[
        Quantiles | None, _about("from the instant of a publication until it is sent or taken from the queue; null if none")
    ] = None
    counts: Annotated[dict[str, int], _about("other counts, by kind")]
    notes: Annotated[dict[str, str], _about("further notes, such as whether the autopilot uses the state")]


class Calibration(Message, frozen=True, kw_only=True):
    """A parameter of the installation that is learnt."""

    value: Annotated[float, _about("correction to the configured value, in the unit that its name ends in")]
    sigma: Annotated[float, _about("one standard deviation of it")]


class HealthMessage(Message, frozen=True, kw_only=True):
    """Health of all parts, each second and at every change of mode, resets or sources, on fusiond/<vehicle>/health."""

    schema: Annotated[int, _about("version of this message's layout")] = SCHEMA_VERSION
    vehicle: Annotated[str, _about("name of the vehicle")]
    t_ns: Annotated[int, _about("the instant it describes [ns]")]
    version: Annotated[str, _about("of fusiond")]
    uptime_s: Annotated[float, _about("since the first measurement [s]")]
    mode: Annotated[Mode, _about("as in the state")]
    resets: Annotated[int, _about("number of resets, that is jumps of the state")]
    reset_reason: Annotated[str | None, _about("reason of the last reset; null before the first")] = None
    outcomes: Annotated[OutcomeCounts, _about("over all sources")]
    latency_ms: Annotated[LatencyHealth, _about("latencies inside the daemon")]
    sources: Annotated[dict[str, SourceHealth], _about("by name")]
    inputs: Annotated[dict[str, InputHealth], _about("by kind and name, such as mavlink.fc")]
    outputs: Annotated[dict[str, OutputHealth], _about("by name, such as zenoh")]
    calibration: Annotated[
        dict[str, Calibration], _about("learnt corrections to the configured installation, by name")
    ] = {}


class InfoMessage(Message, frozen=True, kw_only=True):
    """What is running here, on fusiond/<vehicle>/info."""

    schema: Annotated[int, _about("version of this message's layout")] = SCHEMA_VERSION
    vehicle: Annotated[str, _about("name of the vehicle")]
    version: Annotated[str, _about("of fusiond")]
    kernel: Annotated[Literal["compiled", "numpy"], _about("compiled, or the slower one in NumPy")]
    encoding: Annotated[Encoding, _about("of everything published over Zenoh")]
    schemas: Annotated[dict[str, int], _about("versions of the messages' layouts, by the last part of the key")]
    keys: Annotated[dict[str, str], _about("where each message is published, by the last part of the key")]
    sources: Annotated[dict[str, str], _about("what each source measures: imu, gnss_position, ...")]
    config: Annotated[dict[str, Any], _about("the configuration, defaults filled in")]


class ConfigMessage(Message, frozen=True, kw_only=True):
    """The configuration in force, on fusiond/<vehicle>/config."""

    schema: Annotated[int, _about("version of this message's layout")] = SCHEMA_VERSION
    vehicle: Annotated[str, _about("name of the vehicle")]
    config: Annotated[dict[str, Any], _about("the configuration, defaults filled in")]


MESSAGES: dict[str, type[Message]] = {  # by the last part of the key; innovations have a key for each source
    "state": StateMessage,
    "settled": SettledMessage,
    "health": HealthMessage,
    "innovations": InnovationMessage,
    "events": EventMessage,
    "info": InfoMessage,
    "config": ConfigMessage,
}
