"""python-can as a driver: filters, frames of a virtual bus, and buses that cannot be opened or are lost."""

from __future__ import annotations

import os
import pty
import tty
from itertools import count
from pathlib import Path
from threading import Event
from typing import Any

import can
import pytest

from fusiond.config import load as config
from fusiond.config.schema import Can
from fusiond.ports.inputs import Inbox, InputLost
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.can.driver import CanDriver
from fusiond_adapters.can.kernel_socket import CanFrame
from fusiond_adapters.host.clock import HostClock
from tests.helpers.live import configuration

CHANNELS = count()
J1939 = """VERSION ""
BU_: ECU
BO_ 2566832126 EXACT: 8 ECU
 SG_ SPEED : 0|32@1- (1,0) [0|0] "m/s" Vector__XXX
BO_ 2565800254 TO_ONE: 8 ECU
 SG_ SPEED : 0|32@1- (1,0) [0|0] "m/s" Vector__XXX
"""


def driver(folder: Path, stop: Event | None = None, frames: int = 1) -> tuple[CanDriver, Inbox[CanFrame]]:
    """A driver, whose inbox sets `stop` when it has some frames."""
    settings = configuration(folder, "udpin:127.0.0.1:14550")
    inbox: Inbox[CanFrame] = Inbox(100, lambda: None, hash)
    put = inbox.put

    def put_and_count(t_ns: int, item: CanFrame) -> None:
        put(t_ns, item)
        if stop and inbox.received == frames:
            stop.set()

    inbox.put = put_and_count  # type: ignore[method-assign]
    return CanDriver(CanDecoder(settings, "car"), inbox, HostClock()), inbox


def opened_with(monkeypatch: pytest.MonkeyPatch, made: CanDriver, settings: Can) -> dict[str, Any]:
    """The arguments with which python-can opens the bus."""
    found: list[dict[str, Any]] = []
    genuine = can.Bus

    def bus(**arguments: Any) -> can.BusABC:
        found.append(arguments)
        return genuine(interface="virtual", channel="unused")

    monkeypatch.setattr(can, "Bus", bus)
    with made.opened(settings):
        pass
    return found[0]


def test_only_wanted_frames_of_a_bus_are_read(tmp_path: Path) -> None:
    stop, channel = Event(), f"driver-{next(CHANNELS)}"
    made, inbox = driver(tmp_path, stop, frames=2)
    settings = Can(interface="virtual", channel=channel)
    with can.Bus(interface="virtual", channel=channel) as sender, made.opened(settings) as bus:
        sender.send(can.Message(arbitration_id=0x101, is_extended_id=False, data=b"\x01"))  # of no sensor
        sender.send(can.Message(arbitration_id=0x100, is_extended_id=False, data=b"\x02"))
        sender.send(can.Message(arbitration_id=0x100, is_extended_id=False, is_fd=True, bitrate_switch=True, data=b"\x03"))
        made.read(bus, stop)
    assert [item for _, item in inbox.take()] == [CanFrame(0x100, False, b"\x02"), CanFrame(0x100, False, b"\x03", 1)]


def test_filters_are_of_ids_or_of_parameter_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, _ = driver(tmp_path)
    arguments = opened_with(monkeypatch, made, Can(interface="virtual", channel="x", bitrate=500_000, fd=True))
    assert arguments["can_filters"] == [{"can_id": 0x100, "can_mask": 0x7FF, "extended": False}]
    assert (arguments["bitrate"], arguments["fd"]) == (500_000, True)
    (tmp_path / "truck.dbc").write_text(J1939)
    text = '[can.truck]\ndbc = ["truck.dbc"]\nj1939 = true\n[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n'
    for name in ("EXACT", "TO_ONE"):
        text += f'[wheel.{name.lower()}]\nbus = "truck"\nmessage = "{name}"\nsignal = "SPEED"\nunit = "m/s"\n'
    truck = CanDecoder(config.parse(text, tmp_path / "c.toml"), "truck")
    monkeypatch.undo()
    made = CanDriver(truck, Inbox(1, lambda: None, hash), HostClock())
    arguments = opened_with(monkeypatch, made, Can(interface="virtual", channel="x"))
    assert arguments["can_filters"] == [
        {"can_id": 0xEF0000, "can_mask": 0x3FF0000, "extended": True},  # with a destination
        {"can_id": 0xFEBF00, "can_mask": 0x3FFFF00, "extended": True},
    ]


def test_a_bus_that_cannot_be_opened_and_one_that_is_lost(tmp_path: Path) -> None:
    made, _ = driver(tmp_path)
    virtual = Can(interface="virtual", channel=f"driver-{next(CHANNELS)}")
    with pytest.raises(InputLost, match="cannot be opened"), made.opened(Can(interface="no such interface", channel="x")):
        pass
    with pytest.raises(InputLost, match="lost: gone"), made.opened(virtual):
        raise can.CanOperationError("gone")


@pytest.mark.parametrize(
    "noise",
    [
        b"t1q0\r", b"t\r", b"T12\r", b"tzzz2ABCD\r", b"t1002XY\r", b"\xff\xfe\r", b"\x80" * 40 + b"\rt\r",
        b"x" * 5000 + b"\r", b"\xa5" * 2000 + b"\r", b"T1234567g\r\xff\r",
    ],
)  # fmt: skip
def test_a_garbled_line_of_a_serial_adapter_does_not_drop_the_bus(tmp_path: Path, noise: bytes) -> None:
    """The frames before and after it come, in one session, and it is counted."""
    stop, (master, slave) = Event(), pty.openpty()
    tty.setraw(slave)
    made, inbox = driver(tmp_path, stop, frames=4)
    with can.Bus(interface="slcan", channel=os.ttyname(slave), sleep_after_open=0.0) as bus:
        os.write(master, b"t1002ABCD\r" + noise + b"t1002ABCE\r" + noise + b"t1002ABCF\rt1002ABD0\r")
        made.read(bus, stop)
    assert [item.data for _, item in inbox.take()] == [b"\xab\xcd", b"\xab\xce", b"\xab\xcf", b"\xab\xd0"]
    assert made.garbled >= 2
    os.close(master)
    os.close(slave)
