"""The vehicle of the system tests: plays a recorded drive onto a CAN interface and as an autopilot over UDP, and can be
made to reboot, to send many times as much, and to send garbage. It costs little: where there is one processor, it is the
service's as well."""

from __future__ import annotations

import heapq
import random
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import common

SECOND = 1_000_000_000  # ns
FRAME = struct.Struct("=IB3x8s")  # linux/can.h: id and flags, length, data
EXTENDED, ERROR = 1 << 31, 1 << 29  # flags
IN_TIME_NS = 20_000_000  # a vehicle that is farther behind sends no copies
BOOT_S = 3.0  # a rebooting autopilot sends nothing for this long
RETRY_NS = SECOND // 10  # between two attempts to open a CAN interface that is away
LISTEN_NS = SECOND // 20  # between two reads of fusiond's messages
HEADER_2, IMU = 10, b"\x69\0\0"  # MAVLink 2: size of a frame's header, id of HIGHRES_IMU
IMU_EXTRA = bytes([common.MAVLink_highres_imu_message.crc_extra])
STAMP = struct.Struct("<Q")  # time_usec: HIGHRES_IMU's first field
ACCEL_X = HEADER_2 + STAMP.size  # the second field's lowest byte
COUNTER = 0x07  # the bits of a wheel frame's last byte that count
NOISE_HZ = 200  # of each kind


class Vehicle(Thread):
    """One drive, from its first record to its last, in real time. `load` is how many times everything is sent, the copies
    spread over the interval before, as fast as possible; `noise` sends garbage as well."""

    def __init__(self, folder: Path, tlog: str, canlog: str, channel: str, port: int, counted_id: int | None = None) -> None:
        super().__init__(name="vehicle", daemon=True)
        self.load, self.noise = 1, False
        self.late_ns = 0  # its largest delay: the machine is too slow
        self.sent = 0  # frames
        self.requests = 0  # SET_MESSAGE_INTERVAL received
        self._tlog, self._canlog = folder / tlog, folder / canlog
        self._channel, self._counted_id = channel, counted_id
        self._bus: socket.socket | None = None
        self._next_open_ns = self._next_listen_ns = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._voice, self._ear = common.MAVLink(None), common.MAVLink(None)
        self._ear.robust_parsing = True
        self._count, self._copies = 0, 1
        self._boot_us = self._time_us = 0  # when the autopilot booted, on the recorded boot time; the last of that
        self._silent_until_ns = 0
        self._random = random.Random(3)
        self._ended = Event()
        self.begin_ns = min(next(_tlog(self._tlog))[0], next(_candump(self._canlog))[0])  # of the recording
        self.start_unix_ns = 0  # when that was played, by the wall clock
        self._unix_shift_us = 0

    def reboot(self) -> None:
        """Send nothing for a while, then count the time from a new boot."""
        self._silent_until_ns = time.monotonic_ns() + round(BOOT_S * SECOND)
        self._boot_us = self._time_us

    def end(self) -> None:
        """Stop playing."""
        self._ended.set()
        self.join()

    def run(self) -> None:
        """Play, in the thread."""
        start_ns = time.monotonic_ns()
        self.start_unix_ns = time.time_ns()
        self._unix_shift_us = (self.start_unix_ns - self.begin_ns) // 1000
        next_noise_ns = start_ns
        for t_ns, kind, item in heapq.merge(_tlog(self._tlog), _candump(self._canlog)):
            due_ns = start_ns + t_ns - self.begin_ns
            while (now := time.monotonic_ns()) < due_ns and not self._ended.is_set():
                time.sleep((due_ns - now) / SECOND)
            if self._ended.is_set():
                break
            behind_ns = now - due_ns
            self.late_ns = max(self.late_ns, behind_ns)
            self._copies = self.load if behind_ns < IN_TIME_NS else 1
            if kind == "can":
                self._send_can(*item, now)
            else:
                self._send_mavlink(item, now)
            if self.noise and now >= next_noise_ns:
                next_noise_ns = now + SECOND // NOISE_HZ
                self._send_garbage(item if kind == "mavlink" else None, now)
        if self._bus is not None:
            self._bus.close()
        self._socket.close()

    def _send_mavlink(self, frame: bytes, now: int) -> None:
        if now >= self._next_listen_ns:
            self._next_listen_ns = now + LISTEN_NS
            self._listen()
        if now < self._silent_until_ns:
            return
        if frame[7:HEADER_2] == IMU:
            self._send_imu(bytearray(frame))
            return
        message = self._ear_decode(frame)
        if message is None:
            return
        kind = message.get_type()
        if kind == "SYSTEM_TIME":
            self._time_us = 1000 * message.time_boot_ms
            message.time_boot_ms -= self._boot_us // 1000
            message.time_unix_usec += self._unix_shift_us
        elif kind == "GPS_RAW_INT":
            message.time_usec += self._unix_shift_us
        stamp = getattr(message, "time_usec", None)
        for copy in range(self._copies):
            if stamp is not None:
                message.time_usec = self._spread(stamp, copy)
            self._speak(bytes(message.pack(self._voice)))

    def _send_imu(self, frame: bytearray) -> None:
        """The same for most of the frames, without decoding them."""
        (self._time_us,) = STAMP.unpack_from(frame, HEADER_2)
        for copy in range(self._copies):
            STAMP.pack_into(frame, HEADER_2, self._spread(self._time_us - self._boot_us, copy))
            frame[ACCEL_X] ^= copy  # in the last bits: a sensor that is so fast does not repeat itself
            frame[4] = self._voice.seq
            frame[-2:] = mcrf4xx(bytes(frame[1:-2]) + IMU_EXTRA).to_bytes(2, "little")
            self._speak(bytes(frame))

    def _speak(self, frame: bytes) -> None:
        self._write(frame)
        self._voice.seq = (self._voice.seq + 1) & 0xFF

    def _spread(self, stamp_us: int, copy: int) -> int:
        return stamp_us - (self._copies - 1 - copy) * 10_000 // self._copies

    def _ear_decode(self, frame: bytes) -> common.MAVLink_message | None:
        message = self._ear.decode(bytearray(frame))
        self._voice.srcSystem, self._voice.srcComponent = message.get_srcSystem(), message.get_srcComponent()
        return message if message.get_type() in ("HEARTBEAT", "SYSTEM_TIME", "GPS_RAW_INT") else None

    def _listen(self) -> None:
        """Count the requests of fusiond."""
        try:
            while True:
                for message in self._ear.parse_buffer(self._socket.recv(65536)) or []:
                    self.requests += message.get_type() == "COMMAND_LONG"
        except (BlockingIOError, ConnectionRefusedError):
            return

    def _write(self, data: bytes) -> None:
        self.sent += 1
        try:
            self._socket.send(data)
        except (BlockingIOError, ConnectionRefusedError):
            return  # no one listens at the moment

    def _send_can(self, number: int, is_extended: bool, data: bytes, now: int) -> None:
        if number == self._counted_id:  # once: copies of a wheel's frame are as stale as they look
            self._count += 1
            data = data[:-1] + bytes([data[-1] & ~COUNTER | self._count & COUNTER])
        for _ in range(self._copies):
            self._write_can(number | EXTENDED * is_extended, data, now)

    def _write_can(self, number: int, data: bytes, now: int) -> None:
        try:
            if self._bus is None:
                if now < self._next_open_ns:
                    return
                self._next_open_ns = now + RETRY_NS
                self._bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
                self._bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # it only sends
                self._bus.bind((self._channel,))
            self._bus.send(FRAME.pack(number, len(data), data))
            self.sent += 1
        except OSError:  # the interface is down or gone: the fault that is tested
            if self._bus is not None:
                self._bus.close()
                self._bus = None

    def _send_garbage(self, frame: bytes | None, now: int) -> None:
        noise = self._random
        self._write(noise.randbytes(noise.randrange(1, 300)))
        if frame is not None:
            broken = bytearray(frame)
            broken[noise.randrange(len(broken))] ^= 1 << noise.randrange(8)
            self._write(bytes(broken))
        wheel = self._counted_id or 0
        for number in (wheel, noise.randrange(0x800)):
            data = noise.randbytes(noise.randrange(9))
            self._write_can(number, data, now)
        self._write_can(ERROR | 1 << noise.randrange(9), noise.randbytes(8), now)


def _tlog(path: Path) -> Iterator[tuple[int, str, bytes]]:
    """Stamp [ns], "mavlink", frame."""
    data, at = path.read_bytes(), 0
    while at + 8 < len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        size = data[at + 9] + (12 if data[at + 8] == 0xFD else 8)
        size += 13 if data[at + 8] == 0xFD and data[at + 10] & 1 else 0
        yield 1000 * stamp_us, "mavlink", data[at + 8 : at + 8 + size]
        at += 8 + size


def _candump(path: Path) -> Iterator[tuple[int, str, tuple[int, bool, bytes]]]:
    """Stamp [ns], "can", id, whether it is of 29 bits, data; of the first bus in the log."""
    first = None
    with path.open(encoding="ascii") as file:
        for line in file:
            stamp, channel, frame = line.split()[:3]
            first = first or channel
            if channel != first:
                continue
            number, data = frame.split("#")
            seconds, micros = stamp.strip("()").split(".")
            yield int(seconds) * SECOND + int(micros) * 1000, "can", (int(number, 16), len(number) > 3, bytes.fromhex(data))
