"""A CAN bus: what its error frames say."""

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


def test_error_frames_are_counted_and_a_change_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "fusiond")
    bus = CanBus(configuration(tmp_path, "udpin:127.0.0.1:14550"), "car", Inbox(16, lambda: None, hash), HostClock())

    def error(classes: int, detail: int = 0) -> str:
        assert bus.decode(CanFrame(classes, False, bytes([0, detail, *bytes(6)]), is_error=True), 0) == []
        return bus.state

    told = [
        error(0x04, 0x08),
        error(0x04, 0x20),
        error(0x04, 0x20),
        error(0x88),
        error(0x40),
        error(0x100),
        error(0x04, 0x01),
    ]
    assert told == ["error-warning", "error-passive", "error-passive", "error-passive", "bus-off", "active", "active"]
    lines = [record.getMessage().rpartition(" ")[2] for record in caplog.records]
    assert lines == ["error-warning", "error-passive", "bus-off", "active"]
    expected = {"error frames": 7, "error passive": 2, "error warning": 1, "bus off": 1, "restarted": 1}
    assert (expected | {"controller overflow": 1}).items() <= bus.counts().items()
