"""Events on their way into the filter: as an adapter received them, and as the clock aligned them. All SI, all frozen.

An adapter yields `Received`: a typed payload with the sensor's own stamp (if it has one), the clock that the stamp was
read from, and the stamp of its receipt. `fusiond.timeline.clock` turns it into a `Measurement`: the same payload with one
stamp `t_ns` on the one time line. Stamps are integers of nanoseconds everywhere, without defaults. The types are msgspec
structs because a replay makes millions of them: a frozen one costs a tenth of a frozen dataclass.
"""

from __future__ import annotations

from msgspec import Struct

Vector3 = tuple[float, float, float]
FIX_3D, FIX_DGPS, FIX_FLOAT, FIX_FIXED, FIX_STATIC, FIX_PPP = 3, 4, 5, 6, 7, 8  # MAVLink's GPS_FIX_TYPE


class ImuSample(Struct, frozen=True, gc=False):
    """Inertial sample in body axes (forward, right, down)."""

    specific_force_b: Vector3  # m/s^2, accelerometer: (0, 0, -9.8) when level and at rest
    angular_rate_b: Vector3  # rad/s


class GnssPosition(Struct, frozen=True, gc=False):
    """Antenna position (WGS-84). A sigma is None where the receiver gives none."""

    latitude: float  # rad
    longitude: float  # rad
    height: float  # m above the ellipsoid (or mean sea level, where the receiver gives nothing else)
    sigma_horizontal: float | None = None  # m, one standard deviation per axis
    sigma_vertical: float | None = None  # m
    fix_type: int = FIX_3D


class GnssVelocity(Struct, frozen=True, gc=False):
    """Antenna velocity over ground, north-east-down. `down` is None where the receiver gives speed and course only."""

    north: float  # m/s
    east: float  # m/s
    down: float | None = None  # m/s
    sigma: float | None = None  # m/s, one standard deviation per axis


class GnssYaw(Struct, frozen=True, gc=False):
    """Yaw of the baseline between the two antennas of a GNSS receiver. The sigma is None where it gives none."""

    yaw: float  # rad, of the baseline, clockwise from north
    sigma: float | None = None  # rad, one standard deviation


class WheelSpeed(Struct, frozen=True, gc=False):
    """Speed of one wheel's circumference along its rolling direction, positive forward."""

    speed: float  # m/s
    sigma: float = 0.0  # m/s, one standard deviation of this reading, on top of what the configuration says
    signed: bool = False  # its direction is known, though the wheel's own signal does not give it


class Pressure(Struct, frozen=True, gc=False):
    """Static air pressure."""

    absolute: float  # Pa
    temperature: float  # K, of the sensor


class ClockPair(Struct, frozen=True, gc=False):
    """One instant read from two clocks at once (MAVLink SYSTEM_TIME): `Received.t_sensor_ns` on `Received.clock` is
    `t_ns` on `clock`. It aligns clocks and never reaches the filter.

    With HOST_CLOCK as `clock` it is the reply to a request (MAVLink TIMESYNC) that was sent at `t_ns` of the host's time
    line: the other clock was read at some instant between that and the receipt."""

    clock: str
    t_ns: int


class Invalid(Struct, frozen=True, gc=False):
    """A sample that its own protocol declares unusable (fault bit, bad checksum, no fix); it is counted with its reason."""

    reason: str


class YawRate(Struct, frozen=True, gc=False):
    """The car's own yaw rate, about the vehicle's vertical axis."""

    rate: float  # rad/s, clockwise


class SteeringAngle(Struct, frozen=True, gc=False):
    """Where the road wheels of the steered axle point, by the steering wheel."""

    angle: float  # rad, of the road wheels, clockwise: to the right


class LateralAcceleration(Struct, frozen=True, gc=False):
    """The car's own accelerometer across it."""

    specific_force: float  # m/s^2, to the right


class Parked(Struct, frozen=True, gc=False):
    """Whether the gear lever is at park, or the handbrake is on."""

    parked: bool


CarPayload = YawRate | SteeringAngle | LateralAcceleration | Parked
Payload = ImuSample | GnssPosition | GnssVelocity | GnssYaw | WheelSpeed | Pressure | CarPayload
AnyPayload = Payload | ClockPair | Invalid


class Received(Struct, frozen=True, gc=False):
    """What an input adapter yields: one sample of one source, as it came in.

    `source` names a stream of one kind of payload (`imu0`, `gps0.position`, `gps0.velocity`, `rear_left`). `sequence`
    counts a source's samples in the order in which the sensor sent them, as far as the adapter knows. `clock` names the
    clock of `t_sensor_ns`: `unix`, `<link>/<system>/boot`, or an empty string together with None where there is no
    stamp.
    """

    source: str
    sequence: int
    clock: str
    t_sensor_ns: int | None
    t_receive_ns: int
    payload: AnyPayload


class Measurement(Struct, frozen=True, gc=False):
    """A payload placed on the time line: it was measured at `t_ns`. The order of events is `key`. `stamp_sigma` is how far
    off the alignment of clocks may have placed it against the inertial sensor's samples [s]."""

    t_ns: int
    source: str
    sequence: int
    t_receive_ns: int
    payload: Payload | Invalid
    stamp_sigma: float = 0.0

    @property
    def key(self) -> tuple[int, str, int]:
        return self.t_ns, self.source, self.sequence


UNIX_CLOCK = "unix"
HOST_CLOCK = "host"  # the clock of the receive stamps


def boot_clock(link: str, system: int = 1) -> str:
    """The name of the clock that counts from the boot of one MAVLink system on one link."""
    return f"{link}/{system}/boot"
