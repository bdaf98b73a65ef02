"""The outage of a killed daemon: from SIGKILL to the next state that a reader gets.

    python -m benchmarks.restart [--runs 8] [--out out/restart]

`fusiond run` as the unit starts it, under load: IMU at 400 Hz and GNSS at 10 Hz over UDP, Zenoh over TCP, the black box
on, python-can's virtual CAN bus without frames. This process is the supervisor: it restarts the daemon after the pause
that systemd/fusiond.service sets. The reference, before each kill: a Python process that only imports the libraries that
the daemon needs, which are NumPy, asyncio, Zenoh, python-can, cantools and pymavlink.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path
from threading import Event

from benchmarks.latency import configuration, free_port, process
from fusiond.app.client import Client
from fusiond.messages.types import StateMessage

UNIT = Path(__file__).parents[1] / "systemd" / "fusiond.service"
LIBRARIES = "import asyncio, can, cantools, numpy, pymavlink.dialects.v20.common, zenoh"
RUNNING_S = 3.0  # between two kills
LIMIT_S = 20.0


def restart_s() -> float:
    """The pause before the unit restarts the service."""
    found = re.search(r"^RestartSec=(\d+)ms$", UNIT.read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1]) / 1000


def start(config: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "fusiond", "run", "--config", str(config)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # as in the unit
    return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)


def libraries_s() -> float:
    """The time of the reference."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", LIBRARIES], env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, check=True)
    return time.monotonic() - began


def measure(folder: Path, runs: int) -> None:
    udp, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    configuration(folder, udp, tcp)
    pause_s, came, away, bare = restart_s(), Event(), [], []
    daemon = start(folder / "latency.toml")
    try:
        time.sleep(RUNNING_S)
        seconds = runs * (LIMIT_S + RUNNING_S)
        with (
            process("--feed", udp, "--seconds", seconds),
            Client(f"tcp/127.0.0.1:{tcp}", "bench") as client,
            client.subscribed(StateMessage, lambda _: came.set()),
        ):
            for _ in range(runs):
                bare.append(libraries_s())
                time.sleep(RUNNING_S)
                daemon.send_signal(signal.SIGKILL)
                killed = time.monotonic()
                daemon.wait()
                came.clear()
                time.sleep(pause_s)
                daemon = start(folder / "latency.toml")
                if not came.wait(LIMIT_S):
                    raise SystemExit(f"no state within {LIMIT_S:g} s")
                away.append(time.monotonic() - killed)
    finally:
        daemon.kill()
        daemon.wait()
    each = ", ".join(f"{one:.2f}" for one in away)
    middle, reference = statistics.median(away), statistics.median(bare)
    print(f"SIGKILL to the first state at a reader: {each} s; median {middle:.2f}, worst {max(away):.2f} s")
    print(f"reference, the libraries alone: median {reference:.2f}, worst {max(bare):.2f} s; ratio {middle / reference:.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.restart", description=__doc__)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("out/restart"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    measure(options.out, options.runs)
