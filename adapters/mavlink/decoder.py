"""MAVLink 1 and 2 in: frames out of a byte stream, and `Received` events out of frames. No I/O.

Only the messages that the configuration asks for are checked and decoded; of all others the header alone is read. The
layouts and checksum seeds are those of pymavlink's dialect modules. A frame's missing tail (MAVLink 2 cuts trailing
zeros, MAVLink 1 has no extension fields) reads as zero, which is "unknown" in every extension field used here.

Frames are decoded from one system: the configured one, or if that is 0 the autopilot whose HEARTBEAT comes first. Until
then the first system that sends a wanted IMU or GNSS message is used, so that a log without heartbeats can be read and
the first second is not lost. Ground stations and components that are no autopilot (MAV_AUTOPILOT_INVALID) are never
chosen.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable, Hashable, Sequence
from operator import itemgetter
from struct import Struct, calcsize
from typing import Any, cast

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
from fusiond.units import MICROSECOND, MILLISECOND
from fusiond_adapters.mavlink.sensors import HANDLERS
from fusiond_adapters.mavlink.timesync import Timesync

MAGIC_1, MAGIC_2 = 0xFE, 0xFD
MAGIC = re.compile(b"[\xfd\xfe]")
SIGNED = 0x01  # the one incompatibility flag that is defined
HEADER_1, HEADER_2, CHECKSUM, SIGNATURE = 6, 10, 2, 13  # bytes
SENDER_1 = Struct("<BBBB")  # at 2: counter, system, component, message id
SENDER_2 = Struct("<BBBHB")  # at 4: the same, the id in two parts
LENGTH_KNOWN = 3  # bytes of a frame that give its length
MAX_FRAME_BYTES = HEADER_2 + 255 + CHECKSUM + SIGNATURE

HEARTBEAT = "HEARTBEAT"
SYSTEM_TIME = "SYSTEM_TIME"
TIMESYNC = "TIMESYNC"
NO_SENSORS = (HEARTBEAT, SYSTEM_TIME, TIMESYNC)
TIMESYNC_MARK, TIMESYNC_STEP = 117, 1000  # ns: fusiond's requests are stamped in whole microseconds plus the mark
TYPE_GROUND_STATION = 6  # MAV_TYPE_GCS
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID

HALF_TURN = 128  # of the frame counter

UNIX_FROM_US = 10**15  # a stamp beyond this is Unix time (from 2001-09), below it counts from boot
UNIX_UNTIL_US = 4_102_444_800 * 10**6  # 2100: a later stamp is invalid
CLOCK_SET_US = 1_262_304_000 * 10**6  # 2010: before this the autopilot's clock is not set

Bytes = bytes | bytearray
Pick = Callable[[tuple[Any, ...]], tuple[Any, ...]]
EventsOf = Callable[[tuple[Any, ...], int], list[Received]]  # fields, receive stamp [ns]


def frame_length(buffer: Bytes, at: int = 0) -> int:
    """Length in bytes of the frame that begins at `at`, from its first three bytes; 0 if no frame begins there."""
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

    def name_of(self, number: int) -> str:
        """The name of a message; its number as text where the dialect does not know it."""
        return str(self._types[number].msgname) if number in self._types else str(number)

    def knows(self, number: int) -> bool:
        """Is a message known by its id, and so the seed of its checksum?"""
        return number in self._seeds

    def sound(self, frame: bytes) -> bool | None:
        """Is the checksum right? None where the message, and so the seed of its checksum, is unknown."""
        seed = self._seeds.get(message_id(frame))
        return None if seed is None else is_sound(frame, seed)


class FrameSplitter:
    """Cuts a byte stream into frames. Garbage and frames with a wrong checksum are skipped a byte at a time; after
    `false_starts` in one piece of the stream the rest of it is, so that garbage takes no more time than frames do."""

    def __init__(self, dialect: Dialect, false_starts: int = 64) -> None:
        self._dialect = dialect
        self._buffer = bytearray()
        self._in_step = True  # the last frame ended where the buffer begins
        self._false_starts = false_starts
        self.skipped_bytes = 0

    @property
    def rest(self) -> bytes:
        """The bytes that may be the beginning of a frame."""
        return bytes(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Add the next bytes of the stream; returns the frames that are now complete."""
        buffer = self._buffer
        buffer += data
        frames = []
        at = misses = 0
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
                misses += 1
                found = MAGIC.search(buffer, at + 1) if misses < self._false_starts else None
                start = found.start() if found else len(buffer)
                self.skipped_bytes += start - at
                at = start
                self._in_step = False
        del buffer[:at]
        return frames

    def _judge(self, at: int, length: int) -> bool | None:
        """Whether this complete frame is sound. A message of unknown checksum is accepted between two frames; None if that
        depends on the next byte, which has not been received yet."""
        end = at + length
        sound = self._dialect.sound(bytes(self._buffer[at:end]))
        if sound is not None:
            return sound
        if end < len(self._buffer):
            return self._buffer[end] in (MAGIC_1, MAGIC_2)
        return True if self._in_step else None


class PeerSplitter:
    """Frames of several peers: what one sends is never mistaken for a part of another's frame.

    A stream has one peer at a time. A datagram begins anew: the frame that the same peer's last one left incomplete is
    continued only by a datagram that does not itself begin with a frame (a bridge from a serial line cuts anywhere).
    """

    PARTS = 64  # incomplete frames that are kept, each of another peer
    FALSE_STARTS = 16  # in a datagram

    def __init__(self, dialect: Dialect, *, datagrams: bool) -> None:
        self.skipped_bytes = 0
        self._dialect, self._datagrams = dialect, datagrams
        self._parts: dict[Hashable, bytes] = {}
        self._stream, self._peer = FrameSplitter(dialect), cast(Hashable, None)

    def feed(self, data: bytes, peer: Hashable) -> list[bytes]:
        """Add a datagram, or the next bytes of a stream; returns the frames that are now complete."""
        if self._datagrams:
            return self._feed_datagram(data, peer)
        if peer != self._peer:
            self.skipped_bytes += len(self._stream.rest)
            self._stream, self._peer = FrameSplitter(self._dialect), peer
        before = self._stream.skipped_bytes
        frames = self._stream.feed(data)
        self.skipped_bytes += self._stream.skipped_bytes - before
        return frames

    def _feed_datagram(self, data: bytes, peer: Hashable) -> list[bytes]:
        splitter = FrameSplitter(self._dialect, self.FALSE_STARTS)
        frames = splitter.feed(data)
        if (part := self._parts.pop(peer, None)) is not None:
            if frames and data.startswith(frames[0]):
                self.skipped_bytes += len(part)
            else:
                splitter = FrameSplitter(self._dialect, self.FALSE_STARTS)
                frames = splitter.feed(part + data)
        self.skipped_bytes += splitter.skipped_bytes
        if rest := splitter.rest:
            if len(self._parts) >= self.PARTS:
                self.skipped_bytes += len(self._parts.pop(next(iter(self._parts))))
            self._parts[peer] = rest
        return frames

    @property
    def waiting_bytes(self) -> int:
        """Bytes of frames that are not complete yet."""
        return len(self._stream.rest) + sum(map(len, self._parts.values()))


class _Reader:
    """One wanted message: its layout, and the functions that make events of its fields. Only the fields that any of the
    `handlers` needs are unpacked, and each handler gets its own; an array field gives as many values."""

    def __init__(self, kind: Any, handlers: list[tuple[tuple[str, ...], EventsOf]]) -> None:
        fields = tuple(dict.fromkeys(field for wanted, _ in handlers for field in wanted))
        layout = _layout(kind, fields)
        self._unpack: Callable[[bytes], tuple[Any, ...]] = layout.unpack
        self._size = layout.size
        self._pick = _pick(kind, [name for name in kind.ordered_fieldnames if name in fields], fields)
        self.seed = _seed(kind)
        self.is_sensor = kind.msgname not in NO_SENSORS
        self.handlers = [_picking(events, _pick(kind, fields, wanted)) for wanted, events in handlers]

    def fields(self, frame: bytes) -> tuple[Any, ...]:
        """All the fields that the handlers need, of a frame whose checksum is right."""
        start, size = HEADER_2 if frame[0] == MAGIC_2 else HEADER_1, self._size
        present = frame[1]
        payload = frame[start : start + (present if present < size else size)]
        fields = self._unpack(payload.ljust(size, b"\0"))
        return fields if self._pick is None else self._pick(fields)


def _codes(kind: Any) -> dict[str, str]:
    """The struct code of each field of a message, in the order of the wire."""
    return dict(zip(kind.ordered_fieldnames, re.findall(r"\d*[a-zA-Z]", kind.unpacker.format), strict=True))


def _layout(kind: Any, fields: tuple[str, ...]) -> Struct:
    """The struct that unpacks only those fields, in the order of the wire, up to the last of them."""
    codes = _codes(kind)
    last = max(map(kind.ordered_fieldnames.index, fields))
    parts = (code if name in fields else f"{calcsize('<' + code)}x" for name, code in list(codes.items())[: last + 1])
    return Struct("<" + "".join(parts))


def _pick(kind: Any, given: Sequence[str], wanted: Sequence[str]) -> Pick | None:
    """A function that picks the values of the fields `wanted` out of those of the fields `given`; None if they are equal."""
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


def _picking(events: EventsOf, pick: Pick | None) -> EventsOf:
    return events if pick is None else lambda fields, t_receive_ns: events(pick(fields), t_receive_ns)


class FrameCounters:
    """The frame counters of one sender, which go round after 256: what is missing, and what comes late or twice.

    A counter at most half a turn back is late where it was missing, a repeat where it came with the same last bytes (the
    checksum). Any other that is not the next is a gap, of up to 255. A frame of a message whose checksum is not known is
    never evidence of a gap: it only says that its own counter is not missing.
    """

    def __init__(self, first: int) -> None:
        self._next = first
        self._seen: list[bytes | None] = [None] * 256  # the end of the frame that came last, by counter
        self._missing = bytearray(256)
        self._unsure: set[int] = set()

    def add(self, counter: int, frame: bytes, sure: bool) -> tuple[int, bool]:
        """Frames newly found missing, and whether this one was counted as missing before. `sure`: its checksum is right."""
        if not sure:
            self._unsure.add(counter)
            return 0, False
        lost, end = 0, frame[-CHECKSUM:]
        if counter != self._next:
            if (self._next - counter) & 0xFF <= HALF_TURN:
                if self._missing[counter]:
                    self._missing[counter], self._seen[counter] = 0, end
                    return 0, True
                if self._seen[counter] == end:
                    return 0, False
            while self._next != counter:
                missing = self._next not in self._unsure
                self._missing[self._next], self._seen[self._next] = missing, None
                lost += missing
                self._next = self._next + 1 & 0xFF
        if self._unsure:
            self._unsure.clear()
        self._missing[counter], self._seen[counter] = 0, end
        self._next = counter + 1 & 0xFF
        return lost, False


class MavlinkDecoder:
    """The sources of one [mavlink.NAME] link.

    `sequences` holds the last sequence number of every source; decoders of several logs of one vehicle share it.
    `counts` has the number of frames by outcome. Raises ConfigError where the dialect lacks a wanted message.
    """

    def __init__(self, config: Config, link: str, sequences: dict[str, int] | None = None) -> None:
        settings = config.mavlink[link]
        self.link = link
        self.system = settings.system  # the system whose frames are decoded; 0: none yet
        self.found = settings.system != 0  # configured, or an autopilot's heartbeat was received
        try:
            self.dialect = Dialect(settings.dialect)
            self._readers = self._make_readers(config)
        except ConfigError as error:
            raise ConfigError(f"mavlink.{link}.dialect: {error}") from error
        self._component = settings.component
        self._own_system, self._own_component = settings.own_system, settings.own_component
        self._autopilot = settings.component  # component that answers TIMESYNC; 0: not known yet
        self._sender = 0  # component of the present frame
        self._boot_clock = boot_clock(link, self.system)
        self._sequences = {} if sequences is None else sequences
        self._counters: dict[int, FrameCounters] = {}  # by component
        kinds = ("decoded", "skipped", "other systems", "other components", "other instances")
        self.counts = dict.fromkeys((*kinds, "bad checksum", "undecodable", "lost", "late"), 0)

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        """The events in one complete frame; none where the frame is not wanted or not sound (see `counts`)."""
        if len(frame) < HEADER_1 + CHECKSUM or frame_length(frame) != len(frame):
            self.counts["undecodable"] += 1
            return []
        if frame[0] == MAGIC_2:
            counter, system, component, low, high = SENDER_2.unpack_from(frame, 4)
            return self.decode_by_header(low | high << 16, counter, system, component, frame, t_receive_ns)
        counter, system, component, number = SENDER_1.unpack_from(frame, 2)
        return self.decode_by_header(number, counter, system, component, frame, t_receive_ns)

    def decode_by_header(
        self, number: int, counter: int, system: int, component: int, frame: bytes, t_receive_ns: int
    ) -> list[Received]:
        """The same for a frame of the right length whose header has been read: message id, frame counter, sender."""
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
        self._follow(component, counter, frame, sure=reader is not None or self.dialect.knows(number))
        if reader is None:
            self.counts["skipped"] += 1
            return []
        self.counts["decoded"] += 1
        self._sender = component
        fields = reader.fields(frame)
        if len(reader.handlers) == 1:
            return reader.handlers[0](fields, t_receive_ns)
        return [event for events in reader.handlers for event in events(fields, t_receive_ns)]

    def _follow(self, component: int, counter: int, frame: bytes, *, sure: bool) -> None:
        """Count the frames that are missing before this one, by the frame counter of its sender."""
        counters = self._counters.get(component)
        if counters is None:
            if not sure:
                return
            counters = self._counters[component] = FrameCounters(counter)
        lost, late = counters.add(counter, frame, sure)
        if lost or late:
            self.counts["lost"] += lost
            self.counts["late"] += late

    def _adopt(self, system: int, reader: _Reader, frame: bytes) -> bool:
        """Whether this frame makes its system the one whose frames are decoded; if so, it is from now on."""
        if self.found or system == 0 or not self.dialect.sound(frame):
            return False
        if reader is self._heartbeat:
            if not _is_autopilot(reader.fields(frame)):
                return False
        elif self.system != 0 or not reader.is_sensor:
            return False
        self.system = system
        self._boot_clock = boot_clock(self.link, system)
        self._counters.clear()
        return True

    def _make_readers(self, config: Config) -> dict[int, _Reader]:
        handlers: dict[str, list[tuple[tuple[str, ...], EventsOf]]] = {}
        handlers[HEARTBEAT] = [(("type", "autopilot"), self._heartbeat_events)]
        if SYSTEM_TIME in self.dialect.ids:
            handlers[SYSTEM_TIME] = [(("time_unix_usec", "time_boot_ms"), self._system_time_events)]
        if TIMESYNC in self.dialect.ids:
            fields = ("tc1", "ts1", "target_system", "target_component")
            handlers[TIMESYNC] = [(fields, self._timesync_events)]
        for _, name, section in config.sensors(link=self.link):
            handler = HANDLERS[type(section)](self, name, section, config)
            for message in section.messages():
                handlers.setdefault(message, []).append((handler.fields, handler.events))
        kinds = {message: Timesync if message == TIMESYNC else self.dialect.type_of(message) for message in handlers}
        readers = {message: _Reader(kinds[message], found) for message, found in handlers.items()}
        self._heartbeat = readers[HEARTBEAT]
        return {self.dialect.ids[message]: reader for message, reader in readers.items()}

    def _heartbeat_events(self, fields: tuple[Any, ...], _t_receive_ns: int) -> list[Received]:
        if _is_autopilot(fields):
            self.found, self._autopilot = True, self._autopilot or self._sender
        return []

    def _timesync_events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        """The autopilot's answer to fusiond's request, recognised by its mark; the frame contains both stamps."""
        remote_ns, sent_ns, to_system, to_component = fields
        if remote_ns <= 0 or self._sender != self._autopilot or sent_ns % TIMESYNC_STEP != TIMESYNC_MARK:
            return []
        if to_system not in (0, self._own_system or self.system) or to_component not in (0, self._own_component):
            return []
        stamp = (self._boot_clock, remote_ns)
        return [self.event(f"{self.link}.timesync", stamp, t_receive_ns, ClockPair(HOST_CLOCK, sent_ns))]

    def _system_time_events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        unix_us, boot_ms = fields
        if not CLOCK_SET_US <= unix_us < UNIX_UNTIL_US:
            return []
        pair = ClockPair(self._boot_clock, boot_ms * MILLISECOND)
        return [self.event(f"{self.link}.time", (UNIX_CLOCK, unix_us * MICROSECOND), t_receive_ns, pair)]

    def event(self, source: str, stamp: tuple[str, int | None], t_receive_ns: int, payload: AnyPayload) -> Received:
        """The next event of a source. `stamp`: clock, sensor's stamp."""
        sequence = self._sequences[source] = self._sequences.get(source, -1) + 1
        clock, t_sensor_ns = stamp
        return Received(source, sequence, clock, t_sensor_ns, t_receive_ns, payload)

    def stamp(self, time_us: int) -> tuple[str, int | None]:
        """Clock and stamp of a `time_usec` field, Unix or boot time by its magnitude; none if it is 0 or invalid."""
        if 0 < time_us < UNIX_FROM_US:
            return self._boot_clock, time_us * MICROSECOND
        if UNIX_FROM_US <= time_us < UNIX_UNTIL_US:
            return UNIX_CLOCK, time_us * MICROSECOND
        return "", None


def _is_autopilot(heartbeat: tuple[Any, ...]) -> bool:
    vehicle, autopilot = heartbeat
    return bool(vehicle != TYPE_GROUND_STATION and autopilot != NO_AUTOPILOT)
