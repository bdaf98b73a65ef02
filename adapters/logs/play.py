"""Plays a recorded drive into live inputs as the vehicle would: MAVLink frames over UDP, CAN frames by python-can.

In real time the clock is the host's, and a daemon that is too slow loses frames as on a vehicle. Faster than real time, the
player has a clock of its own, which waits whenever the daemon falls behind.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from threading import Event
from typing import Any

import can

from fusiond.units import MICROSECOND, MILLISECOND, SECOND
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.logs.file import LogFile
from fusiond_adapters.mavlink.decoder import frame_length
from fusiond_adapters.mavlink.tlog_record import STAMP, STAMP_SIZE

MIN_SLEEP_S = 0.0005  # no sleep is shorter: records that are due within this are sent together
BEHIND_NS = 20 * MILLISECOND  # the clock waits for a daemon that is further behind
POLL_S = 0.0002  # between two checks of the daemon
PATIENCE_S = 1.0  # longest wait: the drive may have a gap


class PlayedClock(HostClock):
    """A clock that the player sets, up to `speed` times as fast as real time."""

    def __init__(self, start_ns: int, speed: float) -> None:
        super().__init__(start_ns)
        self.speed = speed
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The present instant."""
        return self._now_ns

    def from_wall_ns(self, wall_ns: int) -> int:
        """The present instant: stamps of the wall clock have no meaning here."""
        return self._now_ns

    def set(self, t_ns: int) -> None:
        """Advance to an instant."""
        self._now_ns = max(self._now_ns, t_ns)


def mavlink_records(path: Path) -> Iterator[tuple[int, bytes]]:
    """Stamp [ns] and frame of each record of an undamaged .tlog (or .tlog.gz). Raises LogError."""
    data = b"".join(LogFile(path).blocks())
    at = 0
    while at + STAMP_SIZE < len(data):
        (stamp_us,) = STAMP.unpack_from(data, at)
        begin = at + STAMP_SIZE
        at = begin + (frame_length(data, begin) or len(data))
        yield stamp_us * MICROSECOND, data[begin:at]


def can_records(path: Path) -> Iterator[tuple[int, can.Message]]:
    """Stamp [ns] and frame of each record of a CAN log that python-can reads."""
    with can.LogReader(path) as reader:
        for message in reader:
            yield round(message.timestamp * 1e6) * MICROSECOND, message


class Player:
    """Plays a drive to a UDP port and a CAN bus. A context manager."""

    def __init__(self, mavlink: Path, canlog: Path, port: int, bus: can.BusABC) -> None:
        self.sent_mavlink = 0  # frames
        self.sent_can: dict[int, int] = {}  # frames by id
        self.since_ns = self.late_ns = 0  # how much of the drive has been played; largest delay of a record
        self.seconds = 0.0  # duration of the playing
        self._bus, self._port = bus, port
        records: list[tuple[int, Callable[[Any], object], Any]] = []
        records += [(t_ns, self._send_mavlink, frame) for t_ns, frame in mavlink_records(mavlink)]
        records += [(t_ns, self._send_can, message) for t_ns, message in can_records(canlog)]
        self._records = sorted(records, key=itemgetter(0))
        self.begin_ns = self._records[0][0]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def play(self, clock: HostClock, processed_ns: Callable[[], int], halt: Event) -> Iterator[int]:
        """Send every record when it is due, until `halt` is set; yields each stamp. `processed_ns` returns the stamp up to
        which the daemon has processed records; 0 before the first."""
        began = time.monotonic()
        for t_ns, send, item in self._records:
            if isinstance(clock, PlayedClock):
                _sleep(began + (t_ns - self.begin_ns) / clock.speed / SECOND - time.monotonic())
                _await(lambda t_ns=t_ns: not 0 < processed_ns() < t_ns - BEHIND_NS)  # type: ignore[misc]
                clock.set(t_ns)
            else:
                _sleep((t_ns - clock.now_ns()) / SECOND)
            if halt.is_set():
                return
            self.late_ns = max(self.late_ns, clock.now_ns() - t_ns)
            self.since_ns = t_ns - self.begin_ns
            send(item)
            yield t_ns
        self.seconds = time.monotonic() - began

    def _send_mavlink(self, frame: bytes) -> None:
        self._socket.sendto(frame, ("127.0.0.1", self._port))
        self.sent_mavlink += 1

    def _send_can(self, message: can.Message) -> None:
        self._bus.send(message)
        self.sent_can[message.arbitration_id] = self.sent_can.get(message.arbitration_id, 0) + 1

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


def _sleep(seconds: float) -> None:
    if seconds > MIN_SLEEP_S:
        time.sleep(seconds)


def _await(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds, at most PATIENCE_S."""
    ends = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < ends:
        time.sleep(POLL_S)
