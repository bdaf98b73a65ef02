"""The sensors of a CAN bus: from decoded signals to events. No I/O.

A wheel is one signal. An inertial sensor and a receiver may send a sample in several messages: those received within half
of the expected interval belong together, and a sample is made of them when the last has come, with its receipt. Accuracies,
kind of fix and validity are the latest received, wherever they come.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Protocol, TypeVar

from cantools.database.can import Message, Signal

from fusiond.config.car import CarSensor, LateralAccelerometer, ParkedSensor, Steering, YawRateSensor
from fusiond.config.schema import Checksum, ConfiguredSensor, Gnss, Imu, Wheel
from fusiond.config.sensor import Sensor, split_signal
from fusiond.config.toml import ConfigError
from fusiond.events import (
    FIX_3D,
    AnyPayload,
    GnssVelocity,
    ImuSample,
    Invalid,
    LateralAcceleration,
    Parked,
    Received,
    SteeringAngle,
    Vector3,
    WheelSpeed,
    YawRate,
)
from fusiond.units import MICROSECOND, SECOND
from fusiond_adapters.payloads import InertialAxes, gnss_position, velocity_by_course

Item = TypeVar("Item")
Stamp = tuple[str, int | None]  # clock, stamp [ns]
MakeEvent = Callable[[str, Stamp, int, AnyPayload], Received]  # source, stamp, receipt [ns], payload

NO_STAMP: Stamp = ("", None)
METRES_PER_SECOND = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600}
DBC_UNITS = {  # as DBC files write them, in lower case: as the configuration does
    "m/s": "m/s", "mps": "m/s", "km/h": "km/h", "kph": "km/h", "kmh": "km/h", "kmph": "km/h", "km/hr": "km/h",
    "mph": "mph", "mi/h": "mph", "rad/s": "rad/s", "rads/s": "rad/s", "rad/sec": "rad/s",
    "rpm": "rpm", "1/min": "rpm", "r/min": "rpm", "rev/min": "rpm",
}  # fmt: skip
PER_RADIUS = {"rad/s": 1.0, "rpm": 2 * math.pi / 60}  # times the radius in metres
ACCELERATIONS = {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3}  # m/s^2
RATES = {"rad/s": 1.0, "deg/s": math.pi / 180}  # rad/s
ANGLES = {"rad": 1.0, "deg": math.pi / 180}  # rad
DIRECTION_NS = 2 * SECOND  # a direction that another frame told longer ago is not known any more
J1939_VALID_TOP = 0xFA  # largest top byte of a valid J1939 value
TOGETHER = 0.5  # of the interval: messages of one sample come within this


class Reader(Protocol):
    """Makes the events of one sensor from the signals of one message."""

    message: Message
    checksum: Checksum | None  # kind of checksum at the end of the frame
    needed: list[str]  # signals
    warnings: list[str]  # oddities of its configuration

    def events(self, signals: Mapping[str, float], t_receive_ns: int) -> list[Received]:
        """The events of a frame with all the needed signals."""

    def invalid(self, reason: str, t_receive_ns: int) -> list[Received]:
        """The events of a frame that is unusable."""


class WheelReader:
    """One wheel: from decoded signals to a WheelSpeed, or to the reason for none."""

    def __init__(self, name: str, wheel: Wheel, message: Message, event: MakeEvent, *, j1939: bool) -> None:
        self.message = message
        self.checksum = wheel.checksum
        self._name, self._wheel, self._event = name, wheel, event
        self._factor = _factor(wheel)
        self._signal = wheel.signal or ""
        elsewhere = wheel.direction_signal is not None and "." in wheel.direction_signal
        self._direction = None if elsewhere else wheel.direction_signal
        self._tells = elsewhere or wheel.forward_values is not None  # only at times
        self._heard: tuple[float, int] | None = None  # what another frame said of the direction, and when
        signals = {signal.name: signal for signal in message.signals}
        for key in ("signal", "direction_signal", "valid_signal", "counter_signal", "base_signal"):
            wanted = getattr(wheel, key)
            if wanted is not None and not (key == "direction_signal" and elsewhere):
                find(wanted, signals, f"wheel.{name}.{key}", f"signal of {message.name}")
        guards = (self._direction, wheel.valid_signal, wheel.counter_signal, wheel.base_signal)
        self.needed = [self._signal, *(guard for guard in guards if guard is not None)]
        self._counter: float | None = None  # last value of counter_signal
        speeds = [signals[speed] for speed in (self._signal, wheel.base_signal) if speed is not None]
        self._limits = list(_limits(speeds, wheel.not_available_from, j1939))
        self.warnings = list(_unit_warnings(name, wheel, speeds))

    def events(self, signals: Mapping[str, float], t_receive_ns: int) -> list[Received]:
        return [self._event(self._name, NO_STAMP, t_receive_ns, self._payload(signals, t_receive_ns))]

    def invalid(self, reason: str, t_receive_ns: int) -> list[Received]:
        return [self._event(self._name, NO_STAMP, t_receive_ns, Invalid(reason))]

    def hear(self, direction: float, t_receive_ns: int) -> None:
        """Take what another frame says of the direction."""
        self._heard = direction, t_receive_ns

    def _sign(self, signals: Mapping[str, float], t_receive_ns: int) -> int:
        """The direction: 1 forwards, -1 backwards, 0 unknown."""
        wheel = self._wheel
        if wheel.direction_signal is None:
            return 0
        if self._direction is not None:
            value = signals[self._direction]
        elif self._heard is None or t_receive_ns - self._heard[1] > DIRECTION_NS:
            return 0
        else:
            value = self._heard[0]
        if value == wheel.reverse_value:
            return -1
        return int(wheel.forward_values is None or value in wheel.forward_values)

    def _payload(self, signals: Mapping[str, float], t_receive_ns: int) -> WheelSpeed | Invalid:
        """The speed, if the other signals say that it is valid."""
        wheel = self._wheel
        if wheel.counter_signal is not None:
            last, self._counter = self._counter, signals[wheel.counter_signal]
            if self._counter == last:
                return Invalid("stale counter")
        if wheel.valid_signal is not None and signals[wheel.valid_signal] != wheel.valid_value:
            return Invalid("valid_signal")
        for limited, sign, limit in self._limits:
            if signals[limited] * sign >= limit:
                return Invalid("not available")
        value = signals[self._signal]
        if wheel.base_signal is not None:
            value += signals[wheel.base_signal]
        speed = value * self._factor
        if not math.isfinite(speed):
            return Invalid("not finite")
        sign = self._sign(signals, t_receive_ns)
        return WheelSpeed(-speed if sign < 0 else speed, signed=self._tells and sign != 0)


class _DirectionReader:
    """The message that tells the direction of a wheel whose own message does not."""

    def __init__(self, message: Message, signal: str, wheel: WheelReader) -> None:
        self.message = message
        self.checksum: Checksum | None = None
        self.needed = [signal]
        self.warnings: list[str] = []
        self._signal, self._wheel = signal, wheel

    def events(self, signals: Mapping[str, float], t_receive_ns: int) -> list[Received]:
        self._wheel.hear(signals[self._signal], t_receive_ns)
        return []

    def invalid(self, reason: str, t_receive_ns: int) -> list[Received]:
        return []


class _Sample:
    """One source's sample that is being gathered from the messages which carry it."""

    def __init__(self, signals: Iterable[str], interval_s: float) -> None:
        self._messages = frozenset(split_signal(signal)[0] for signal in signals)
        self._together_ns = round(TOGETHER * interval_s * SECOND)
        self._present: set[str] = set()
        self._since_ns = 0

    def add(self, message: str, t_receive_ns: int) -> str:
        """Add a message: "whole" if it was the last one missing, "incomplete" if it begins anew, "" otherwise."""
        if message not in self._messages:
            return ""
        present, verdict = self._present, ""
        if present and (message in present or abs(t_receive_ns - self._since_ns) > self._together_ns):
            present.clear()
            verdict = "incomplete"
        if not present:
            self._since_ns = t_receive_ns
        present.add(message)
        if len(present) == len(self._messages):
            present.clear()
            return "whole"
        return verdict


class _SignalReader:
    """One message of a sensor whose signals are configured as MESSAGE.SIGNAL: its values go to the sensor."""

    def __init__(self, message: Message, signals: Iterable[str], sensor: _Signals) -> None:
        self.message = message
        self.checksum: Checksum | None = None
        self._names = {name: f"{message.name}.{name}" for name in signals}
        self.needed = list(self._names)
        self.warnings: list[str] = []
        self._sensor = sensor

    def events(self, signals: Mapping[str, float], t_receive_ns: int) -> list[Received]:
        values = self._sensor.values
        for name, whole in self._names.items():
            values[whole] = signals[name]
        return self._sensor.events(self.message.name, t_receive_ns)

    def invalid(self, reason: str, t_receive_ns: int) -> list[Received]:
        return self._sensor.invalid(self.message.name, reason, t_receive_ns)


class _Signals(Protocol):
    """A sensor that is made of signals."""

    values: dict[str, float]  # the latest of each signal

    def events(self, message: str, t_receive_ns: int) -> list[Received]:
        """The events that a message completes."""

    def invalid(self, message: str, reason: str, t_receive_ns: int) -> list[Received]:
        """The events of a message that is unusable."""


class ImuSignals:
    """One [imu.NAME]: signals to ImuSample."""

    def __init__(self, name: str, imu: Imu, _bus: str, event: MakeEvent) -> None:
        assert imu.accel_signals is not None and imu.gyro_signals is not None, "the configuration was checked"
        self.values: dict[str, float] = {}
        self._name, self._event = name, event
        self._force, self._rate = imu.accel_signals, imu.gyro_signals
        self._accel, self._gyro = ACCELERATIONS[imu.accel_unit], RATES[imu.gyro_unit]
        self._valid, self._valid_value = imu.valid_signals, imu.valid_value
        self._axes = InertialAxes(imu)
        self._sample = _Sample((*self._force, *self._rate), 1 / imu.rate_hz)

    def events(self, message: str, t_receive_ns: int) -> list[Received]:
        verdict = self._sample.add(message, t_receive_ns)
        if not verdict:
            return []
        payload = self._payload() if verdict == "whole" else Invalid(verdict)
        return [self._event(self._name, NO_STAMP, t_receive_ns, payload)]

    def invalid(self, message: str, reason: str, t_receive_ns: int) -> list[Received]:
        return [self._event(self._name, NO_STAMP, t_receive_ns, Invalid(reason))]

    def _payload(self) -> ImuSample | Invalid:
        values = self.values
        if any(values.get(signal) != self._valid_value for signal in self._valid):
            return Invalid("valid_signals")
        return self._axes.sample(_scaled(values, self._force, self._accel), _scaled(values, self._rate, self._gyro))


class GnssSignals:
    """One [gnss.NAME]: signals to GnssPosition and GnssVelocity."""

    def __init__(self, name: str, gnss: Gnss, bus: str, event: MakeEvent) -> None:
        self.values: dict[str, float] = {}
        self._gnss, self._event = gnss, event
        self._clock = f"{bus}/{name}"
        stamp = () if gnss.time_signal is None or gnss.stamp == "arrival" else (gnss.time_signal,)
        self._streams: list[tuple[str, _Sample, frozenset[str], Callable[[], AnyPayload]]] = []
        self._speed = METRES_PER_SECOND[gnss.speed_unit]
        self._add(f"{name}.position", (*gnss.position_signals(), *stamp), self._position)
        if gnss.gives_velocity:
            self._add(f"{name}.velocity", (*gnss.velocity_signals(), *stamp), self._velocity)
        self._stamped = bool(stamp)

    def _add(self, source: str, signals: tuple[str, ...], payload: Callable[[], AnyPayload]) -> None:
        messages = frozenset(split_signal(signal)[0] for signal in signals)
        self._streams.append((source, _Sample(signals, self._gnss.interval_s), messages, payload))

    def events(self, message: str, t_receive_ns: int) -> list[Received]:
        found = []
        for source, sample, messages, payload in self._streams:
            verdict = sample.add(message, t_receive_ns)
            if verdict == "whole":
                made = payload() if self._is_valid(messages) else Invalid("valid_signals")
                found.append(self._event(source, self._stamp(), t_receive_ns, made))
            elif verdict:
                found.append(self._event(source, NO_STAMP, t_receive_ns, Invalid(verdict)))
        return found

    def invalid(self, message: str, reason: str, t_receive_ns: int) -> list[Received]:
        sources = (source for source, _, messages, _ in self._streams if message in messages)
        return [self._event(source, NO_STAMP, t_receive_ns, Invalid(reason)) for source in sources]

    def _stamp(self) -> Stamp:
        if not self._stamped:
            return NO_STAMP
        seconds = self.values[self._gnss.time_signal or ""]
        return (self._clock, round(seconds * 1e6) * MICROSECOND) if math.isfinite(seconds) else NO_STAMP

    def _is_valid(self, messages: frozenset[str]) -> bool:
        """Whether the signals that guard these messages, or that come in a message of their own, are right."""
        streams = {message for _, _, own, _ in self._streams for message in own}
        for signal in self._gnss.valid_signals:
            message = split_signal(signal)[0]
            concerned = message in messages or message not in streams
            if concerned and self.values.get(signal) != self._gnss.valid_value:
                return False
        return True

    def _fix_type(self) -> int:
        """As GPS_FIX_TYPE; 0 where it is not known yet."""
        gnss = self._gnss
        if gnss.fix_type_signal is None:
            return FIX_3D
        value = self.values.get(gnss.fix_type_signal, 0.0)
        if not math.isfinite(value):
            return 0
        if not gnss.fix_types:
            return int(value)
        return gnss.fix_types[int(value)] if 0 <= value < len(gnss.fix_types) else 0

    def _position(self) -> AnyPayload:
        gnss = self._gnss
        place = _scaled(self.values, gnss.position_signals(), 1.0)
        sigmas = self._known(gnss.position_sigma_signal), self._known(gnss.height_sigma_signal)
        return gnss_position(gnss, self._fix_type(), place, *sigmas)

    def _velocity(self) -> AnyPayload:
        gnss, values = self._gnss, self.values
        if self._fix_type() < gnss.minimum_fix_type:
            return Invalid("no fix")
        sigma = self._known(gnss.velocity_sigma_signal, self._speed)
        parts = [values[signal] for signal in gnss.velocity_signals()]
        if not math.isfinite(sum(parts)):
            return Invalid("not finite")
        if gnss.north_signal is not None:
            north, east, *down = (part * self._speed for part in parts)
            return GnssVelocity(north, east, down[0] if down else None, sigma)
        speed, course = parts[0] * self._speed, math.radians(parts[1])
        course_sigma = self._known(gnss.course_sigma_signal, math.pi / 180)
        if sigma is not None and course_sigma is not None:
            sigma = max(sigma, abs(speed) * course_sigma)
        return velocity_by_course(speed, course, sigma)

    def _known(self, signal: str | None, factor: float = 1.0) -> float | None:
        """An accuracy; 0 means that it is not known."""
        value = 0.0 if signal is None else self.values.get(signal, 0.0) * factor
        return value if 0.0 < value < math.inf else None


def _scaled(values: Mapping[str, float], signals: tuple[str, ...], factor: float) -> Vector3:
    x, y, z = (values[signal] * factor for signal in signals)
    return x, y, z


class CarSignals:
    """One of the car's own sensors: a signal to its payload."""

    def __init__(self, name: str, sensor: CarSensor, _bus: str, event: MakeEvent) -> None:
        self.values: dict[str, float] = {}
        self._name, self._sensor, self._event = name, sensor, event
        self._message = split_signal(sensor.signal)[0]

    def events(self, message: str, t_receive_ns: int) -> list[Received]:
        if message != self._message:
            return []
        return [self._event(self._name, NO_STAMP, t_receive_ns, self._payload())]

    def invalid(self, message: str, reason: str, t_receive_ns: int) -> list[Received]:
        return [self._event(self._name, NO_STAMP, t_receive_ns, Invalid(reason))] if message == self._message else []

    def _payload(self) -> AnyPayload:
        sensor, value = self._sensor, self.values[self._sensor.signal]
        if sensor.valid_signal is not None and self.values.get(sensor.valid_signal) != sensor.valid_value:
            return Invalid("valid_signal")
        if not math.isfinite(value):
            return Invalid("not finite")
        if isinstance(sensor, ParkedSensor):
            return Parked(value in sensor.values)
        assert isinstance(sensor, YawRateSensor | Steering | LateralAccelerometer)
        value = (value - sensor.zero) * sensor.scale
        if isinstance(sensor, YawRateSensor):
            return YawRate(value * RATES[sensor.unit])
        if isinstance(sensor, Steering):
            return SteeringAngle(value * ANGLES[sensor.unit] / sensor.ratio)
        return LateralAcceleration(value * ACCELERATIONS[sensor.unit])


SENSORS: dict[type[Sensor], Callable[[str, Any, str, MakeEvent], _Signals]] = {
    Imu: ImuSignals,
    Gnss: GnssSignals,
    YawRateSensor: CarSignals,
    Steering: CarSignals,
    LateralAccelerometer: CarSignals,
    ParkedSensor: CarSignals,
}


def readers(
    configured: ConfiguredSensor,
    bus: str,
    messages: Mapping[str, Message],
    event: MakeEvent,
    j1939: Callable[[Message], bool],
) -> Iterator[Reader]:
    """The readers of a sensor, one for each of its messages. Raises ConfigError where the DBC lacks one, or a signal."""
    table, name, section = configured
    if isinstance(section, Wheel):
        message = find(section.message or "", messages, f"{table}.{name}.message", "message")
        wheel = WheelReader(name, section, message, event, j1939=j1939(message))
        yield wheel
        if section.direction_signal is not None and "." in section.direction_signal:
            yield _DirectionReader(*_found(section.direction_signal, messages, f"{table}.{name}"), wheel)
        return
    assert isinstance(section, Imu | Gnss | CarSensor), "no other sensor comes by bus"
    sensor = SENSORS[type(section)](name, section, bus, event)
    wanted: dict[str, list[str]] = {}
    for signal in section.signals():
        message, own = _found(signal, messages, f"{table}.{name}")
        wanted.setdefault(message.name, []).append(own)
    for message_name, signals in wanted.items():
        yield _SignalReader(messages[message_name], dict.fromkeys(signals), sensor)


def _found(signal: str, messages: Mapping[str, Message], key: str) -> tuple[Message, str]:
    """The message of MESSAGE.SIGNAL, and the signal's own name. Raises ConfigError where the DBC lacks one."""
    message_name, own = split_signal(signal)
    message = find(message_name, messages, f"{key}: {signal}", "message")
    find(own, {one.name: one for one in message.signals}, f"{key}: {signal}", f"signal of {message_name}")
    return message, own


def _limits(speeds: list[Signal], given: int | None, j1939: bool) -> Iterator[tuple[str, int, float]]:
    """For signals with values that mean "not available": name, sign, and the smallest such value times sign."""
    for place, signal in enumerate(speeds):
        raw = given if place == 0 else None
        if raw is None and j1939 and signal.length >= 8:
            raw = (J1939_VALID_TOP + 1) << signal.length - 8
        if raw is not None:
            sign = 1 if signal.scale > 0 else -1
            yield signal.name, sign, sign * float(signal.offset + (raw - 0.5) * signal.scale)


def _unit_warnings(name: str, wheel: Wheel, speeds: list[Signal]) -> Iterator[str]:
    for signal in speeds:
        unit = DBC_UNITS.get((signal.unit or "").strip().lower())
        if unit is not None and unit != wheel.unit:
            yield f"wheel.{name}.unit: is {wheel.unit}, but the DBC says that {signal.name} is in {signal.unit}"


def _factor(wheel: Wheel) -> float:
    """Metres per second in one unit of the decoded signal."""
    if wheel.unit in METRES_PER_SECOND:
        return METRES_PER_SECOND[wheel.unit] * wheel.scale
    if wheel.radius_m is None:
        raise ConfigError(f"{wheel.unit} needs radius_m")
    return PER_RADIUS[wheel.unit] * wheel.radius_m * wheel.scale


def find(name: str, known: Mapping[str, Item], key: str, kind: str) -> Item:
    """The item of that name. Raises ConfigError with the known names, the most similar first."""
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    names = [*near, *sorted(set(known) - set(near))]
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    raise ConfigError(f"{key}: there is no {kind} '{name}' in the DBC; there is: {', '.join(names[:10])}{more}")
