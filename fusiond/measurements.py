"""Events on their way into the filter: what an adapter received, and what the clock made of it. All SI, all frozen.

An adapter yields `Received`: a typed payload with the sensor's own stamp (if it has one), the clock which that stamp was
read from, and the stamp of its receipt. `fusiond.clock` turns it into a `Measurement`: the same payload with one stamp
`t_ns` on the one time line. Stamps are integers of nanoseconds everywhere; they have no defaults.
"""

from __future__ import annotations

from dataclasses import dataclass

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Inertial sample in body axes (forward, right, down)."""

    specific_force_b: Vector3  # m/s^2, accelerometer: (0, 0, -9.8) when level and at rest
    angular_rate_b: Vector3  # rad/s


@dataclass(frozen=True, slots=True)
class GnssPosition:
    """Antenna position (WGS-84). A sigma is None where the receiver gives none."""

    latitude: float  # rad
    longitude: float  # rad
    height: float  # m above the ellipsoid (or mean sea level, where the receiver gives nothing else)
    sigma_horizontal: float | None = None  # m, one standard deviation per axis
    sigma_vertical: float | None = None  # m


@dataclass(frozen=True, slots=True)
class GnssVelocity:
    """Antenna velocity over ground, north-east-down. `down` is None where the receiver gives speed and course only."""

    north: float  # m/s
    east: float  # m/s
    down: float | None = None  # m/s
    sigma: float | None = None  # m/s, one standard deviation per axis


@dataclass(frozen=True, slots=True)
class WheelSpeed:
    """Speed of one wheel's circumference along its rolling direction, positive forward."""

    speed: float  # m/s


@dataclass(frozen=True, slots=True)
class ClockPair:
    """One instant read from two clocks at once (MAVLink SYSTEM_TIME): `Received.t_sensor_ns` on `Received.clock` is
    `t_ns` on `clock`. It aligns clocks and never reaches the filter."""

    clock: str
    t_ns: int


@dataclass(frozen=True, slots=True)
class Invalid:
    """A sample which its own protocol declares unusable (fault bit, bad checksum, no fix); counted with its reason."""

    reason: str


Payload = ImuSample | GnssPosition | GnssVelocity | WheelSpeed
AnyPayload = Payload | ClockPair | Invalid


@dataclass(frozen=True, slots=True)
class Received:
    """What an input adapter yields: one sample of one source, as it came in.

    `source` names a stream of one kind of payload (`imu0`, `gps0.position`, `gps0.velocity`, `rear_left`). `sequence`
    counts a source's samples in the order of the sensor's sending, as far as the adapter can tell. `clock` names the
    clock of `t_sensor_ns`: `unix`, `<link>/boot`, or an empty string together with None where the sensor sends no stamp.
    """

    source: str
    sequence: int
    clock: str
    t_sensor_ns: int | None
    t_receive_ns: int
    payload: AnyPayload


@dataclass(frozen=True, slots=True)
class Measurement:
    """A payload placed on the time line: it tells of the instant `t_ns`. The order of events is `key`."""

    t_ns: int
    source: str
    sequence: int
    t_receive_ns: int
    payload: Payload | Invalid

    @property
    def key(self) -> tuple[int, str, int]:
        return self.t_ns, self.source, self.sequence


UNIX_CLOCK = "unix"


def boot_clock(link: str, system: int = 1) -> str:
    """The name of the clock that counts from the boot of one MAVLink system on one link."""
    return f"{link}/{system}/boot"
