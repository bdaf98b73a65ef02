"""The parts of the live daemon one by one: what it says on MAVLink, its black box, reload, time line, notifications."""

from __future__ import annotations

import errno
import os
import socket
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import msgspec
import pytest
from pymavlink.dialects.v20 import common

from fusiond.config.changes import changes
from fusiond.config.schema import Config
from fusiond.ports.inputs import Inbox
from fusiond_adapters.can.bus import CanBus, CanFrame
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.host.systemd import Notifier, watchdog_s
from fusiond_adapters.logs.black_box import RETRY_NS, Recorder
from fusiond_adapters.mavlink.talk import SECOND, MavlinkTalk
from fusiond_adapters.mavlink.transport import opener
from tests.helpers.live import SYSTEM, Autopilot, configuration, parsed


@pytest.fixture
def settings(tmp_path: Path) -> Config:
    return configuration(tmp_path, "udpin:127.0.0.1:14550")


# --- What is said on MAVLink


def requests(said: list[bytes]) -> list[int]:
    return sorted(int(m.param1) for m in parsed(b"".join(said)) if m.get_type() == "COMMAND_LONG")


def test_nothing_is_asked_of_a_ground_station(settings: Config) -> None:
    talk = MavlinkTalk(settings, "fc")
    station = common.MAVLink(None, srcSystem=255, srcComponent=190)
    message = common.MAVLink_heartbeat_message(common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
    talk.hear(bytes(message.pack(station)), 0)
    assert talk.target is None
    assert requests(talk.say(SECOND, alive=True)) == []


def test_nothing_is_asked_of_a_component_that_is_not_the_configured_one(settings: Config) -> None:
    link = msgspec.structs.replace(settings.mavlink["fc"], component=2)
    talk = MavlinkTalk(msgspec.structs.replace(settings, mavlink={"fc": link}), "fc")
    talk.hear(Autopilot().heartbeat(), 0)
    assert talk.target is None


def test_asks_again_ever_more_seldom_until_the_rate_is_met(settings: Config) -> None:
    talk, autopilot = MavlinkTalk(settings, "fc"), Autopilot()
    talk.hear(autopilot.heartbeat(), 0)
    assert talk.target == (SYSTEM, 1)
    asked = [second for second in range(60) if 105 in requests(talk.say(second * SECOND, alive=True))]
    assert asked == [0, 3, 9, 21, 45]
    for _ in range(250):  # of the 300 wanted in three seconds
        talk.hear(autopilot.imu(), 62 * SECOND)
    assert 105 not in requests(talk.say(63 * SECOND, alive=True))
    assert talk.wanted["HIGHRES_IMU"].measured_hz == pytest.approx(250 / 3, rel=0.5)


def test_a_rate_that_falls_is_asked_for_at_once(settings: Config) -> None:
    talk, autopilot = MavlinkTalk(settings, "fc"), Autopilot()
    talk.hear(autopilot.heartbeat(), 0)
    talk.say(0, alive=True)
    for _ in range(300):
        talk.hear(autopilot.imu(), SECOND)
    talk.say(3 * SECOND, alive=True)
    assert talk.wanted["HIGHRES_IMU"].good
    assert 105 in requests(talk.say(6 * SECOND, alive=True))


def test_a_refusal_is_remembered(settings: Config) -> None:
    talk, autopilot = MavlinkTalk(settings, "fc"), Autopilot()
    talk.hear(autopilot.heartbeat(), 0)
    talk.say(0, alive=True)
    command, result = common.MAV_CMD_SET_MESSAGE_INTERVAL, common.MAV_RESULT_UNSUPPORTED
    talk.hear(autopilot.pack(common.MAVLink_command_ack_message(command, result)), 1)
    assert talk.wanted["HIGHRES_IMU"].refused == "unsupported"


def test_heartbeats_stop_with_the_estimator(settings: Config) -> None:
    talk = MavlinkTalk(settings, "fc")
    told = [len(talk.say(second * SECOND // 2, alive=second < 10)) for second in range(20)]
    assert told == [1, 0] * 5 + [0] * 10


def questions(said: list[bytes]) -> list[int]:
    return [m.ts1 for m in parsed(b"".join(said)) if m.get_type() == "TIMESYNC" and m.tc1 == 0]


def test_time_is_asked_for_fast_at_first_and_after_a_reboot(settings: Config) -> None:
    talk, autopilot = MavlinkTalk(settings, "fc"), Autopilot()
    assert questions(talk.say(0, alive=True)) == []  # whom?
    talk.hear(autopilot.heartbeat(), 0)
    step = SECOND // 20
    asked = [k * step for k in range(200) if questions(talk.say(k * step, alive=True))]
    assert asked[:20] == [k * 2 * step for k in range(20)]
    assert {b - a for a, b in pairwise(asked[20:])} == {SECOND}
    (stamp,) = questions(talk.say(11 * SECOND + 123_456, alive=True))
    assert abs(stamp - (11 * SECOND + 123_456)) < 1000 and stamp % 1000 == 117
    for boot_ms in (10_000, 100):
        talk.hear(autopilot.system_time(boot_ms), 12 * SECOND)
    assert questions(talk.say(12 * SECOND + 1, alive=True)) and questions(talk.say(12 * SECOND + 3 * step, alive=True))


def test_what_changes_is_told_once(settings: Config) -> None:
    talk, autopilot = MavlinkTalk(settings, "fc"), Autopilot()
    talk.hear(autopilot.heartbeat(), 0)
    for second in range(13):
        for _ in range(0 if second < 6 else 100):
            talk.hear(autopilot.imu(), second * SECOND)
        talk.say(second * SECOND, alive=True)
    told = [line for line in talk.news if "IMU" in line or "autopilot" in line]
    assert told == [
        f"the autopilot is system {SYSTEM}, component 1",
        "HIGHRES_IMU comes at 0 Hz, wanted at 100 Hz",
        "HIGHRES_IMU comes at 100 Hz, wanted at 100 Hz",
    ]


def test_an_overtaken_frame_is_no_reboot(settings: Config) -> None:
    talk, autopilot = MavlinkTalk(settings, "fc"), Autopilot()
    talk.hear(autopilot.heartbeat(), 0)
    for boot_ms in (10_000, 9_500, 10_500):
        talk.hear(autopilot.system_time(boot_ms), 0)
    assert talk.reboots == 0
    talk.hear(autopilot.system_time(100), 0)
    assert talk.reboots == 1


@pytest.mark.parametrize(
    "wrong", ["udpin:14550", "tcp:host:port", "carrier:pigeon", "/dev/ttyACM0,fast", "udpin:h:70000", ""]
)
def test_wrong_connection_strings(wrong: str) -> None:
    with pytest.raises(ValueError):
        opener(wrong, 57600)


# --- The black box


def test_black_box_stays_below_its_limit_and_leaves_other_files_alone(tmp_path: Path) -> None:
    other = tmp_path / "mine.tlog"
    other.write_bytes(bytes(50_000))
    with Recorder(tmp_path, file_mb=0.01, total_mb=0.05) as box:
        for number in range(2000):
            box.add("fc.tlog", number * 10**7, bytes(100))
    files = sorted(tmp_path.glob("*Z-fc.tlog"))
    assert (box.written, box.lost) == (2000, 0)
    assert 3 <= len(files) <= 5 and all(file.stat().st_size <= 10_000 for file in files)
    assert files[-1].name == "19700101T000019.000000Z-fc.tlog"
    assert other.stat().st_size == 50_000


def test_black_box_survives_a_disk_that_fails(tmp_path: Path) -> None:
    folder = tmp_path / "box"
    with Recorder(folder, file_mb=1, total_mb=2) as box:
        folder.rmdir()
        for number in range(100):
            box.add("can.log", number, b"x")
    assert (box.written, box.lost) == (0, 100)
    assert box.error == "No such file or directory"


def test_black_box_goes_on_when_there_is_room_again(tmp_path: Path) -> None:
    class FullAtFirst(Recorder):
        def _open(self, kind: str, t_ns: int) -> BinaryIO:
            if t_ns < RETRY_NS // 2:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super()._open(kind, t_ns)

    with FullAtFirst(tmp_path, file_mb=1, total_mb=2) as box:
        for t_ns, record in ((0, b"no room"), (RETRY_NS - 1, b"too early"), (RETRY_NS, b"again")):
            box.add("can.log", t_ns, record)
    assert (box.written, box.lost, box.error) == (1, 2, None)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"again"]


def test_can_frames_as_candump_writes_them(settings: Config) -> None:
    bus = CanBus(settings, "car", Inbox(16, lambda: None, hash), HostClock())
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


# --- Reload


def test_reload_tells_what_can_change_live(settings: Config, tmp_path: Path) -> None:
    assert changes(settings, settings) == ((), ())
    link = msgspec.structs.replace(settings.mavlink["fc"], connection="udpin:127.0.0.1:1")
    live = msgspec.structs.replace(settings, mavlink={"fc": link})
    assert changes(settings, live) == (("mavlink.fc.connection",), ())
    both = msgspec.structs.replace(live, filter=msgspec.structs.replace(settings.filter, horizon_s=2.0))
    assert changes(settings, both) == ((), ("filter.horizon_s",))
    fewer = msgspec.structs.replace(settings, wheel={"left": settings.wheel["left"]})
    assert changes(settings, fewer) == ((), ("wheel.right",))


# --- Time line and notifications


def test_kernel_stamps_on_the_time_line_through_a_clock_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monotonic, wall = 5_000_000_000, 1_700_000_000 * 10**9
    monkeypatch.setattr("time.monotonic_ns", lambda: monotonic)
    monkeypatch.setattr("time.time_ns", lambda: wall)
    clock = HostClock()
    assert clock.now_ns() == wall
    assert clock.from_wall_ns(wall - 3_000_000) == wall - 3_000_000
    before = clock.now_ns()
    wall += 3600 * 10**9  # the clock is set forward
    assert clock.now_ns() == before
    assert clock.from_wall_ns(wall - 3_000_000) == before - 3_000_000
    assert clock.from_wall_ns(wall - 3600 * 10**9) == before  # stamped before the step
    assert clock.from_wall_ns(12_345) == before  # of another clock


def test_notifications(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.settimeout(10)
        manager.bind(str(tmp_path / "notify"))
        notifier = Notifier(str(tmp_path / "notify"))
        notifier.ready("well")
        notifier.reloading()
        assert manager.recv(100) == b"READY=1\nSTATUS=well"
        assert manager.recv(100).startswith(b"RELOADING=1\nMONOTONIC_USEC=")
    notifier.stopping()
    assert notifier.lost == 1
    notifier.close()
    monkeypatch.setenv("WATCHDOG_USEC", "5000000")
    assert watchdog_s() == 2.5
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_s() is None
