"""CAN frames from a socket, with the kernel's stamps and its count of dropped frames."""

from __future__ import annotations

import socket
import struct
import time

import pytest

from fusiond_adapters.can.kernel_socket import SO_RXQ_OVFL, SO_TIMESTAMPNS, CanFrame, CanSocket, frame_of, stamp_and_drops


def can_frame(number: int, data: bytes, flags: int = 0, size: int = 16) -> bytes:
    return struct.pack("=IBBxx", number, len(data), flags) + data.ljust(size - 8, b"\0")


@pytest.mark.parametrize(
    ("content", "frame"),
    [
        (can_frame(0x123, b"\1\2"), CanFrame(0x123, False, b"\1\2")),
        (can_frame(0x80000123, b""), CanFrame(0x123, True, b"")),
        (can_frame(0x98FEBFFE, bytes(8)), CanFrame(0x18FEBFFE, True, bytes(8))),
        (can_frame(0x40000123, bytes(4)), CanFrame(0x123, False, b"", is_remote=True)),
        (can_frame(0x20000044, bytes(8)), CanFrame(0x44, False, bytes(8), is_error=True)),
        (can_frame(0x123, bytes(range(64)), 0x05, 72), CanFrame(0x123, False, bytes(range(64)), fd_flags=5)),
        (can_frame(0x123, b"\1", 0x04, 72), CanFrame(0x123, False, b"\1", fd_flags=4)),
        (b"", None),
        (bytes(15), None),
        (bytes(2000), None),
    ],
)
def test_frames_of_the_kernel(content: bytes, frame: CanFrame | None) -> None:
    assert frame_of(content) == frame


def test_control_messages() -> None:
    stamp = (socket.SOL_SOCKET, SO_TIMESTAMPNS, struct.pack("@ll", 1_700_000_000, 123_456_789))
    lost = (socket.SOL_SOCKET, SO_RXQ_OVFL, struct.pack("=I", 4_000_000_000))
    other = (socket.SOL_SOCKET, 99, bytes(16))
    assert stamp_and_drops([stamp]) == (1_700_000_000_123_456_789, None)
    assert stamp_and_drops([other, lost, stamp]) == (1_700_000_000_123_456_789, 4_000_000_000)
    assert stamp_and_drops([(socket.SOL_SOCKET, SO_RXQ_OVFL, b"\0")]) == (None, None)
    assert stamp_and_drops([]) == (None, None)


def test_the_kernel_counts_dropped_frames() -> None:
    """The socket option is the same for every datagram socket: here a UDP socket that is not read in time."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        listener.bind(("127.0.0.1", 0))
        reader = CanSocket(listener)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        before = time.time_ns()
        for number in range(200):
            sender.sendto(can_frame(number, b"\1"), listener.getsockname())
        first = reader.read(5)
        assert 0 < len(first) < 200
        assert [frame.arbitration_id for _, frame in first] == list(range(len(first)))
        assert all(stamp is not None and before <= stamp <= time.time_ns() for stamp, _ in first)
        sender.sendto(can_frame(300, b"\1"), listener.getsockname())
        ((_, after),) = reader.read(5)
        assert after.arbitration_id == 300
        assert len(first) + reader.dropped == 200
        assert reader.read(0) == []
