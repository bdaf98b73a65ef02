"""A CAN bus: its error frames, and the lines of its log."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import pytest

from fusiond.ports.inputs import Inbox
from fusiond_adapters.can.bus import CanBus
from fusiond_adapters.can.kernel_socket import CanFrame
from fusiond_adapters.host.clock import HostClock
from tests.helpers.live import configuration


def can_frame(number: int, data: bytes, flags: int = 0, size: int = 16) -> bytes:
    return struct.pack("=IBBxx", number, len(data), flags) + data.ljust(size - 8, b"\0")


def test_error_frames_are_counted_and_a_change_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "fusiond")
    bus = CanBus(configuration(tmp_path, "udpin:127.0.0.1:14550"), "car", Inbox(16, lambda: None, hash), HostClock())

    def error(classes: int, detail: int = 0) -> str:
        assert bus.decode(CanFrame(classes, False, bytes([0, detail, *bytes(6)]), is_error=True), 0) == []
        return bus.state

    states = [
        error(0x04, 0x08),
        error(0x04, 0x20),
        error(0x04, 0x20),
        error(0x88),
        error(0x40),
        error(0x100),
        error(0x04, 0x01),
    ]
    assert states == ["error-warning", "error-passive", "error-passive", "error-passive", "bus-off", "active", "active"]
    lines = [record.getMessage().rpartition(" ")[2] for record in caplog.records]
    assert lines == ["error-warning", "error-passive", "bus-off", "active"]
    expected = {"error frames": 7, "error passive": 2, "error warning": 1, "bus off": 1, "restarted": 1}
    assert (expected | {"controller overflow": 1}).items() <= bus.counts().items()


def test_frames_are_recorded_as_candump_writes_them(tmp_path: Path) -> None:
    bus = CanBus(configuration(tmp_path, "udpin:127.0.0.1:14550"), "car", Inbox(16, lambda: None, hash), HostClock())
    t_ns = 1_700_000_000_123_456_000
    lines = [
        (CanFrame(0x100, False, b"\x01\xab"), "100#01AB"),
        (CanFrame(0x100, True, b""), "00000100#"),
        (CanFrame(0x100, False, b"\x01", fd_flags=1), "100##101"),
        (CanFrame(0x100, False, b"", is_remote=True), "100#R"),
        (CanFrame(0x40, False, bytes(8), is_error=True), "20000040#0000000000000000"),
    ]
    for frame, text in lines:
        assert bus.record(frame, t_ns) == f"(1700000000.123456) car {text}\n".encode()
    bus.decode(lines[-1][0], t_ns)
    bus.decode(lines[-2][0], t_ns)
    assert {"error frames": 1, "bus off": 1, "remote frames": 1}.items() <= bus.counts().items()
