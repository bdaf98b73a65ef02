"""The live daemon in one process: real sockets, a real serial line, python-can's virtual bus; faults and its black box."""

from __future__ import annotations

import os
import pty
import random
import socket
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import count
from pathlib import Path
from threading import Event, Thread
from typing import Any

import can
import pytest
from msgspec.structs import replace
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.messages.codec import encode
from fusiond.messages.types import StateMessage
from fusiond_adapters.can.bus import CanBus
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.live import SYSTEM, Autopilot, Running, aligned, axle, configuration, drive, fused, parsed, running
from tests.helpers.network import DEADLINE, free_port, udp

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

CHANNELS = count()


@pytest.fixture
def channel() -> str:
    return f"test-{next(CHANNELS)}"


@pytest.fixture
def bus(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel) as opened:
        yield opened


def test_udp_and_can_align_and_publish(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    port = free_port()
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{port}", channel=channel)
    with running(settings) as run, closing(udp(port)[0]) as peer:
        drive(run, lambda data: peer.sendto(data, ("127.0.0.1", port)), bus,
              lambda: aligned(run) and fused(run, "left") > 5, Autopilot())  # fmt: skip
        heartbeat = next(m for m in iter(lambda: parsed(peer.recv(4096))[0], None) if m.get_type() == "HEARTBEAT")
        assert (heartbeat.get_srcComponent(), heartbeat.type, heartbeat.autopilot) == (191, 18, 8)
        state = run.messages[-1].state
        assert state is not None
        assert abs(state.lat_deg - 48.13743) < 1e-5 and abs(state.yaw_deg - 30) < 1
    periods = {b.t_ns - a.t_ns for a, b in zip(run.messages, run.messages[1:], strict=False)}
    assert periods == {10_000_000}
    totals = run.daemon.live.engine.fusion.totals()
    assert sum(totals.values()) == run.daemon.live.offered  # all are accounted for


def test_an_input_that_is_slow_to_prepare_delays_nothing_else(
    tmp_path: Path, channel: str, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, loaded, prepare = free_port(), Event(), CanBus.prepare

    def slow(wheels: CanBus) -> None:
        assert loaded.wait(DEADLINE)
        prepare(wheels)

    monkeypatch.setattr(CanBus, "prepare", slow)
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{port}", channel=channel)
    with running(settings) as run, closing(udp(port)[0]) as peer:
        autopilot, daemon = Autopilot(), run.daemon

        def send(data: bytes) -> int:
            return peer.sendto(data, ("127.0.0.1", port))

        drive(run, send, bus, lambda: aligned(run), autopilot)
        assert not daemon.up.is_set()
        loaded.set()
        drive(run, send, bus, lambda: fused(run, "left") > 0, autopilot)
        run.until(daemon.up.is_set)


@pytest.mark.parametrize(("ours", "theirs"), [("udpin", "udpout"), ("tcpin", "tcp")])
def test_a_peer_that_is_pymavlink(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ours: str, theirs: str) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    port = free_port(socket.SOCK_STREAM)
    with running(configuration(tmp_path, f"{ours}:127.0.0.1:{port}")) as run:
        link = run.daemon.inputs["mavlink.fc"]
        run.until(lambda: link.counts()["sessions"] == 1)
        where = f"{theirs}:127.0.0.1:{port}"
        with closing(mavutil.mavlink_connection(where, source_system=SYSTEM, source_component=1, dialect="common")) as peer:
            peer.mav.heartbeat_send(common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 0)
            request = peer.recv_match(type="COMMAND_LONG", blocking=True, timeout=DEADLINE)
            assert (request.target_system, request.command) == (SYSTEM, common.MAV_CMD_SET_MESSAGE_INTERVAL)
            peer.mav.highres_imu_send(5_000_000, 0, 0, -9.8, *(0.0,) * 10, 0x3F)
            run.until(lambda: run.daemon.live.offered == 1)


def test_requests_and_answers_over_tcp(tmp_path: Path) -> None:
    """fusiond connects, learns the system, requests the messages, again after a reboot, and answers TIMESYNC."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE)
        settings = configuration(tmp_path, f"tcp:127.0.0.1:{server.getsockname()[1]}")
        with running(settings):
            peer, _ = server.accept()
            peer.settimeout(DEADLINE)
            autopilot, parser = Autopilot(), common.MAVLink(None)

            def until(kind: str, number: int, check: Callable[[common.MAVLink_message], bool]) -> list:
                found: list[common.MAVLink_message] = []
                while len(found) < number:
                    messages = parser.parse_buffer(peer.recv(4096)) or []
                    found += [m for m in messages if m.get_type() == kind and check(m)]
                return found

            def intervals(messages: list[common.MAVLink_message]) -> dict[float, float]:
                assert {(m.target_system, m.target_component) for m in messages} == {(SYSTEM, 1)}
                assert {m.get_srcSystem() for m in messages} == {SYSTEM}
                return {m.param1: m.param2 for m in messages}

            def is_request(message: common.MAVLink_message) -> bool:
                return bool(message.command == common.MAV_CMD_SET_MESSAGE_INTERVAL)

            with peer:
                peer.sendall(autopilot.heartbeat() + autopilot.system_time(90_000))
                wanted = {105: 10_000, 24: 200_000, 2: 1_000_000}  # HIGHRES_IMU, GPS_RAW_INT, SYSTEM_TIME
                assert intervals(until("COMMAND_LONG", 3, is_request)) == wanted
                peer.sendall(autopilot.pack(common.MAVLink_timesync_message(0, 1234)))
                answer = until("TIMESYNC", 1, lambda m: m.ts1 == 1234)
                assert answer[0].tc1 > 10**18
                peer.sendall(autopilot.system_time(500))
                assert intervals(until("COMMAND_LONG", 3, is_request)) == wanted


def test_tcp_listener_outlives_its_peers(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    with running(configuration(tmp_path, f"tcpin:127.0.0.1:{port}")) as run:
        link, autopilot = run.daemon.inputs["mavlink.fc"], Autopilot()
        run.until(lambda: link.counts()["sessions"] == 1)
        for expected in (1, 2, 3):
            with socket.create_connection(("127.0.0.1", port), DEADLINE) as peer:
                peer.sendall(autopilot.imu())
                run.until(lambda expected=expected: link.inbox.received == expected)
        assert link.counts()["sessions"] == 1


def test_serial_line_lost_and_back(tmp_path: Path) -> None:
    device = tmp_path / "tty"

    def plug() -> int:
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        device.unlink(missing_ok=True)
        device.symlink_to(os.ttyname(theirs))
        os.close(theirs)
        return ours

    line = plug()
    with running(configuration(tmp_path, f"{device},57600")) as run:
        link, autopilot = run.daemon.inputs["mavlink.fc"], Autopilot()
        for session in (1, 2):
            run.until(lambda session=session: link.counts()["sessions"] == session)
            before = link.inbox.received
            os.write(line, autopilot.imu())
            run.until(lambda before=before: link.inbox.received == before + 1)
            os.close(line)
            if session == 1:
                line = plug()


def test_tcp_peer_missing_at_first_and_lost_later(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    """Without the link everything else works; the link is opened as soon as it is there."""
    port = free_port(socket.SOCK_STREAM)
    with running(configuration(tmp_path, f"tcp:127.0.0.1:{port}", channel=channel)) as run:
        wheels, link = run.daemon.inputs["can.car"], run.daemon.inputs["mavlink.fc"]
        run.until(lambda: wheels.counts()["sessions"] == 1)
        bus.send(axle())
        run.until(lambda: run.daemon.live.offered == 2)
        for session in (1, 2):
            with socket.create_server(("127.0.0.1", port)) as server:
                server.settimeout(DEADLINE)
                peer, _ = server.accept()
                with peer:
                    peer.sendall(Autopilot().imu())
                    run.until(lambda session=session: link.inbox.received == session)
        bus.send(axle())
        run.until(lambda: wheels.inbox.received == 2)
        assert wheels.counts()["sessions"] == 1


def test_garbage_on_every_input(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    noise, port = random.Random(5), free_port()
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{port}", channel=channel)
    with running(settings) as run, closing(udp(port)[0]) as peer:
        link, wheels = run.daemon.inputs["mavlink.fc"], run.daemon.inputs["can.car"]
        run.until(lambda: wheels.counts()["sessions"] == 1 and link.counts()["sessions"] == 1)

        def send(data: bytes) -> None:
            peer.sendto(noise.randbytes(noise.randrange(1, 300)), ("127.0.0.1", port))
            broken = bytearray(data)
            broken[noise.randrange(len(data))] ^= 1 << noise.randrange(8)
            peer.sendto(bytes(broken), ("127.0.0.1", port))
            peer.sendto(data, ("127.0.0.1", port))
            size = noise.randrange(9)
            bus.send(can.Message(arbitration_id=256, is_extended_id=False, data=noise.randbytes(size)))
            bus.send(can.Message(arbitration_id=noise.randrange(2048), is_extended_id=False, data=noise.randbytes(size)))
            bus.send(can.Message(is_error_frame=True, arbitration_id=0x100, is_extended_id=False, data=bytes(8)))

        drive(run, send, bus, lambda: run.daemon.live.offered > 400 and len(run.messages) > 50, Autopilot())
        assert link.counts()["garbage bytes"] > 1000
        run.until(lambda: wheels.counts()["restarted"] > 10)
        assert link.counts()["sessions"] == wheels.counts()["sessions"] == 1


def test_a_fault_in_an_adapter_stops_nothing_else(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    port = free_port()
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{port}", channel=channel)
    run = Running(settings)
    wheels, link = run.daemon.inputs["can.car"], run.daemon.inputs["mavlink.fc"]
    genuine, faults = wheels.session, iter([ZeroDivisionError("a driver's"), MemoryError("another")])

    def session(stop: Event) -> None:
        for fault in faults:
            raise fault
        genuine(stop)

    wheels.session = session  # type: ignore[method-assign]
    run.start()
    try:
        run.until(lambda: wheels.counts()["sessions"] == 1)
        bus.send(axle())
        run.until(lambda: run.daemon.live.offered == 2)
        assert link.counts()["sessions"] == 1
    finally:
        run.stop()


def test_a_fault_in_the_estimator_ends_the_daemon(tmp_path: Path) -> None:
    run = Running(configuration(tmp_path, f"udpin:127.0.0.1:{free_port()}"))

    def step(_: object, *, give_way: bool) -> None:
        raise ZeroDivisionError("in the estimator")

    run.daemon.live.step = step  # type: ignore[method-assign]
    run.start()
    with pytest.raises(ExceptionGroup) as raised:
        run.join()
    assert raised.group_contains(ZeroDivisionError, match="in the estimator")


def test_zenoh_missing_at_first(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    """Its port is in use: states wait, then are dropped and counted; once it is free, new ones are published."""
    with socket.create_server(("127.0.0.1", 0)) as squatter:
        more = f'[zenoh]\nlisten = ["tcp/127.0.0.1:{squatter.getsockname()[1]}"]\n'
        settings = configuration(tmp_path, f"udpin:127.0.0.1:{free_port()}", more, channel)
        with running(settings, zenoh=True) as run:
            wheels = run.daemon.inputs["can.car"]
            run.until(lambda: wheels.counts()["sessions"] == 1 and run.daemon.up.is_set())
            bus.send(axle())
            run.until(lambda: run.daemon.published > 10)
            assert run.daemon.outputs["zenoh"].counts()["sent"] == 0
            squatter.close()
            run.until(lambda: run.daemon.outputs["zenoh"].counts()["sent"] > 20)
            assert run.daemon.outputs["zenoh"].counts()["stale"] > 10


def test_reload(tmp_path: Path) -> None:
    """A link's connection changes live; together with a change of the filter, nothing changes."""
    first, second = free_port(), free_port()
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{first}")
    file = tmp_path / "live.toml"
    with running(settings, lambda: config.load(file)) as run:
        link = run.daemon.inputs["mavlink.fc"]
        run.until(lambda: link.counts()["sessions"] == 1)
        text = file.read_text().replace(str(first), str(second))
        file.write_text(text.replace("heading_deg = 30.0", "heading_deg = 40.0"))
        run.call(run.daemon.reload)
        run.until(lambda: run.daemon.reloads == 1)
        assert run.daemon.config == settings
        for number, wrong in enumerate(("[nonsense", file.read_text().replace("udpin:", "pigeon:")), 2):
            file.write_text(wrong)
            run.call(run.daemon.reload)
            run.until(lambda number=number: run.daemon.reloads == number)
            assert run.daemon.config == settings
        file.write_text(text)
        run.call(run.daemon.reload)
        run.until(lambda: link.counts()["sessions"] == 2)
        peer, send = udp(second)
        with closing(peer):
            send(Autopilot().imu())
            run.until(lambda: link.inbox.received == 1)


@contextmanager
def service_manager(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], list[str]]]:
    """What systemd is told: the lines of the next notification of a reload's end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.settimeout(DEADLINE)
        manager.bind(str(folder / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "notify"))

        def after_reload() -> list[str]:
            told = ""
            while not told.startswith("RELOADING=1"):
                told = manager.recv(4096).decode()
            return manager.recv(4096).decode().splitlines()

        yield after_reload


def fails(fault: Exception) -> Callable[..., Any]:
    """A function that raises."""

    def call(*_: object, **__: object) -> None:
        raise fault

    return call


@pytest.mark.parametrize(
    ("what", "where", "fault", "reason"),
    [
        (config, "load", RecursionError("a deep one"), "failed: RecursionError('a deep one')"),
        (config, "load", PermissionError(13, "Permission denied", "live.toml"), "Permission denied"),
        (config, "load", ConfigError("two\nlines"), "two lines"),
        (CanBus, "prepare", MemoryError(), "failed: MemoryError()"),
        (Thread, "start", RuntimeError("can't start new thread"), "failed: RuntimeError"),
        (None, "", None, "Not a directory"),
    ],
)
def test_a_refused_reload_changes_nothing_and_the_daemon_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: Any, where: str, fault: Exception, reason: str
) -> None:
    """Whatever fails: the link, the black box and the configuration stay as they were, systemd hears why, SIGTERM works."""
    first, second = free_port(), free_port()
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{first}", '[record]\nfolder = "box"\n')
    file = tmp_path / "live.toml"
    with service_manager(tmp_path, monkeypatch) as after_reload, running(settings, lambda: config.load(file)) as run:
        link = run.daemon.inputs["mavlink.fc"]
        run.until(lambda: run.daemon.up.is_set() and link.counts()["sessions"] == 1)
        record, about = run.daemon.live.record, link.about
        box = "elsewhere" if fault else "live.toml/box"
        file.write_text(file.read_text().replace(str(first), str(second)).replace('"box"', f'"{box}"'))
        with monkeypatch.context() as broken:
            if fault:
                broken.setattr(what, where, fails(fault))
            run.call(run.daemon.reload)
            ready, status = after_reload()
        assert ready == "READY=1" and "; reload refused: " in status and reason in status
        assert run.daemon.config == settings and run.daemon.live.record == record
        assert (link.about, link.counts()["sessions"]) == (about, 1)
        peer, send = udp(first)
        with closing(peer):
            send(Autopilot().imu())
            run.until(lambda: link.inbox.received == 1)
        file.write_text(file.read_text().replace(box, "elsewhere"))
        run.call(run.daemon.reload)
        ready, status = after_reload()
        assert ready == "READY=1" and "refused" not in status
        peer, send = udp(second)
        with closing(peer):
            run.until(lambda: link.counts()["sessions"] == 2)
            send(Autopilot().imu())
            run.until(lambda: link.inbox.received == 2)
    assert [len(list((tmp_path / name).glob("*-fc.tlog"))) for name in ("box", "elsewhere")] == [1, 1]
    outputs = run.daemon._io_health().outputs
    assert (outputs["record"].offered, outputs["record"].dropped) == (6, 0)  # a frame, configuration and DBC, twice


def replayed(settings: Config, logs: list[str]) -> list[bytes]:
    """The states that a replay of recordings publishes."""
    published: list[bytes] = []
    task = ReplayTask(settings.publish.rate_hz, on_tick=[lambda message, _: published.append(encode(message, "json"))])
    Replay(settings, task).run(open_logs(logs, settings))
    return published


@pytest.mark.parametrize(("file_mb", "on_imu"), [(64.0, False), (0.01, False), (64.0, True)])
def test_replay_of_the_black_box_publishes_the_same_bytes(
    tmp_path: Path, channel: str, bus: can.BusABC, file_mb: float, on_imu: bool
) -> None:
    port = free_port()
    more = f'[record]\nfolder = "box"\nfile_mb = {file_mb}\n'
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{port}", more, channel)
    settings = replace(settings, publish=replace(settings.publish, on_imu=on_imu))
    with running(settings) as run, closing(udp(port)[0]) as peer:
        drive(run, lambda data: peer.sendto(data, ("127.0.0.1", port)), bus,
              lambda: aligned(run) and fused(run, "left") > 90, Autopilot())  # fmt: skip
    files = sorted(str(path) for path in (tmp_path / "box").glob("*log"))
    assert len(files) == 2 if file_mb == 64.0 else len(files) > 2
    live = [encode(message, "json") for message in run.messages]
    again = replayed(settings, files)
    assert len(again) > 20 and live[-1].count(b"nominal") == 1
    assert live[: len(again)] == again
    extra: list[StateMessage] = run.messages[len(again) :]
    assert all(message.t_ns > run.daemon.live.engine.now_ns for message in extra)  # after the last event
