"""CAN in: from data frames to `Received` events, by DBC files. No I/O after construction.

The configuration says which signals are which sensor's (`sensors`). A frame is decoded once for all its sensors, and only
the signals in use; frames without sensors are skipped by their id.

J1939 messages (by the bus's key `j1939`, or by the DBC's VFrameFormat) are identified by their PGN, for any priority and
sender. In their speeds, raw values whose top byte is above 0xFA mean an error or "not available".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import cantools
from cantools.database.can import Database, Message, Signal

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.events import AnyPayload, Received
from fusiond_adapters.can.checksums import is_right
from fusiond_adapters.can.sensors import Reader, Stamp, readers

EXTENDED = 1 << 31  # set in the keys of 29-bit ids, as in a DBC file and in Linux
PDU2 = 240  # J1939: a PDU format from here on has no destination


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
        settings = config.can[bus]

        def j1939(message: Message) -> bool:
            return bool(message.is_extended_frame and (settings.j1939 or message.protocol == "j1939"))

        found: dict[tuple[bool, int], list[Reader]] = {}  # by whether it is a J1939 message, and key
        for sensor in sensors:
            for reader in readers(sensor, bus, messages, self._event, j1939):
                number, is_extended = reader.message.frame_id, reader.message.is_extended_frame
                by_group = j1939(reader.message)
                key = parameter_group(number) if by_group else frame_key(number, is_extended)
                found.setdefault((by_group, key), []).append(reader)
                self.warnings += reader.warnings
        for (by_group, key), some in found.items():
            (self._groups if by_group else self._frames)[key] = _Frame(some[0].message, some)

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
            if frame.is_multiplexed and len(data) >= frame.size:  # a page that the DBC does not have
                self.counts["decoded"] += 1
                return []
            self.counts["undecodable"] += 1
            return [event for reader in frame.readers for event in reader.invalid("undecodable", t_receive_ns)]
        self.counts["decoded"] += 1
        short = len(data) < frame.size
        if frame.whole and not short and not frame.checksums:
            return [event for reader in frame.readers for event in reader.events(signals, t_receive_ns)]
        wrong = [kind for kind in frame.checksums if not is_right(kind, arbitration_id, data)]
        events: list[Received] = []
        for reader in frame.readers:
            if reader.checksum in wrong:
                events += reader.invalid("checksum", t_receive_ns)
            elif all(name in signals for name in reader.needed):
                events += reader.events(signals, t_receive_ns)
            elif short:
                events += reader.invalid("short frame", t_receive_ns)  # else it is multiplexed and has others this time
        return events

    def _event(self, source: str, stamp: Stamp, t_receive_ns: int, payload: AnyPayload) -> Received:
        sequence = self._sequences[source] = self._sequences.get(source, -1) + 1
        return Received(source, sequence, stamp[0], stamp[1], t_receive_ns, payload)


class _Frame:
    """One frame with sensors, and how to extract the signals in use from its data."""

    def __init__(self, message: Message, readers: Sequence[Reader]) -> None:
        self.readers = readers
        self.checksums = sorted({reader.checksum for reader in readers if reader.checksum is not None})
        self.size = message.length
        names = {name for reader in readers for name in reader.needed}
        fields = [_field(signal, message.length) for signal in message.signals if signal.name in names]
        plain = [field for field in fields if field is not None]
        self.is_multiplexed = message.is_multiplexed()
        self.whole = not self.is_multiplexed and len(plain) == len(fields)  # signals are missing only in short frames
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
