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
import math
import pkgutil
import re
from collections.abc import Callable
from operator import itemgetter
from struct import Struct
from typing import Any

import pymavlink.dialects.v20 as dialects
from fastcrc.crc16 import mcrf4xx

from fusiond.config import Config, Gnss, Imu
from fusiond.measurements import (
    UNIX_CLOCK,
    AnyPayload,
    ClockPair,
    GnssPosition,
    GnssVelocity,
    ImuSample,
    Invalid,
    Received,
    Vector3,
    boot_clock,
)
from fusiond.toml_file import ConfigError

MAGIC_1, MAGIC_2 = 0xFE, 0xFD
MAGIC = re.compile(b"[\xfd\xfe]")
SIGNED = 0x01  # the one incompatibility flag that is defined
HEADER_1, HEADER_2, CHECKSUM, SIGNATURE = 6, 10, 2, 13  # bytes
SENDER_1 = Struct("<BBBB")  # at 2: counter, system, component, message id
SENDER_2 = Struct("<BBBHB")  # at 4: the same, the id in two parts
LENGTH_KNOWN = 3  # bytes of a frame that tell its length
LONGEST_FRAME = HEADER_2 + 255 + CHECKSUM + SIGNATURE

HEARTBEAT = "HEARTBEAT"
SYSTEM_TIME = "SYSTEM_TIME"
TYPE_GROUND_STATION = 6  # MAV_TYPE_GCS
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID

UNIX_FROM_US = 10**15  # a stamp beyond this is Unix time (from 2001-09), below it counts from boot
UNIX_UNTIL_US = 4_102_444_800 * 10**6  # 2100: beyond this it is garbage
CLOCK_SET_US = 1_262_304_000 * 10**6  # 2010: an autopilot that says less has not set its clock
MILLI_G = 9.80665e-3  # m/s^2
UNKNOWN_U16 = 65535
ACCEL_AND_GYRO = 0x3F  # HIGHRES_IMU.fields_updated
LONGEST_GAP = 128  # a longer jump of the frame counter is a repeat or a reordering, not a loss

Bytes = bytes | bytearray


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
        known = sorted(module.name for module in pkgutil.iter_modules(dialects.__path__))
        if name not in known:
            raise ConfigError(f"there is no MAVLink dialect '{name}'; known: {', '.join(known)}")
        self.name = name
        self._types: dict[int, Any] = importlib.import_module(f"pymavlink.dialects.v20.{name}").mavlink_map
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
        """Is this complete frame one? A message of unknown checksum is believed when it stands between frames; None
        says that this takes the next byte, which is not here yet."""
        end = at + length
        sound = self._dialect.sound(bytes(self._buffer[at:end]))
        if sound is not None:
            return sound
        if end < len(self._buffer):
            return self._buffer[end] in (MAGIC_1, MAGIC_2)
        return True if self._in_step else None


class _Reader:
    """One wanted message: its layout, and the functions that make events of its fields."""

    def __init__(self, kind: Any, fields: tuple[str, ...]) -> None:
        self._unpack: Callable[[bytes], tuple[Any, ...]] = kind.unpacker.unpack
        self._size: int = kind.unpacker.size
        self.seed = _seed(kind)
        self._pick = itemgetter(*(kind.ordered_fieldnames.index(name) for name in fields))
        self.is_sensor = kind.msgname not in (HEARTBEAT, SYSTEM_TIME)
        self.handlers: list[Callable[[tuple[Any, ...], int], list[Received]]] = []

    def fields(self, frame: bytes) -> tuple[Any, ...]:
        """The fields asked for, of a frame whose checksum is right."""
        start = HEADER_2 if frame[0] == MAGIC_2 else HEADER_1
        payload = frame[start : start + min(frame[1], self._size)]
        picked: tuple[Any, ...] = self._pick(self._unpack(payload.ljust(self._size, b"\0")))
        return picked


_AXES = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")
_IMU_STAMP = {"HIGHRES_IMU": "time_usec", "RAW_IMU": "time_usec"}
_IMU_EXTRA = {"HIGHRES_IMU": ("fields_updated", "id")}
_GNSS_BASE = ("time_usec", "fix_type", "lat", "lon", "alt", "vel", "cog")
_GNSS_EXTENSIONS = ("alt_ellipsoid", "h_acc", "v_acc", "vel_acc")


class MavlinkDecoder:
    """The sources of one [mavlink.NAME] link.

    `sequences` holds the last sequence number of every source; decoders of several logs of one vehicle share it.
    `counts` tells what became of the frames. Raises ConfigError where the dialect lacks a wanted message.
    """

    def __init__(self, config: Config, link: str, sequences: dict[str, int] | None = None) -> None:
        settings = config.mavlink[link]
        self.link = link
        self.system = settings.system  # whose frames are taken; 0: nobody's yet
        self.settled = settings.system != 0  # configured, or an autopilot has been heard
        try:
            self.dialect = Dialect(settings.dialect)
            self._readers = self._make_readers(config)
        except ConfigError as error:
            raise ConfigError(f"mavlink.{link}.dialect: {error}") from error
        self._component = settings.component
        self._boot_clock = boot_clock(link, self.system)
        self._sequences = {} if sequences is None else sequences
        self._last_counter: dict[int, int] = {}
        kinds = ("decoded", "skipped", "other systems", "other components", "other instances")
        self.counts = dict.fromkeys((*kinds, "bad checksum", "undecodable", "lost"), 0)

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        """The events in one complete frame; none where the frame is not wanted or not sound (see `counts`)."""
        reader = self._admit(frame)
        if isinstance(reader, str):
            self.counts[reader] += 1
            return []
        self.counts["decoded"] += 1
        fields = reader.fields(frame)
        if len(reader.handlers) == 1:
            return reader.handlers[0](fields, t_receive_ns)
        return [event for handle in reader.handlers for event in handle(fields, t_receive_ns)]

    def _admit(self, frame: bytes) -> _Reader | str:
        """Who reads this frame, or else the name of the count it belongs to."""
        if len(frame) < HEADER_1 + CHECKSUM or frame_length(frame) != len(frame):
            return "undecodable"
        if frame[0] == MAGIC_2:
            counter, system, component, low, high = SENDER_2.unpack_from(frame, 4)
            number = low | high << 16
        else:
            counter, system, component, number = SENDER_1.unpack_from(frame, 2)
        if self._component not in (0, component):
            return "other components"
        reader = self._readers.get(number)
        if system != self.system and not self._adopt(system, reader, frame):
            return "other systems"
        if reader is not None and not is_sound(frame, reader.seed):
            return "bad checksum"
        missing = (counter - self._last_counter.get(component, counter - 1) - 1) & 0xFF
        self._last_counter[component] = counter
        if 0 < missing < LONGEST_GAP:
            self.counts["lost"] += missing
        return "skipped" if reader is None else reader

    def _adopt(self, system: int, reader: _Reader | None, frame: bytes) -> bool:
        """Does this frame of a system not followed so far make it the one to follow?"""
        if self.settled or reader is None or system == 0 or not self.dialect.sound(frame):
            return False
        if reader is self._heartbeat:
            if not _is_autopilot(reader.fields(frame)):
                return False
        elif self.system != 0 or not reader.is_sensor:
            return False
        self.system = system
        self._boot_clock = boot_clock(self.link, system)
        self._last_counter.clear()
        return True

    def _make_readers(self, config: Config) -> dict[int, _Reader]:
        readers: dict[int, _Reader] = {}

        def reader(message: str, fields: tuple[str, ...]) -> _Reader:
            kind = self.dialect.type_of(message)
            return readers.setdefault(self.dialect.ids[message], _Reader(kind, fields))

        self._heartbeat = reader(HEARTBEAT, ("type", "autopilot"))
        self._heartbeat.handlers.append(self._take_heartbeat)
        if SYSTEM_TIME in self.dialect.ids:
            reader(SYSTEM_TIME, ("time_unix_usec", "time_boot_ms")).handlers.append(self._take_system_time)
        for name, imu in config.imu.items():
            if imu.link == self.link:
                fields = (_IMU_STAMP.get(imu.message, "time_boot_ms"), *_AXES, *_IMU_EXTRA.get(imu.message, ()))
                reader(imu.message, fields).handlers.append(_ImuHandler(self, name, imu).take)
        for name, gnss in config.gnss.items():
            if gnss.link == self.link:
                reader(gnss.message, _GNSS_BASE + _GNSS_EXTENSIONS).handlers.append(_GnssHandler(self, name, gnss).take)
        return readers

    def _take_heartbeat(self, fields: tuple[int, int], _t_receive_ns: int) -> list[Received]:
        self.settled = self.settled or _is_autopilot(fields)
        return []

    def _take_system_time(self, fields: tuple[int, int], t_receive_ns: int) -> list[Received]:
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


class _ImuHandler:
    """One [imu.NAME]: fields to ImuSample."""

    def __init__(self, decoder: MavlinkDecoder, name: str, imu: Imu) -> None:
        self._decoder, self._name, self._imu = decoder, name, imu
        self._mat_bs = _rotation(imu.rotation_deg) if any(imu.rotation_deg) else None  # sensor axes to body
        self._si = imu.message == "HIGHRES_IMU"
        self._stamp_us = 1 if imu.message in _IMU_STAMP else 1000  # microseconds in a unit of the stamp

    def take(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        decoder = self._decoder
        if self._si and fields[8] != self._imu.instance:
            decoder.counts["other instances"] += 1
            return []
        payload = self._payload(fields)
        return [decoder.event(self._name, decoder.stamp(fields[0] * self._stamp_us), t_receive_ns, payload)]

    def _payload(self, fields: tuple[Any, ...]) -> ImuSample | Invalid:
        force, rate = fields[1:4], fields[4:7]
        if not self._si:
            force = (force[0] * MILLI_G, force[1] * MILLI_G, force[2] * MILLI_G)
            rate = (rate[0] / 1e3, rate[1] / 1e3, rate[2] / 1e3)
        elif fields[7] & ACCEL_AND_GYRO != ACCEL_AND_GYRO:
            return Invalid("not updated")
        calm, slow = _within(force, self._imu.accel_limit), _within(rate, self._imu.gyro_limit)
        if not (calm and slow):
            finite = math.isfinite(sum(force) + sum(rate))
            return Invalid(("beyond gyro_limit" if calm else "beyond accel_limit") if finite else "not finite")
        if self._mat_bs is None:
            return ImuSample(force, rate)
        return ImuSample(_turn(self._mat_bs, force), _turn(self._mat_bs, rate))


class _GnssHandler:
    """One [gnss.NAME]: fields to GnssPosition and GnssVelocity."""

    def __init__(self, decoder: MavlinkDecoder, name: str, gnss: Gnss) -> None:
        self._decoder, self._gnss = decoder, gnss
        self._position, self._velocity = f"{name}.position", f"{name}.velocity"

    def take(self, fields: tuple[int, ...], t_receive_ns: int) -> list[Received]:
        time_us, fix_type, lat, lon, alt, vel, cog, alt_ellipsoid, h_acc, v_acc, vel_acc = fields
        position: AnyPayload
        velocity: AnyPayload
        if fix_type < self._gnss.minimum_fix_type:
            position = velocity = Invalid("no fix")
        elif lat == 0 and lon == 0:
            position = velocity = Invalid("no position")
        elif abs(lat) > 900_000_000 or abs(lon) > 1_800_000_000:
            position = velocity = Invalid("not on earth")
        else:
            height = (alt_ellipsoid or alt) / 1e3
            latitude, longitude = math.radians(lat / 1e7), math.radians(lon / 1e7)
            position = GnssPosition(latitude, longitude, height, _known(h_acc), _known(v_acc))
            speed, course = vel / 1e2, math.radians(cog / 1e2)
            velocity = GnssVelocity(speed * math.cos(course), speed * math.sin(course), None, _known(vel_acc))
        decoder = self._decoder
        stamp = decoder.stamp(time_us) if self._gnss.stamp == "sensor" else ("", None)
        events = [decoder.event(self._position, stamp, t_receive_ns, position)]
        if self._gnss.use_velocity and UNKNOWN_U16 not in (vel, cog):
            events.append(decoder.event(self._velocity, stamp, t_receive_ns, velocity))
        return events


def _known(thousandths: int) -> float | None:
    """An accuracy of the extension fields, mm or mm/s: 0 is unknown."""
    return thousandths / 1e3 if thousandths else None


def _within(vector: Vector3, limit: float) -> bool:
    """Is every component finite, and at most `limit` in size?"""
    x, y, z = vector
    return -limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit


def _rotation(angles_deg: Vector3) -> tuple[Vector3, Vector3, Vector3]:
    """Rows of Rz(yaw) Ry(pitch) Rx(roll): it takes a vector in the sensor's axes to the body's."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in map(math.radians, angles_deg))
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def _turn(rows: tuple[Vector3, Vector3, Vector3], vector: Vector3) -> Vector3:
    x, y, z = vector
    (a, b, c), (d, e, f), (g, h, i) = rows
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
