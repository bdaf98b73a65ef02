"""Whether greedy clients delay a state: from its instant until it is in every output's hands, phase by phase, in one run.

    python -m benchmarks.greedy [--seconds 8] [--alone] [--out out/greedy]

The load is that of benchmarks.latency, with Prometheus and Foxglove. The phases: quiet; Prometheus scraped without a pause
by eight clients; 1,000 connections to it that say nothing; Zenoh queried without a pause by four sessions; 60 subscribers;
eight Foxglove clients subscribed to everything, of which half read nothing, and more that come and go; quiet again. The
daemon has the priority of its unit, and the clients have the lowest: what is measured is what they make the daemon do.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import zenoh

from benchmarks.isolation import Watch, during
from benchmarks.latency import NICE, configuration, free_port, process, turn_wheels
from fusiond.app.live.daemon import Daemon
from fusiond.app.live.serve import serve
from fusiond.config.outputs import Foxglove, Prometheus

PHASES = ("scrapes", "idle", "queries", "subscribers", "foxglove")


def in_threads(number: int, work: Callable[[], object]) -> None:
    """Do something for ever, in several threads."""

    def again() -> None:
        while True:
            with contextlib.suppress(OSError, zenoh.ZError, EOFError):
                work()

    for _ in range(number):
        threading.Thread(target=again, daemon=True).start()


def session(port: int) -> zenoh.Session:
    made = zenoh.Config()
    made.insert_json5("mode", '"client"')
    made.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    made.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(made)


def scrapes(port: int) -> None:
    def scrape() -> None:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            answer.read()

    in_threads(8, scrape)


def idle(port: int) -> None:
    held: list[socket.socket] = []

    def connect() -> None:
        if len(held) < 1000:
            held.append(socket.create_connection(("127.0.0.1", port), 1))
            held[-1].send(b"GET /metrics HT")
        else:
            time.sleep(0.1)

    in_threads(20, connect)


def queries(port: int) -> None:
    def query() -> None:
        with session(port) as asking:
            while True:
                for _ in asking.get("fusiond/**", timeout=2.0):
                    pass

    in_threads(4, query)


def subscribers(port: int) -> None:
    opened = [session(port) for _ in range(60)]
    for one in opened:
        one.declare_subscriber("fusiond/**", lambda _: None)
    in_threads(1, lambda: time.sleep(len(opened)))


def foxglove(port: int) -> None:
    from websockets.sync.client import connect  # noqa: PLC0415 - of the extra for development

    url = f"ws://127.0.0.1:{port}"
    reads = iter([True, False] * 4)

    def watch() -> None:
        reading = next(reads, True)
        with contextlib.suppress(Exception), connect(url, subprotocols=["foxglove.sdk.v1"], max_queue=1) as peer:  # type: ignore[list-item]
            peer.recv(5)
            listed = json.loads(peer.recv(5))["channels"]
            wanted = [{"id": number, "channelId": one["id"]} for number, one in enumerate(listed)]
            peer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            while True:
                peer.recv() if reading else time.sleep(1)

    in_threads(12, watch)


@contextmanager
def attack(kind: str, port: int) -> Iterator[None]:
    command = ["nice", "-n", "19", sys.executable, "-m", "benchmarks.greedy", "--attack", kind, "--port", str(port)]
    with subprocess.Popen(command) as made:
        try:
            yield
        finally:
            made.kill()


async def measure(folder: Path, seconds: float) -> str:
    udp, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    ports = {"scrapes": free_port(socket.SOCK_STREAM), "foxglove": free_port(socket.SOCK_STREAM)}
    outputs = {
        "prometheus": Prometheus(enabled=True, port=ports["scrapes"]),
        "foxglove": Foxglove(enabled=True, port=ports["foxglove"]),
    }
    daemon = Daemon(msgspec.structs.replace(configuration(folder, udp, tcp), **outputs))
    run = asyncio.create_task(serve(daemon))
    await daemon.up.wait()
    handed = daemon.outputs.handed_over
    watch = Watch(handed.add)
    handed.add = watch.add  # type: ignore[method-assign]
    whole = (seconds + 2) * (len(PHASES) + 2) + 3
    wheels = threading.Thread(target=turn_wheels, args=(whole,), name="(the benchmark's wheels)")
    wheels.start()
    found: dict[str, str] = {}
    where = {**ports, "idle": ports["scrapes"], "queries": tcp, "subscribers": tcp}
    with process("--feed", udp, "--seconds", whole):
        await asyncio.sleep(3)
        found["quiet"] = await figures(watch, seconds)
        for kind in PHASES:
            with attack(kind, where[kind]):
                await asyncio.sleep(2)
                found[kind] = await figures(watch, seconds)
        await asyncio.sleep(1)
        found["quiet again"] = await figures(watch, seconds)
    counts = {name: daemon.outputs[name].counts() for name in ("zenoh", "prometheus", "foxglove")}
    daemon.stop()
    await run
    await asyncio.to_thread(wheels.join)
    lines = [
        "| | instant to outputs, ms: p50 | p99 | most | CPU, % of a core | threads |",
        "|---|---|---|---|---|---|",
        *(f"| {phase} | {row} |" for phase, row in found.items()),
    ]
    return "\n".join([*lines, "", str(counts)])


async def figures(watch: Watch, seconds: float) -> str:
    """The columns of a phase."""
    worked, began = time.process_time(), time.monotonic()
    p50, p99 = await during(watch, seconds)
    share = 100 * (time.process_time() - worked) / (time.monotonic() - began)
    report = watch.latest.report()
    assert report is not None
    threads = len(list(Path("/proc/self/task").iterdir()))
    return " | ".join([f"{p50:.2f}", f"{p99:.2f}", f"{report.max:.2f}", f"{share:.0f}", str(threads)])


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.greedy", description=__doc__)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each phase")
    parser.add_argument("--out", type=Path, default=Path("out/greedy"))
    parser.add_argument("--alone", action="store_true", help="real-time priority, for a machine that does other work too")
    parser.add_argument("--attack", choices=PHASES, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.attack:
        globals()[options.attack](options.port)
        time.sleep(3600)
    with contextlib.suppress(PermissionError):
        os.nice(NICE)
    if options.alone:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    options.out.mkdir(parents=True, exist_ok=True)
    print(asyncio.run(measure(options.out, options.seconds)))


if __name__ == "__main__":
    main(sys.argv[1:])
