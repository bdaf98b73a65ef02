"""`fusiond run` as a process: start, publication over Zenoh, notifications, reload, its end and its exit codes."""

from __future__ import annotations

import os
import queue
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from fusiond.messages.codec import decode
from fusiond.messages.types import StateMessage
from tests.helpers.live import Autopilot, configuration
from tests.helpers.network import DEADLINE, free_port


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.settimeout(DEADLINE)
        made.bind(str(tmp_path / "notify"))
        yield made


def notified(manager: socket.socket, what: str) -> str:
    """The next notification that begins so."""
    while True:
        text = manager.recv(4096).decode()
        if text.startswith(what):
            return text


def test_life_of_the_process(tmp_path: Path, manager: socket.socket) -> None:
    udp, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    more = f'[zenoh]\nlisten = ["tcp/127.0.0.1:{tcp}"]\n'
    configuration(tmp_path, f"udpin:127.0.0.1:{udp}", more)
    file = tmp_path / "live.toml"
    environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
    environment.pop("WATCHDOG_PID", None)
    command = [sys.executable, "-m", "fusiond", "run", "--config", str(file)]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            notified(manager, "READY=1")
            states: queue.Queue[bytes] = queue.Queue()
            client = zenoh.Config()
            client.insert_json5("mode", '"client"')
            client.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{tcp}"]')
            with (
                zenoh.open(client) as session,
                session.declare_subscriber("fusiond/test/state", lambda sample: states.put(sample.payload.to_bytes())),
                socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
            ):
                peer.sendto(Autopilot().imu(), ("127.0.0.1", udp))
                message = decode(states.get(timeout=DEADLINE), StateMessage, "json")
                assert (message.vehicle, message.mode.value) == ("test", "aligning")
            assert notified(manager, "WATCHDOG=1") != notified(manager, "WATCHDOG=1")  # the status goes on
            file.write_text(file.read_text().replace("heading_deg = 30.0", "heading_deg = 31.0"))
            process.send_signal(signal.SIGHUP)
            notified(manager, "RELOADING=1")
            notified(manager, "READY=1")
            process.send_signal(signal.SIGTERM)
            notified(manager, "STOPPING=1")
            _, log = process.communicate(timeout=DEADLINE)
        finally:
            if process.poll() is None:
                process.kill()
    assert process.returncode == 0, log
    assert "reload refused: a restart is needed to change filter.heading_deg" in log
    assert "Traceback" not in log


def test_sigint_ends_the_start_at_once_and_raises_nothing(tmp_path: Path) -> None:
    file = tmp_path / "live.toml"
    os.mkfifo(file)
    command = [sys.executable, "-m", "fusiond", "run", "--config", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process, file.open("wb"):  # now it reads the file
        process.send_signal(signal.SIGINT)
        _, log = process.communicate(timeout=DEADLINE)
    assert (process.returncode, log) == (-signal.SIGINT, "")


def test_wrong_configuration_is_exit_code_2(tmp_path: Path) -> None:
    configuration(tmp_path, "udpin:14550")
    command = [sys.executable, "-m", "fusiond", "run", "--config", str(tmp_path / "live.toml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE, check=False)
    assert done.returncode == 2
    assert "mavlink.fc.connection: 'udpin:14550': HOST:PORT is needed" in done.stderr


def test_a_dbc_that_does_not_fit_is_exit_code_2_and_never_up(tmp_path: Path, manager: socket.socket) -> None:
    more = f'[zenoh]\nlisten = ["tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]\n'
    configuration(tmp_path, f"udpin:127.0.0.1:{free_port(socket.SOCK_DGRAM)}", more)
    (tmp_path / "axle.dbc").write_text((tmp_path / "axle.dbc").read_text().replace("LEFT", "PORT"))
    command = [sys.executable, "-m", "fusiond", "run", "--config", str(tmp_path / "live.toml")]
    environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=DEADLINE, check=False)
    assert done.returncode == 2
    assert "wheel.left.signal: there is no signal of AXLE 'LEFT' in the DBC" in done.stderr
    assert "Traceback" not in done.stderr
    manager.settimeout(0)
    with pytest.raises(BlockingIOError):
        notified(manager, "READY=1")
