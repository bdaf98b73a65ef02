"""MAVLink 1 and 2 in: frames out of a byte stream, and `Received` events out of frames. No I/O.

Only the messages that the configuration asks for are checked and decoded; of all others the header alone is read. The
layouts and checksum seeds are those of pymavlink's dialect modules. A frame's missing tail (MAVLink 2 cuts trailing
zeros, MAVLink 1 has no extension fields) reads as zero, which is "unknown" in every extension field used here.

Whose frames count: those of the configured system, or where that is 0 those of the autopilot whose HEARTBEAT comes
first. Until it comes, the first system that sends a wanted IMU or GNSS message stands in, so that a log without
heartbeats can be read and nothing of the first second is lost. Ground stations, and components that are no autopilot
(MAV_AUTOPILOT_INVALID), are never learnt.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable, Sequence
from operator import itemgetter
from struct import Struct, calcsize
from typing import Any

import pymavlink.dialects.v20 as dialects
from fastcrc.crc16 import mcrf4xx

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.events import (
    HOST_CLOCK,
    UNIX_CLOCK,
    AnyPayload,
    ClockPair,
    Received,
    boot_clock,
)
from fusiond_adapters.mavlink.sensors import HANDLERS

MAGIC_1, MAGIC_2 = 0xFE, 0xFD
MAGIC = re.compile(b"[\xfd\xfe]")
SIGNED = 0x01  # the one incompatibility flag that is defined
HEADER_1, HEADER_2, CHECKSUM, SIGNATURE = 6, 10, 2, 13  # bytes
SENDER_1 = Struct("<BBBB")  # at 2: counter, system, component, message id
SENDER_2 = Struct("<BBBHB")  # at 4: the same, the id in two parts
LENGTH_KNOWN = 3  # bytes of a frame that give its length
LONGEST_FRAME = HEADER_2 + 255 + CHECKSUM + SIGNATURE

HEARTBEAT = "HEARTBEAT"
SYSTEM_TIME = "SYSTEM_TIME"
TIMESYNC = "TIMESYNC"
NO_SENSORS = (HEARTBEAT, SYSTEM_TIME, TIMESYNC)
TIMESYNC_MARK, TIMESYNC_STEP = 117, 1000  # ns: fusiond's questions are stamped in whole microseconds plus the mark
TYPE_GROUND_STATION = 6  # MAV_TYPE_GCS
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID

UNIX_FROM_US = 10**15  # a stamp beyond this is Unix time (from 2001-09), below it counts from boot
UNIX_UNTIL_US = 4_102_444_800 * 10**6  # 2100: beyond this it is garbage
CLOCK_SET_US = 1_262_304_000 * 10**6  # 2010: an autopilot that says less has not set its clock
LONGEST_GAP = 128  # a longer jump of the frame counter is a repeat or a reordering, not a loss

Bytes = bytes | bytearray
Pick = Callable[[tuple[Any, ...]], tuple[Any, ...]]
Take = Callable[[tuple[Any, ...], int], list[Received]]  # fields, receive stamp [ns]


def frame_length(buffer: Bytes, at: int = 0) -> int:
    """Length in bytes of the frame that begins at `at`, by its first three bytes; 0 where none can begin."""
    magic = buffer[at]
    if magic == MAGIC_2:
        flags = buffer[at + 2]
        if flags & ~SIGNED:
            return 0
        return HEADER_2 + buffer[at + 1] + CHECKSUM + (SIGNATURE if flags else 0)
    if magic == MAGIC_1:
        return HEADER_1 + buffer[at + 1] + CHECKSUM
    return 0


def message_id(frame: Bytes) -> int:
    """The message id in a frame's header."""
    if frame[0] == MAGIC_2:
        return frame[7] | frame[8] << 8 | frame[9] << 16
    return frame[5]


def is_sound(frame: bytes, seed: bytes) -> bool:
    """Is a frame's checksum right? `seed` is that of its message."""
    end = (HEADER_2 if frame[0] == MAGIC_2 else HEADER_1) + frame[1]
    return mcrf4xx(frame[1:end] + seed) == frame[end] | frame[end + 1] << 8


def _seed(kind: Any) -> bytes:
    return bytes((kind.crc_extra,))


class Dialect:
    """The messages of one pymavlink dialect. Raises ConfigError where there is no such dialect."""

    def __init__(self, name: str) -> None:
        try:
            self._types: dict[int, Any] = importlib.import_module(f"{dialects.__name__}.{name}").mavlink_map
        except (ImportError, AttributeError):
            known = ", ".join(sorted(module.name for module in pkgutil.iter_modules(dialects.__path__)))
            raise ConfigError(f"there is no MAVLink dialect '{name}'; known: {known}") from None
        self.name = name
        self._seeds = {number: _seed(kind) for number, kind in self._types.items()}
        self.ids: dict[str, int] = {kind.msgname: number for number, kind in self._types.items()}

    def type_of(self, message: str) -> Any:
        """pymavlink's class of a message. Raises ConfigError where the dialect has none."""
        if message not in self.ids:
            raise ConfigError(f"the MAVLink dialect '{self.name}' has no message {message}")
        return self._types[self.ids[message]]

    def sound(self, frame: bytes) -> bool | None:
        """Is the checksum right? None where the message, and so the seed of its checksum, is unknown."""
        seed = self._seeds.get(message_id(frame))
        return None if seed is None else is_sound(frame, seed)


class FrameSplitter:
    """Cuts a byte stream into frames. Garbage and frames with a wrong checksum are skipped a byte at a time."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._buffer = bytearray()
        self._in_step = True  # the last frame ended where the buffer begins
        self.skipped_bytes = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Take the next bytes of the stream; give the frames that are now complete."""
        buffer = self._buffer
        buffer += data
        frames = []
        at = 0
        while len(buffer) - at >= LENGTH_KNOWN:
            length = frame_length(buffer, at)
            if length and len(buffer) - at < length:
                break
            sound = self._judge(at, length) if length else False
            if sound is None:
                break
            if sound:
                frames.append(bytes(buffer[at : at + length]))
                at += length
                self._in_step = True
            else:
                found = MAGIC.search(buffer, at + 1)
                start = found.start() if found else len(buffer)
                self.skipped_bytes += start - at
                at = start
                self._in_step = False
        del buffer[:at]
        return frames

    def _judge(self, at: int, length: int) -> bool | None:
        """Is this complete frame one? A message of unknown checksum is accepted when it stands between frames; None
        where that takes the next byte, which is not here yet."""
        end = at + length
        sound = self._dialect.sound(bytes(self._buffer[at:end]))
        if sound is not None:
            return sound
        if end < len(self._buffer):
            return self._buffer[end] in (MAGIC_1, MAGIC_2)
        return True if self._in_step else None


class _Reader:
    """One wanted message: its layout, and what makes events of its fields. Only the fields that any of the `takers` asks
    for are unpacked, and each taker gets its own; a field that is an array gives as many values."""

    def __init__(self, kind: Any, takers: list[tuple[tuple[str, ...], Take]]) -> None:
        fields = tuple(dict.fromkeys(field for wanted, _ in takers for field in wanted))
        layout = _layout(kind, fields)
        self._unpack: Callable[[bytes], tuple[Any, ...]] = layout.unpack
        self._size = layout.size
        self._pick = _pick(kind, [name for name in kind.ordered_fieldnames if name in fields], fields)
        self.seed = _seed(kind)
        self.is_sensor = kind.msgname not in NO_SENSORS
        self.takers = [_picking(take, _pick(kind, fields, wanted)) for wanted, take in takers]

    def fields(self, frame: bytes) -> tuple[Any, ...]:
        """All the fields asked for, of a frame whose checksum is right."""
        start, size = HEADER_2 if frame[0] == MAGIC_2 else HEADER_1, self._size
        present = frame[1]
        payload = frame[start : start + (present if present < size else size)]
        fields = self._unpack(payload.ljust(size, b"\0"))
        return fields if self._pick is None else self._pick(fields)


def _codes(kind: Any) -> dict[str, str]:
    """The struct code of each field of a message, in the order of the wire."""
    return dict(zip(kind.ordered_fieldnames, re.findall(r"\d*[a-zA-Z]", kind.unpacker.format), strict=True))


def _layout(kind: Any, fields: tuple[str, ...]) -> Struct:
    """What unpacks those fields alone, in the order of the wire, up to the last of them."""
    codes = _codes(kind)
    last = max(map(kind.ordered_fieldnames.index, fields))
    parts = (code if name in fields else f"{calcsize('<' + code)}x" for name, code in list(codes.items())[: last + 1])
    return Struct("<" + "".join(parts))


def _pick(kind: Any, given: Sequence[str], wanted: Sequence[str]) -> Pick | None:
    """What picks the values of the fields `wanted` out of those of the fields `given`; None where they are the same."""
    places: dict[str, list[int]] = {}
    codes, count = _codes(kind), 0
    for name in given:
        values = 1 if codes[name].endswith("s") else int(codes[name][:-1] or 1)
        places[name] = list(range(count, count + values))
        count += values
    order = [place for name in wanted for place in places[name]]
    if order == list(range(count)):
        return None
    return itemgetter(*order) if len(order) > 1 else lambda values: (values[order[0]],)


def _picking(take: Take, pick: Pick | None) -> Take:
    return take if pick is None else lambda fields, t_receive_ns: take(pick(fields), t_receive_ns)


class MavlinkDecoder:
    """The sources of one [mavlink.NAME] link.

    `sequences` holds the last sequence number of every source; decoders of several logs of one vehicle share it.
    `counts` says what became of the frames. Raises ConfigError where the dialect lacks a wanted message.
    """

    def __init__(self, config: Config, link: str, sequences: dict[str, int] | None = None) -> None:
        settings = config.mavlink[link]
        self.link = link
        self.system = settings.system  # the system whose frames are taken; 0: none yet
        self.settled = settings.system != 0  # configured, or an autopilot has been heard
        try:
            self.dialect = Dialect(settings.dialect)
            self._readers = self._make_readers(config)
        except ConfigError as error:
            raise ConfigError(f"mavlink.{link}.dialect: {error}") from error
        self._component = settings.component
        self._autopilot = settings.component  # component that answers TIMESYNC; 0: not heard yet
        self._sender = 0  # component of the frame at hand
        self._boot_clock = boot_clock(link, self.system)
        self._sequences = {} if sequences is None else sequences
        self._next_counter: dict[int, int] = {}  # by component
        kinds = ("decoded", "skipped", "other systems", "other components", "other instances")
        self.counts = dict.fromkeys((*kinds, "bad checksum", "undecodable", "lost"), 0)

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        """The events in one complete frame; none where the frame is not wanted or not sound (see `counts`)."""
        if len(frame) < HEADER_1 + CHECKSUM or frame_length(frame) != len(frame):
            self.counts["undecodable"] += 1
            return []
        if frame[0] == MAGIC_2:
            counter, system, component, low, high = SENDER_2.unpack_from(frame, 4)
            return self.take(low | high << 16, counter, system, component, frame, t_receive_ns)
        counter, system, component, number = SENDER_1.unpack_from(frame, 2)
        return self.take(number, counter, system, component, frame, t_receive_ns)

    def take(
        self, number: int, counter: int, system: int, component: int, frame: bytes, t_receive_ns: int
    ) -> list[Received]:
        """The same, of a frame whose length is right and whose header says that: message id, frame counter, sender."""
        reader = self._readers.get(number)
        if self._component and component != self._component:
            self.counts["other components"] += 1
            return []
        if system != self.system and not (reader is not None and self._adopt(system, reader, frame)):
            self.counts["other systems"] += 1
            return []
        if reader is not None and not is_sound(frame, reader.seed):
            self.counts["bad checksum"] += 1
            return []
        expected = self._next_counter.get(component, counter)
        self._next_counter[component] = counter + 1 & 0xFF
        if counter != expected and (counter - expected) & 0xFF < LONGEST_GAP:
            self.counts["lost"] += (counter - expected) & 0xFF
        if reader is None:
            self.counts["skipped"] += 1
            return []
        self.counts["decoded"] += 1
        self._sender = component
        fields = reader.fields(frame)
        if len(reader.takers) == 1:
            return reader.takers[0](fields, t_receive_ns)
        return [event for take in reader.takers for event in take(fields, t_receive_ns)]

    def _adopt(self, system: int, reader: _Reader, frame: bytes) -> bool:
        """Does this frame of a system not followed so far make it the one to follow?"""
        if self.settled or system == 0 or not self.dialect.sound(frame):
            return False
        if reader is self._heartbeat:
            if not _is_autopilot(reader.fields(frame)):
                return False
        elif self.system != 0 or not reader.is_sensor:
            return False
        self.system = system
        self._boot_clock = boot_clock(self.link, system)
        self._next_counter.clear()
        return True

    def _make_readers(self, config: Config) -> dict[int, _Reader]:
        takers: dict[str, list[tuple[tuple[str, ...], Take]]] = {HEARTBEAT: [(("type", "autopilot"), self._take_heartbeat)]}
        if SYSTEM_TIME in self.dialect.ids:
            takers[SYSTEM_TIME] = [(("time_unix_usec", "time_boot_ms"), self._take_system_time)]
        if TIMESYNC in self.dialect.ids:
            takers[TIMESYNC] = [(("tc1", "ts1"), self._take_timesync)]
        for _, name, section in config.sensors(link=self.link):
            handler = HANDLERS[type(section)](self, name, section, config)
            for message in section.messages():
                takers.setdefault(message, []).append((handler.fields, handler.take))
        readers = {message: _Reader(self.dialect.type_of(message), found) for message, found in takers.items()}
        self._heartbeat = readers[HEARTBEAT]
        return {self.dialect.ids[message]: reader for message, reader in readers.items()}

    def _take_heartbeat(self, fields: tuple[Any, ...], _t_receive_ns: int) -> list[Received]:
        if _is_autopilot(fields):
            self.settled, self._autopilot = True, self._autopilot or self._sender
        return []

    def _take_timesync(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        """The autopilot's answer to fusiond's question, recognised by its mark; all that is needed is in the frame."""
        remote_ns, asked_ns = fields
        if remote_ns <= 0 or self._sender != self._autopilot or asked_ns % TIMESYNC_STEP != TIMESYNC_MARK:
            return []
        stamp = (self._boot_clock, remote_ns)
        return [self.event(f"{self.link}.timesync", stamp, t_receive_ns, ClockPair(HOST_CLOCK, asked_ns))]

    def _take_system_time(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        unix_us, boot_ms = fields
        if not CLOCK_SET_US <= unix_us < UNIX_UNTIL_US:
            return []
        pair = ClockPair(self._boot_clock, boot_ms * 10**6)
        return [self.event(f"{self.link}.time", (UNIX_CLOCK, unix_us * 1000), t_receive_ns, pair)]

    def event(self, source: str, stamp: tuple[str, int | None], t_receive_ns: int, payload: AnyPayload) -> Received:
        """The next event of a source. `stamp`: clock, sensor's stamp."""
        sequence = self._sequences[source] = self._sequences.get(source, -1) + 1
        clock, t_sensor_ns = stamp
        return Received(source, sequence, clock, t_sensor_ns, t_receive_ns, payload)

    def stamp(self, time_us: int) -> tuple[str, int | None]:
        """Clock and stamp of a `time_usec` field, Unix or boot time by its magnitude; none where it is 0 or garbage."""
        if 0 < time_us < UNIX_FROM_US:
            return self._boot_clock, time_us * 1000
        if UNIX_FROM_US <= time_us < UNIX_UNTIL_US:
            return UNIX_CLOCK, time_us * 1000
        return "", None


def _is_autopilot(heartbeat: tuple[Any, ...]) -> bool:
    vehicle, autopilot = heartbeat
    return bool(vehicle != TYPE_GROUND_STATION and autopilot != NO_AUTOPILOT)
