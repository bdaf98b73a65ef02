"""SIGINT and SIGTERM at random moments of the daemon's life: each run must end in order, with its exit code and in time.

    python -m benchmarks.interrupt [--runs 200] [--seed 1] [--at-once 2] [--out out/interrupt]

A MAVLink link on loopback that is fed with IMU and GNSS, Zenoh on loopback with a reader that subscribes and asks queries.
The signal comes at a random moment after the start: in the first half of the runs before the daemon is up, in the
others up to a second after. Python's faulthandler tells where a process crashes. Prints each run that did not end as it
should, with its number, moment and messages; `--only NUMBER` runs that one again.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

from benchmarks.latency import IMU_HZ, free_port, sent_by_autopilot
from fusiond.config.outputs import Zenoh
from fusiond_adapters.zenoh.session import open_session

CONFIG = """\
[vehicle]
name = "bench"
[publish]
rate_hz = 100
[zenoh]
listen = ["tcp/127.0.0.1:{tcp}"]
[mavlink.fc]
connection = "udpin:127.0.0.1:{udp}"
[imu.imu0]
link = "fc"
[gnss.gps0]
link = "fc"
"""
UP_S, AFTER_S = 1.0, 1.0  # moments: before it is up, at most this long after the start; after it was up
LIMIT_S = 120.0  # to come up, and to end, on a busy machine
READ_S = 0.02  # between two queries of the reader
PYTHONS_OWN = "init_import_site"  # in what Python says where a signal interrupts its own start
ORDERLY = {signal.SIGINT: {0, 130, -signal.SIGINT}, signal.SIGTERM: {0, -signal.SIGTERM}}  # the latter while it starts


class Life:
    """One run of the daemon."""

    def __init__(self, seed: int, number: int, folder: Path) -> None:
        dice = random.Random(f"{seed} {number}")
        self.signal = dice.choice((signal.SIGINT, signal.SIGTERM))
        self.after_up = bool(number % 2)
        self.moment_s = dice.uniform(0.0, AFTER_S if self.after_up else UP_S)
        self.number = number
        self._folder = folder / str(number)

    def live(self) -> str:
        """Run it. Returns how it ended; what is not orderly begins with `BAD`."""
        udp, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
        self._folder.mkdir(parents=True, exist_ok=True)
        config, messages = self._folder / "car.toml", self._folder / "messages"
        config.write_text(CONFIG.format(udp=udp, tcp=tcp))
        with tempfile.TemporaryDirectory() as private, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            address = f"{private}/notify"
            manager.bind(address)
            environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "NOTIFY_SOCKET": address}
            command = [sys.executable, "-X", "faulthandler", "-m", "fusiond", "run", "--config", str(config)]
            with messages.open("wb") as out, around(udp, tcp):
                daemon = subprocess.Popen(command, env=environment, stdout=out, stderr=out)
                try:
                    if self.after_up:
                        await_ready(manager)
                    time.sleep(self.moment_s)
                    daemon.send_signal(self.signal)
                    began = time.monotonic()
                    status = daemon.wait(LIMIT_S)
                except (TimeoutError, subprocess.TimeoutExpired):
                    daemon.send_signal(signal.SIGABRT)  # faulthandler shows where each thread is
                    daemon.wait()
                    return f"BAD: not up, or did not end, in {LIMIT_S:g} s\n{messages.read_text()}"
        said = messages.read_text()
        if status == 1 and PYTHONS_OWN in said:
            return f"{self.signal.name} before fusiond's first line: status 1"
        if status not in ORDERLY[self.signal]:
            return f"BAD: status {status} after {time.monotonic() - began:.2f} s\n{said}"
        return f"{self.signal.name} {'once up' if self.after_up else 'at the start'}: status {status}"


def await_ready(manager: socket.socket) -> None:
    """Wait until the daemon notifies that it is up. Raises TimeoutError."""
    manager.settimeout(LIMIT_S)
    while b"READY=1" not in manager.recv(4096):
        pass


@contextmanager
def around(udp: int, tcp: int) -> Iterator[None]:
    """The vehicle, and a reader of the state."""
    over = Event()
    threads = [Thread(target=_send, args=(udp, over)), Thread(target=_read, args=(tcp, over))]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _send(port: int, over: Event) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        for datagrams in sent_by_autopilot(time.monotonic_ns(), LIMIT_S):
            for datagram in datagrams:
                peer.sendto(datagram, ("127.0.0.1", port))
            if over.wait(1 / IMU_HZ):
                return


def _read(port: int, over: Event) -> None:
    section = Zenoh(mode="client", listen=[], connect=[f"tcp/127.0.0.1:{port}"])
    while not over.is_set():
        try:
            with open_session(section) as session, session.declare_subscriber("fusiond/**", lambda _: None):
                while not over.wait(READ_S) and session.info.routers_zid() + session.info.peers_zid():
                    for _ in session.get("fusiond/bench/state", timeout=0.2):
                        pass
        except Exception:  # it is not up yet, or ended
            over.wait(READ_S)


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.interrupt", description=__doc__.split("\n\n")[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--at-once", type=int, default=2)
    parser.add_argument("--only", type=int, help="the number of one run")
    parser.add_argument("--out", type=Path, default=Path("out/interrupt"))
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits that it is ignored
    numbers = range(options.runs) if options.only is None else [options.only]
    lives = [Life(options.seed, number, options.out) for number in numbers]
    ends: Counter[str] = Counter()
    with ThreadPoolExecutor(options.at_once) as pool:
        for life, end in zip(lives, pool.map(Life.live, lives), strict=True):
            ends[end.partition("\n")[0]] += 1
            if end.startswith("BAD"):
                print(f"run {life.number}, {life.signal.name} at {life.moment_s:.3f} s: {end}", flush=True)
    for end, count in sorted(ends.items()):
        print(f"{count:6}  {end}")
    bad = sum(count for end, count in ends.items() if end.startswith("BAD"))
    print(f"{ends.total()} runs, seed {options.seed}: {bad} did not end as they should")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
