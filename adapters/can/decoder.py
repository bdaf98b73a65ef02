"""CAN in: from data frames to `Received` events, by DBC files. No I/O after construction.

The configuration says which signal is which wheel, its unit, and which signals validate it. A frame is decoded once for
all its sensors, and only the signals in use; frames without sensors are skipped by their id.

J1939 messages (by the bus's key `j1939`, or by the DBC's VFrameFormat) are identified by their PGN, for any priority and
sender. In their speeds, raw values whose top byte is above 0xFA mean an error or "not available".
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, cast

import cantools
from cantools.database.can import Database, Message, Signal

from fusiond.config.schema import Checksum, Config, Wheel
from fusiond.config.sensor import Sensor
from fusiond.config.toml import ConfigError
from fusiond.events import AnyPayload, Invalid, Received, WheelSpeed
from fusiond_adapters.can.checksums import is_right

Item = TypeVar("Item")

EXTENDED = 1 << 31  # set in the keys of 29-bit ids, as in a DBC file and in Linux

METRES_PER_SECOND = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
DBC_UNITS = {  # as DBC files write them, in lower case: as the configuration does
    "m/s": "m/s", "mps": "m/s", "km/h": "km/h", "kph": "km/h", "kmh": "km/h", "kmph": "km/h", "km/hr": "km/h",
    "mph": "mph", "mi/h": "mph", "rad/s": "rad/s", "rads/s": "rad/s", "rad/sec": "rad/s",
    "rpm": "rpm", "1/min": "rpm", "r/min": "rpm", "rev/min": "rpm",
}  # fmt: skip
J1939_VALID_TOP = 0xFA  # largest top byte of a valid J1939 value
PDU2 = 240  # J1939: a PDU format from here on has no destination
PER_RADIUS = {"rad/s": 1.0, "rpm": 2 * math.pi / 60}  # times the radius in metres


def frame_key(arbitration_id: int, is_extended: bool) -> int:
    """One number for ids of both lengths."""
    return arbitration_id | EXTENDED if is_extended else arbitration_id


def parameter_group(arbitration_id: int) -> int:
    """The J1939 parameter group number (PGN) of a 29-bit id."""
    number = arbitration_id >> 8 & 0x3FFFF
    return number if number >> 8 & 0xFF >= PDU2 else number & 0x3FF00


class CanDecoder:
    """The sensors of one [can.NAME] bus.

    `sequences` holds the last sequence number of every source; decoders of several logs of one vehicle share it.
    `counts` has the number of frames by outcome, `warnings` oddities of the configuration. Raises ConfigError if the DBC
    files cannot be read or lack something.
    """

    def __init__(self, config: Config, bus: str, sequences: dict[str, int] | None = None) -> None:
        self.bus = bus
        self._sequences = {} if sequences is None else sequences
        self._frames: dict[int, _Frame] = {}
        self._groups: dict[int, _Frame] = {}  # J1939, by PGN
        self.warnings: list[str] = []
        self.counts = dict.fromkeys(("decoded", "other ids", "undecodable"), 0)
        sensors = list(config.sensors(bus=bus))
        if not sensors:
            return
        messages = _load([config.path(name) for name in config.can[bus].dbc], f"can.{bus}.dbc")
        for table, name, section in sensors:
            for wanted in section.messages():
                message = _find(wanted, messages, f"{table}.{name}.message", "message")
                j1939 = message.is_extended_frame and (config.can[bus].j1939 or message.protocol == "j1939")
                frames, key = self._frames, frame_key(message.frame_id, message.is_extended_frame)
                if j1939:
                    frames, key = self._groups, parameter_group(message.frame_id)
                others = frames[key].readers if key in frames else ()
                reader = READERS[type(section)](name, section, message, j1939)
                frames[key] = _Frame(message, [*others, reader])
                self.warnings += reader.warnings

    @property
    def keys(self) -> frozenset[int]:
        """The `frame_key` of every frame with a sensor, except J1939."""
        return frozenset(self._frames)

    @property
    def groups(self) -> frozenset[int]:
        """The PGN of every J1939 frame with a sensor."""
        return frozenset(self._groups)

    def decode(self, arbitration_id: int, is_extended: bool, data: bytes, t_receive_ns: int) -> list[Received]:
        """The events of one data frame; none if it has no sensor."""
        frame = self._frames.get(frame_key(arbitration_id, is_extended))
        if frame is None and self._groups and is_extended:
            frame = self._groups.get(parameter_group(arbitration_id))
        if frame is None:
            self.counts["other ids"] += 1
            return []
        try:
            signals = frame.signals(data)
        except cantools.Error:
            self.counts["undecodable"] += 1
            return [self._event(reader.name, t_receive_ns, Invalid("undecodable")) for reader in frame.readers]
        self.counts["decoded"] += 1
        short = len(data) < frame.size
        if frame.whole and not short and not frame.checksums:
            return [self._event(reader.name, t_receive_ns, reader.payload(signals)) for reader in frame.readers]
        wrong = [kind for kind in frame.checksums if not is_right(kind, arbitration_id, data)]
        events = []
        for reader in frame.readers:
            payload = Invalid("checksum") if reader.checksum in wrong else reader.read(signals, short)
            if payload is not None:
                events.append(self._event(reader.name, t_receive_ns, payload))
        return events

    def _event(self, source: str, t_receive_ns: int, payload: AnyPayload) -> Received:
        sequence = self._sequences[source] = self._sequences.get(source, -1) + 1
        return Received(source, sequence, "", None, t_receive_ns, payload)


class Reader(Protocol):
    """Makes the events of one sensor from decoded signals."""

    name: str
    checksum: Checksum | None  # kind of checksum at the end of the frame
    needed: list[str]  # signals
    warnings: list[str]  # oddities of its configuration

    def read(self, signals: Mapping[str, float], short: bool) -> AnyPayload | None:
        """The payload; None if the frame is multiplexed and has other signals this time."""

    def payload(self, signals: Mapping[str, float]) -> AnyPayload:
        """The payload if none of the needed signals is missing."""


class _Frame:
    """One frame with sensors, and how to extract the signals in use from its data."""

    def __init__(self, message: Message, readers: Sequence[Reader]) -> None:
        self.readers = readers
        self.checksums = sorted({reader.checksum for reader in readers if reader.checksum is not None})
        self.size = message.length
        names = {name for reader in readers for name in reader.needed}
        fields = [_field(signal, message.length) for signal in message.signals if signal.name in names]
        plain = [field for field in fields if field is not None]
        self.whole = not message.is_multiplexed() and len(plain) == len(fields)  # signals are missing only in short frames
        if not self.whole:
            decode = partial(message.decode_simple, decode_choices=False, allow_truncated=True)
            self.signals = cast("Callable[[bytes], Mapping[str, float]]", decode)  # without choices all values are numbers
        else:
            self.signals = partial(_extract, plain, message.length)


class _Field(NamedTuple):
    """Position of one integer signal in the number made of the frame's data followed by the same bytes in reverse."""

    name: str
    end: int  # bits that a frame must have to hold it
    shift: int
    mask: int
    sign: int  # its bit, or 0
    scale: float
    offset: float


def _field(signal: Signal, size: int) -> _Field | None:
    """A signal of a message of `size` bytes, as cantools decodes it; None if it is not an integer or exceeds the frame."""
    length, is_big = signal.length, signal.byte_order == "big_endian"
    begin = 8 * (signal.start // 8) + 7 - signal.start % 8 if is_big else signal.start  # counted from the first bit sent
    end = begin + length
    if signal.is_float or end > 8 * size:
        return None
    shift = 16 * size - end if is_big else begin
    sign = 1 << length - 1 if signal.is_signed else 0
    scale, offset = signal.conversion.scale, signal.conversion.offset
    if float(scale).is_integer() and float(offset).is_integer():
        scale, offset = int(scale), int(offset)
    return _Field(signal.name, end, shift, (1 << length) - 1, sign, scale, offset)


def _extract(fields: Sequence[_Field], size: int, data: bytes) -> dict[str, float]:
    """The signals of a message of `size` bytes; of a short frame, only those that it contains."""
    bits = 8 * len(data)
    if len(data) != size:
        data = data[:size].ljust(size, b"\0")
    number = int.from_bytes(data + data[::-1], "big")
    found = {}
    for name, end, shift, mask, sign, scale, offset in fields:
        if end <= bits:
            raw = number >> shift & mask
            found[name] = (raw - 2 * (raw & sign)) * scale + offset
    return found


class _WheelReader:
    """One wheel: from decoded signals to a WheelSpeed, or to the reason for none."""

    def __init__(self, name: str, wheel: Wheel, message: Message, j1939: bool) -> None:
        self.name = name
        self.checksum = wheel.checksum
        self._wheel = wheel
        self._factor = _factor(wheel)
        self._signal = wheel.signal or ""
        signals = {signal.name: signal for signal in message.signals}
        for key in ("signal", "direction_signal", "valid_signal", "counter_signal", "base_signal"):
            wanted = getattr(wheel, key)
            if wanted is not None:
                _find(wanted, signals, f"wheel.{name}.{key}", f"signal of {message.name}")
        guards = (wheel.direction_signal, wheel.valid_signal, wheel.counter_signal, wheel.base_signal)
        self.needed = [self._signal, *(guard for guard in guards if guard is not None)]
        self._counter: float | None = None  # last value of counter_signal
        speeds = [signals[speed] for speed in (self._signal, wheel.base_signal) if speed is not None]
        self._limits = list(_limits(speeds, wheel.not_available_from, j1939))
        self.warnings = list(_unit_warnings(name, wheel, speeds))

    def read(self, signals: Mapping[str, float], short: bool) -> WheelSpeed | Invalid | None:
        """The speed; None if the frame is multiplexed and has other signals this time."""
        for name in self.needed:
            if name not in signals:
                return Invalid("short frame") if short else None
        return self.payload(signals)

    def payload(self, signals: Mapping[str, float]) -> WheelSpeed | Invalid:
        """The speed, if the other signals say that it is valid; none of the needed signals is missing."""
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
        if wheel.direction_signal is not None and signals[wheel.direction_signal] == wheel.reverse_value:
            speed = -speed
        return WheelSpeed(speed)


READERS: dict[type[Sensor], Callable[[str, Any, Message, bool], Reader]] = {Wheel: _WheelReader}


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


def _load(paths: Iterable[Path], key: str) -> dict[str, Message]:
    """The messages of all DBC files. Overlapping signals are tolerated: they are common, mostly in unused messages."""
    messages: dict[str, Message] = {}
    for path in paths:
        try:
            database = cantools.database.load_file(path, database_format="dbc", strict=False)
        except OSError as error:
            raise ConfigError(f"{key}: {path}: cannot be read: {error.strerror}") from error
        except (cantools.Error, ValueError, LookupError) as error:
            raise ConfigError(f"{key}: {path}: not a valid DBC file: {error}") from error
        if isinstance(database, Database):
            messages = {message.name: message for message in database.messages} | messages
    return messages


def _find(name: str, known: Mapping[str, Item], key: str, kind: str) -> Item:
    """The item of that name. Raises ConfigError with the known names, the most similar first."""
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    names = [*near, *sorted(set(known) - set(near))]
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    raise ConfigError(f"{key}: there is no {kind} '{name}' in the DBC; there is: {', '.join(names[:10])}{more}")
