"""Frames from a Linux CAN socket, with the kernel's receive stamps and its count of dropped frames.

python-can opens the socket and sets its filters. Its `recv` takes one frame per call and fails with SO_RXQ_OVFL, the only
report of frames that were not read in time. So the socket is read here.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Iterable
from typing import NamedTuple

from fusiond.units import SECOND

SO_TIMESTAMPNS, SO_RXQ_OVFL = 35, 40  # asm-generic/socket.h; also the types of their control messages
HEADER = struct.Struct("=IBB2x")  # of struct can_frame and canfd_frame: id and flags, length, FD flags
CLASSIC_SIZE, FD_SIZE = 16, 72  # bytes of the structs
TIMESPEC, COUNTER = struct.Struct("@ll"), struct.Struct("=I")
CONTROL_SIZE = socket.CMSG_SPACE(TIMESPEC.size) + socket.CMSG_SPACE(COUNTER.size)
EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000  # flags in the id, linux/can.h
EXTENDED_BITS, STANDARD_BITS = 0x1FFFFFFF, 0x7FF
MAX_AT_ONCE = 256
QUEUE_BYTES = 1 << 20  # requested receive buffer; the kernel gives up to net.core.rmem_max

Control = Iterable[tuple[int, int, bytes]]  # level, type, data


class CanFrame(NamedTuple):
    """One frame as received. `fd_flags` is None for classic CAN."""

    arbitration_id: int
    is_extended: bool
    data: bytes
    fd_flags: int | None = None
    is_remote: bool = False
    is_error: bool = False


def frame_of(content: bytes) -> CanFrame | None:
    """The frame in a struct can_frame or canfd_frame; None if it is neither."""
    if len(content) not in (CLASSIC_SIZE, FD_SIZE):
        return None
    number, length, flags = HEADER.unpack_from(content)
    is_extended, is_remote, is_error = bool(number & EXTENDED), bool(number & REMOTE), bool(number & ERROR)
    arbitration_id = number & (EXTENDED_BITS if is_extended or is_error else STANDARD_BITS)
    data = b"" if is_remote else content[HEADER.size : HEADER.size + length]
    fd_flags = flags & 0xF if len(content) == FD_SIZE else None
    return CanFrame(arbitration_id, is_extended, data, fd_flags, is_remote, is_error)


def stamp_and_drops(control: Control) -> tuple[int | None, int | None]:
    """The wall clock's stamp [ns] and the count of dropped frames in control messages; None for a missing one."""
    stamp = dropped = None
    for level, kind, data in control:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(data) >= TIMESPEC.size:
            seconds, nanoseconds = TIMESPEC.unpack_from(data)
            stamp = seconds * SECOND + nanoseconds
        elif level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL and len(data) >= COUNTER.size:
            (dropped,) = COUNTER.unpack_from(data)
    return stamp, dropped


class CanSocket:
    """Reads a socket; its owner opens and closes it. Raises OSError if it is lost."""

    def __init__(self, opened: socket.socket) -> None:
        self.dropped = 0  # frames dropped by the kernel so far
        self._last_count = 0  # the kernel's count wraps at 2^32
        self._socket = opened
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        opened.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE_BYTES)

    def read(self, timeout_s: float) -> list[tuple[int | None, CanFrame]]:
        """Frames with the wall clock's stamps [ns], after waiting for the first up to `timeout_s`."""
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return []
        found: list[tuple[int | None, CanFrame]] = []
        while len(found) < MAX_AT_ONCE:
            try:
                content, control, _, _ = self._socket.recvmsg(FD_SIZE, CONTROL_SIZE, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            stamp, count = stamp_and_drops(control)
            if count is not None:
                self.dropped += (count - self._last_count) & 0xFFFFFFFF
                self._last_count = count
            if (frame := frame_of(content)) is not None:
                found.append((stamp, frame))
        return found
