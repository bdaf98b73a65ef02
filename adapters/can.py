"""CAN in: `Received` wheel speeds out of data frames, by DBC files. No I/O after construction.

Which signal is which wheel, in which unit, and which signals vouch for it, is configuration. A frame is decoded once
for all the wheels in it; frames that carry none are passed over by their id.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import cantools
from cantools.database.can import Database, Message

from fusiond.config import Config, Wheel
from fusiond.measurements import AnyPayload, Invalid, Received, WheelSpeed
from fusiond.toml_file import ConfigError

Item = TypeVar("Item")

NUMBER = (int, float)
EXTENDED = 1 << 31  # set in the keys of 29-bit ids, as in a DBC file and in Linux

METRES_PER_SECOND = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
PER_RADIUS = {"rad/s": 1.0, "rpm": 2 * math.pi / 60}  # times the radius in metres


def frame_key(arbitration_id: int, is_extended: bool) -> int:
    """One number for an id of either length."""
    return arbitration_id | EXTENDED if is_extended else arbitration_id


class CanDecoder:
    """The wheels of one [can.NAME] bus.

    `sequences` holds the last sequence number of every source; decoders of several logs of one vehicle share it.
    `counts` tells what became of the frames. Raises ConfigError where the DBC files cannot be read or lack something.
    """

    def __init__(self, config: Config, bus: str, sequences: dict[str, int] | None = None) -> None:
        self.bus = bus
        self._sequences = {} if sequences is None else sequences
        self._frames: dict[int, tuple[Message, list[_WheelReader]]] = {}
        self.counts = dict.fromkeys(("decoded", "other ids", "undecodable"), 0)
        wheels = {name: wheel for name, wheel in config.wheel.items() if wheel.bus == bus}
        if not wheels:
            return
        messages = _load([config.path(name) for name in config.can[bus].dbc], f"can.{bus}.dbc")
        for name, wheel in wheels.items():
            message = _find(wheel.message, messages, f"wheel.{name}.message", "message")
            key = frame_key(message.frame_id, message.is_extended_frame)
            self._frames.setdefault(key, (message, []))[1].append(_WheelReader(name, wheel, message))

    @property
    def keys(self) -> frozenset[int]:
        """The `frame_key` of every frame that carries a wheel."""
        return frozenset(self._frames)

    def decode(self, arbitration_id: int, is_extended: bool, data: bytes, t_receive_ns: int) -> list[Received]:
        """The wheels in one data frame; none where its id is of no use."""
        entry = self._frames.get(frame_key(arbitration_id, is_extended))
        if entry is None:
            self.counts["other ids"] += 1
            return []
        message, readers = entry
        short = len(data) < message.length
        try:
            signals = message.decode_simple(data, decode_choices=False, allow_truncated=True)
        except cantools.Error:
            self.counts["undecodable"] += 1
            return [self._event(reader.name, t_receive_ns, Invalid("undecodable")) for reader in readers]
        self.counts["decoded"] += 1
        events = []
        for reader in readers:
            payload = reader.read(signals, short)
            if payload is not None:
                events.append(self._event(reader.name, t_receive_ns, payload))
        return events

    def _event(self, source: str, t_receive_ns: int, payload: AnyPayload) -> Received:
        sequence = self._sequences[source] = self._sequences.get(source, -1) + 1
        return Received(source, sequence, "", None, t_receive_ns, payload)


class _WheelReader:
    """One wheel: decoded signals to WheelSpeed, or why not."""

    def __init__(self, name: str, wheel: Wheel, message: Message) -> None:
        self.name = name
        self._wheel = wheel
        self._factor = _factor(wheel)
        signals = {signal.name: signal for signal in message.signals}
        for key in ("signal", "direction_signal", "valid_signal", "counter_signal"):
            wanted = getattr(wheel, key)
            if wanted is not None:
                _find(wanted, signals, f"wheel.{name}.{key}", f"signal of {message.name}")
        guards = (wheel.direction_signal, wheel.valid_signal, wheel.counter_signal)
        self._needed = [wheel.signal, *(guard for guard in guards if guard is not None)]
        self._counter: float | None = None  # last value of counter_signal

    def read(self, signals: Mapping[str, Any], short: bool) -> WheelSpeed | Invalid | None:
        """None where the frame, multiplexed, carries other signals this time."""
        for name in self._needed:
            if not isinstance(signals.get(name), NUMBER):
                return Invalid("short frame") if short else None
        wheel = self._wheel
        if wheel.counter_signal is not None:
            last, self._counter = self._counter, signals[wheel.counter_signal]
            if self._counter == last:
                return Invalid("stale counter")
        if wheel.valid_signal is not None and signals[wheel.valid_signal] != wheel.valid_value:
            return Invalid("valid_signal")
        speed: float = signals[wheel.signal] * self._factor
        if not math.isfinite(speed):
            return Invalid("not finite")
        if wheel.direction_signal is not None and signals[wheel.direction_signal] == wheel.reverse_value:
            speed = -speed
        return WheelSpeed(speed)


def _factor(wheel: Wheel) -> float:
    """Metres per second in one unit of the decoded signal."""
    if wheel.unit in METRES_PER_SECOND:
        return METRES_PER_SECOND[wheel.unit] * wheel.scale
    if wheel.radius_m is None:
        raise ConfigError(f"{wheel.unit} needs radius_m")
    return PER_RADIUS[wheel.unit] * wheel.radius_m * wheel.scale


def _load(paths: Iterable[Path], key: str) -> dict[str, Message]:
    """The messages of all the DBC files. Overlapping signals are tolerated: they are common, and mostly elsewhere."""
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
    """The item of that name, or a ConfigError that names those there are, the nearest first."""
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    names = [*near, *sorted(set(known) - set(near))]
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    raise ConfigError(f"{key}: there is no {kind} '{name}' in the DBC; there is: {', '.join(names[:10])}{more}")
