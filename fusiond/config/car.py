"""The car's own sensors, which come by CAN: yaw rate, steering, lateral acceleration, and whether it is parked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from msgspec import Meta, field

from fusiond.config.sensor import Sensor, Signal, Stream, delay_in_words, messages_of
from fusiond.config.toml import Name, NotNegative, Positive
from fusiond.events import LateralAcceleration, Parked, Payload, SteeringAngle, YawRate

Milliseconds = Annotated[float, Meta(ge=-1_000_000, le=1_000_000)]
Factor = Annotated[float, Meta(ge=-1000, le=1000)]
AngleUnit = Literal["deg", "rad"]
RateUnit = Literal["deg/s", "rad/s"]
AccelUnit = Literal["m/s^2", "g"]
NOISE_MOST = 3.0  # the sigmas are learnt from the innovations, up to this multiple of the configured ones


def _stream(model: str, payload: type[Payload], delay_ms: float, correlation_s: float, sigma: float) -> Stream:
    return Stream(model, payload, delay_ms, correlation_s=correlation_s, sigma=sigma, noise_max=NOISE_MOST)


class CarSensor(Sensor, frozen=True, kw_only=True):
    """One signal of the car's bus."""

    bus: Name  # the [can.BUS] that carries it
    signal: Signal  # MESSAGE.SIGNAL of the DBC
    valid_signal: Signal | None = None  # a signal that must equal valid_value
    valid_value: int = 0  # what valid_signal must read
    delay_ms: Milliseconds = 0.0  # how long before its stamp the reading was measured (the bus's delay_ms is added)

    def signals(self) -> tuple[str, ...]:
        """The signals of the bus that it reads."""
        return (self.signal,) if self.valid_signal is None else (self.signal, self.valid_signal)

    def messages(self) -> dict[str, float]:
        return messages_of(self.signals())

    def origin(self) -> str:
        return f"{self.signal} of {self.bus}"

    def _guard(self) -> Iterator[str]:
        if self.valid_signal is not None:
            yield f"{self.valid_signal} must be {self.valid_value}"


class YawRateSensor(CarSensor, frozen=True, kw_only=True):
    """[yaw_rate.NAME]: the car's own yaw rate, of its stability control. At most one."""

    label: ClassVar[str] = "yaw rate"
    only_one: ClassVar[str] = "there is one offset of it to learn"

    unit: RateUnit = "deg/s"  # of the decoded signal
    scale: Factor = -1.0  # factor on the signal; -1: it is positive to the left, as cars have it (ISO 8855)
    zero: float = 0.0  # what the signal reads while the car does not turn
    sigma_deg_s: Positive = 0.3  # white noise of one reading
    quantum_deg_s: NotNegative = 0.0  # step of the signal: adds quantum^2/12 to the variance
    correlation_s: NotNegative = 0.1  # correlation time of its errors
    offset_sigma_deg_s: NotNegative = 1.0  # initial sigma of its offset, which is learnt; 0: not learnt
    offset_walk_deg_s: NotNegative = 0.005  # the offset's random walk [deg/s/sqrt(s)]

    def streams(self) -> tuple[Stream, ...]:
        return (_stream("yaw_rate", YawRate, self.delay_ms, self.correlation_s, self.sigma_deg_s),)

    def description(self, name: str) -> Iterator[str]:
        yield f"{self.origin()} in {self.unit}, times {self.scale:g}, {delay_in_words(self.delay_ms)}"
        yield f"sigma {self.sigma_deg_s:g} deg/s about an offset that is learnt"
        yield from self._guard()


class Steering(CarSensor, frozen=True, kw_only=True):
    """[steering.NAME]: the angle of the steering wheel. At most one."""

    label: ClassVar[str] = "steering"
    only_one: ClassVar[str] = "there is one offset of it to learn"

    unit: AngleUnit = "deg"  # of the decoded signal
    scale: Factor = -1.0  # factor on the signal; -1: it is positive to the left, as cars have it (ISO 8855)
    zero: float = 0.0  # what the signal reads straight ahead
    ratio: Positive = 15.0  # steering ratio: angle of the steering wheel over that of the road wheels; 1: it is theirs
    wheelbase_m: Positive  # from the unsteered axle to the steered one
    sigma_deg: Positive = 2.0  # white noise of one reading, of the steering wheel: play, camber, side wind
    quantum_deg: NotNegative = 0.0  # step of the signal: adds quantum^2/12 to the variance
    correlation_s: NotNegative = 0.5  # correlation time of its errors
    offset_sigma_deg: NotNegative = 5.0  # initial sigma of the offset, of the steering wheel, which is learnt; 0: not learnt
    factor_sigma: NotNegative = 0.1  # initial sigma of a factor on the angle (1 = 100 %), which is learnt; 0: not learnt
    understeer_sigma_deg_per_mps2: NotNegative = 0.3  # initial sigma of the road wheels' further angle in bends, learnt
    minimum_speed_mps: Positive = 3.0  # it is not used below this speed

    def streams(self) -> tuple[Stream, ...]:
        return (_stream("steering", SteeringAngle, self.delay_ms, self.correlation_s, self.sigma_deg),)

    def description(self, name: str) -> Iterator[str]:
        yield f"{self.origin()} in {self.unit}, times {self.scale:g}, {delay_in_words(self.delay_ms)}"
        yield f"ratio {self.ratio:g}, wheelbase {self.wheelbase_m:g} m, sigma {self.sigma_deg:g} deg about a learnt offset"
        yield from self._guard()


class LateralAccelerometer(CarSensor, frozen=True, kw_only=True):
    """[lateral_acceleration.NAME]: the car's own acceleration to the side, of its stability control."""

    label: ClassVar[str] = "lateral"

    unit: AccelUnit = "m/s^2"  # of the decoded signal
    scale: Factor = -1.0  # factor on the signal; -1: it is positive to the left, as cars have it (ISO 8855)
    zero: float = 0.0  # what the signal reads straight ahead on a level road
    sigma_mps2: Positive = 0.5  # noise of one reading: the car's roll, its offset, the road
    quantum_mps2: NotNegative = 0.0  # step of the signal: adds quantum^2/12 to the variance
    correlation_s: NotNegative = 2.0  # correlation time of its errors
    minimum_speed_mps: Positive = 3.0  # it is not used below this speed

    def streams(self) -> tuple[Stream, ...]:
        return (_stream("lateral_acceleration", LateralAcceleration, self.delay_ms, self.correlation_s, self.sigma_mps2),)

    def description(self, name: str) -> Iterator[str]:
        yield f"{self.origin()} in {self.unit}, times {self.scale:g}, {delay_in_words(self.delay_ms)}"
        yield f"sigma {self.sigma_mps2:g} m/s^2"
        yield from self._guard()


class ParkedSensor(CarSensor, frozen=True, kw_only=True):
    """[parked.NAME]: a gear lever at park, or a handbrake: evidence of standstill."""

    label: ClassVar[str] = "park"

    values: list[int] = field(default_factory=lambda: [1])  # of the signal, undecoded choices too, that mean parked
    sigma_mps: Positive = 0.05  # of the velocity while it is parked, per axis

    def streams(self) -> tuple[Stream, ...]:
        return (Stream("parked", Parked, self.delay_ms, correlation_s=1.0, sigma=self.sigma_mps),)

    def description(self, name: str) -> Iterator[str]:
        values = " or ".join(str(value) for value in self.values)
        yield f"{self.origin()}: it stands where this reads {values}, sigma {self.sigma_mps:g} m/s"
        yield from self._guard()

    def contradictions(self) -> Iterator[tuple[str, str]]:
        if not self.values:
            yield "values", "at least one is needed"
