"""A played drive: every frame arrives as recorded, when its clock says so; the clock waits for a daemon that is behind."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import can
import pytest

from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.logs import play
from fusiond_adapters.logs.play import PlayedClock, Player, can_records, mavlink_records
from tests.helpers.live import Autopilot

BEGIN_NS = 1_760_000_000_000_000_000
STEP_NS = 10_000_000
FRAMES = 5
CHANNEL = "test-play"
AUTOPILOT = Autopilot()
SENT = [AUTOPILOT.imu() for _ in range(FRAMES)]


@pytest.fixture
def logs(tmp_path: Path) -> tuple[Path, Path]:
    """A MAVLink frame each 10 ms, a CAN frame 5 ms after it."""
    stamps = [BEGIN_NS + number * STEP_NS for number in range(FRAMES)]
    tlog, canlog = tmp_path / "drive.tlog", tmp_path / "drive.log"
    tlog.write_bytes(b"".join(struct.pack(">Q", t // 1000) + frame for t, frame in zip(stamps, SENT, strict=True)))
    half = STEP_NS // 2
    lines = (f"({(t + half) // 10**9}.{(t + half) % 10**9 // 1000:06d}) can0 10{n}#0{n}\n" for n, t in enumerate(stamps))
    canlog.write_text("".join(lines))
    return tlog, canlog


@pytest.fixture
def bus() -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=CHANNEL) as opened:
        yield opened


def test_records(logs: tuple[Path, Path]) -> None:
    assert [t_ns for t_ns, _ in mavlink_records(logs[0])] == [BEGIN_NS + number * STEP_NS for number in range(FRAMES)]
    assert [frame for _, frame in mavlink_records(logs[0])] == SENT
    assert [message.arbitration_id for _, message in can_records(logs[1])] == list(range(0x100, 0x100 + FRAMES))


@pytest.mark.parametrize("speed", [1.0, 1000.0])
def test_every_frame_arrives_in_order(logs: tuple[Path, Path], bus: can.BusABC, speed: float) -> None:
    clock = HostClock(BEGIN_NS) if speed == 1 else PlayedClock(BEGIN_NS, speed)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear,
        can.Bus(interface="virtual", channel=CHANNEL) as mouth,
    ):
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5.0)
        with Player(*logs, ear.getsockname()[1], mouth) as player:
            stamps = list(player.play(clock, lambda: 0, Event()))
        assert [ear.recv(512) for _ in range(FRAMES)] == SENT
    assert stamps == [BEGIN_NS + number * STEP_NS // 2 for number in range(2 * FRAMES)]
    assert clock.now_ns() >= stamps[-1]
    received = [bus.recv(5.0) for _ in range(FRAMES)]
    assert [message.arbitration_id for message in received if message] == list(range(0x100, 0x100 + FRAMES))
    assert (player.sent_mavlink, sum(player.sent_can.values())) == (FRAMES, FRAMES)


def test_a_daemon_that_is_behind_is_waited_for(
    logs: tuple[Path, Path], bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(play, "PATIENCE_S", 0.05)
    clock = PlayedClock(BEGIN_NS, 1000.0)
    with Player(*logs, 9, bus) as player:
        began = time.monotonic()
        list(player.play(clock, lambda: BEGIN_NS + STEP_NS, Event()))  # it has heard the first two, and no more
    late = [number for number in range(2 * FRAMES) if number * STEP_NS // 2 - STEP_NS > play.BEHIND_NS]
    assert time.monotonic() - began >= 0.05 * len(late) and len(late) == 3


def test_a_player_can_be_halted(logs: tuple[Path, Path], bus: can.BusABC) -> None:
    halt = Event()
    halt.set()
    with Player(*logs, 9, bus) as player:
        assert not list(player.play(PlayedClock(BEGIN_NS, 1.0), lambda: 0, halt))
