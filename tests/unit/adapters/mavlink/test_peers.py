"""An autopilot made of pymavlink, on every kind of connection: it is asked, it answers, all its sensors are fused."""

from __future__ import annotations

import os
import pty
import socket
import time
import tty
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.messages.codec import encode
from fusiond.timeline.aligner import ClockReport
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.live import SYSTEM, Running, configuration, running
from tests.helpers.network import DEADLINE, free_port

pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")

BOOTED_NS = 100 * 10**9  # ago, by the autopilot's clock
MORE = """
[gnss.gps1]
link = "fc"
message = "GPS2_RAW"
[barometer.baro]
link = "fc"
[wheel.encoder]
link = "fc"
index = 1
quantum_m = 0.001
"""
RATES = {105: 100.0, 24: 5.0, 124: 5.0, 9000: 10.0, 29: 10.0, 2: 1.0}  # what fusiond has to ask for


class Autopilot:
    """Sends the requested messages at the requested rates, until stopped."""

    def __init__(self, where: str, **options: Any) -> None:
        self.asked: dict[int, float] = {}  # message: rate [Hz]
        self.timesyncs = 0
        self._where, self._options = where, options
        self._stop = Event()
        self._zero_ns = time.monotonic_ns() - BOOTED_NS
        self._next: dict[int, float] = {}
        self._thread = Thread(target=self._run)

    @contextmanager
    def flying(self) -> Iterator[Autopilot]:
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join(DEADLINE)

    def _run(self) -> None:
        identity = {"source_system": SYSTEM, "source_component": 1, "dialect": "common"}
        with closing(mavutil.mavlink_connection(self._where, **identity, **self._options)) as link:
            next_heartbeat = 0.0
            while not self._stop.is_set():
                now = time.monotonic()
                if now >= next_heartbeat:
                    next_heartbeat = now + 0.5
                    link.mav.heartbeat_send(10, 3, 0, 0, 4)
                for number, rate in self.asked.items():
                    if now >= self._next.get(number, 0.0):
                        self._next[number] = max(now, self._next.get(number, 0.0) + 1 / rate)
                        link.mav.send(self._message(number))
                while (message := link.recv_msg()) is not None:
                    self._hear(link, message)
                self._stop.wait(0.002)

    def _hear(self, link: Any, message: Any) -> None:
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            self.timesyncs += 1
            link.mav.timesync_send(time.monotonic_ns() - self._zero_ns, message.ts1)
        elif message.get_type() == "COMMAND_LONG" and (message.target_system, message.target_component) == (SYSTEM, 1):
            self.asked[int(message.param1)] = 1e6 / message.param2
            link.mav.command_ack_send(message.command, common.MAV_RESULT_ACCEPTED)

    def _message(self, number: int) -> Any:
        us = (time.monotonic_ns() - self._zero_ns) // 1000
        place = (481374300, 115754900, 563000)
        if number == 105:
            wobble = 1e-3 * (us % 7)
            return common.MAVLink_highres_imu_message(us, wobble, 0, -9.81, 1e-4, wobble / 10, 0, *(0.0,) * 7, 0x3F, 0)
        if number == 24:
            return common.MAVLink_gps_raw_int_message(us, 3, *place, 80, 120, 0, 0, 14, 563000, 500, 800, 50)
        if number == 124:
            return common.MAVLink_gps2_raw_message(us, 3, *place, 80, 120, 0, 0, 14, 0, 0, 0, 563000, 500, 800, 50)
        if number == 9000:
            return common.MAVLink_wheel_distance_message(us, 2, [0.0, 12.5, *(0.0,) * 14])
        if number == 29:
            return common.MAVLink_scaled_pressure_message(us // 1000, 950.0, 0.0, 2500)
        assert number == 2
        return common.MAVLink_system_time_message(0, us // 1000)


def boot_report(run: Running) -> ClockReport | None:
    return run.daemon.live.engine.fusion.clock.report().get(f"fc/{SYSTEM}/boot")


def everything_works(run: Running, autopilot: Autopilot) -> bool:
    outcomes = run.daemon.live.engine.fusion.outcomes()
    report = boot_report(run)
    fused = all(outcomes[name]["FUSED"] > 3 for name in ("gps0.position", "gps1.position", "gps1.velocity", "encoder"))
    return fused and autopilot.timesyncs > 5 and report is not None and report.method == "timesync"


def check(run: Running, autopilot: Autopilot) -> None:
    """Everything is asked for, comes, is aligned by round trips and fused."""
    run.until(lambda: everything_works(run, autopilot))
    assert autopilot.asked == {number: pytest.approx(rate, rel=1e-3) for number, rate in RATES.items()}
    report = boot_report(run)
    assert report is not None
    host_boot_ns = run.daemon.clock.now_ns() - time.monotonic_ns() + autopilot._zero_ns
    assert abs(report.offset_ns - host_boot_ns) < 5_000_000  # half of the longest round trip that counts
    counts = run.daemon.inputs["mavlink.fc"].counts()
    assert counts["bad checksum"] == counts["undecodable"] == counts["garbage bytes"] == 0


@pytest.mark.parametrize(("ours", "theirs"), [("udpin", "udpout"), ("udpout", "udpin"), ("tcp", "tcpin"), ("tcpin", "tcp")])
def test_over_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ours: str, theirs: str) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    port = free_port(socket.SOCK_STREAM)
    autopilot = Autopilot(f"{theirs}:127.0.0.1:{port}")
    with running(configuration(tmp_path, f"{ours}:127.0.0.1:{port}", MORE)) as run:
        if ours == "tcpin":
            run.until(lambda: run.daemon.inputs["mavlink.fc"].counts()["sessions"] == 1)
        with autopilot.flying():
            check(run, autopilot)


def test_replay_of_the_recording_measures_the_same_round_trips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    port = free_port(socket.SOCK_STREAM)
    autopilot = Autopilot(f"udpout:127.0.0.1:{port}")
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{port}", MORE + '[record]\nfolder = "box"\n')
    with running(settings) as run, autopilot.flying():
        check(run, autopilot)
    published: list[bytes] = []
    task = ReplayTask(settings.publish.rate_hz, on_tick=[lambda message, _: published.append(encode(message, "json"))])
    replay = Replay(settings, task)
    replay.run(open_logs([str(path) for path in (tmp_path / "box").glob("*log")], settings))
    assert replay.engine.fusion.clock.report() == run.daemon.live.engine.fusion.clock.report()
    assert len(published) > 20
    assert [encode(message, "json") for message in run.messages][: len(published)] == published


def test_over_a_serial_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pseudo terminals, their other ends joined: pymavlink opens one line, fusiond the other."""
    monkeypatch.setenv("MAVLINK20", "1")
    (a, near), (b, far) = pty.openpty(), pty.openpty()
    for end in (a, b, near, far):
        tty.setraw(end)
        os.set_blocking(end, False)
    ended = Event()

    def join() -> None:
        while not ended.wait(0.001):
            for source, sink in ((a, b), (b, a)):
                try:
                    os.write(sink, os.read(source, 4096))
                except BlockingIOError:
                    continue

    wire = Thread(target=join)
    wire.start()
    try:
        autopilot = Autopilot(os.ttyname(far), baud=921600)
        with running(configuration(tmp_path, f"{os.ttyname(near)},921600", MORE)) as run, autopilot.flying():
            check(run, autopilot)
    finally:
        ended.set()
        wire.join(DEADLINE)
        for end in (a, b, near, far):
            os.close(end)


def test_two_links_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each link has an autopilot's clock of its own, and talks for itself."""
    monkeypatch.setenv("MAVLINK20", "1")
    first, second = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
    more = f'[mavlink.aux]\nconnection = "udpin:127.0.0.1:{second}"\n[gnss.gps1]\nlink = "aux"\nmessage = "GPS2_RAW"\n'
    main, aux = Autopilot(f"udpout:127.0.0.1:{first}"), Autopilot(f"udpout:127.0.0.1:{second}")
    with running(configuration(tmp_path, f"udpin:127.0.0.1:{first}", more)) as run, main.flying(), aux.flying():
        fusion = run.daemon.live.engine.fusion
        run.until(lambda: all(fusion.outcomes()[f"gps{k}.position"]["FUSED"] > 3 for k in range(2)))
        run.until(lambda: {f"fc/{SYSTEM}/boot", f"aux/{SYSTEM}/boot"} <= fusion.clock.report().keys())
        assert set(main.asked) == {2, 24, 105}
        assert set(aux.asked) == {2, 124}
