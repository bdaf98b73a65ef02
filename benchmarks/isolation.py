"""Whether a consumer in trouble delays the filter: latency from receipt to fused, phase by phase, in one run.

    python -m benchmarks.isolation [--seconds 8] [--out out/isolation]

The load is that of benchmarks.latency, and MCAP files are written too. The phases: no subscriber; a subscriber in another
process; the same subscriber stopped (SIGSTOP) with its connection open; no file of the black box or of MCAP can grow
(RLIMIT_FSIZE); the connected router dies; it is back; no subscriber again. Figures are ratios to the first phase.
"""

from __future__ import annotations

import argparse
import asyncio
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec
import zenoh

from benchmarks.latency import configuration, free_port, process, turn_wheels
from fusiond.app.live.daemon import Daemon
from fusiond.app.live.serve import serve
from fusiond.config.outputs import Mcap
from fusiond.config.schema import Config
from fusiond.messages.latency import RecentLatencies

QUIET, READ, STOPPED, FULL_DISKS = "quiet", "a subscriber", "the subscriber stopped", "disks full"
DEAD, BACK, AGAIN = "the router dead", "the router back", "quiet again"
PHASES = 7
FULL = 1 << 16  # bytes that a file may hold while the disks are full


def router(port: int) -> zenoh.Session:
    made = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/127.0.0.1:{port}"]'),
        ("scouting/multicast/enabled", "false"),
    ):
        made.insert_json5(key, value)
    return zenoh.open(made)


def settings(folder: Path, udp: int, tcp: int, router_port: int) -> Config:
    made = configuration(folder, udp, tcp)
    link = msgspec.structs.replace(made.zenoh, connect=[f"tcp/127.0.0.1:{router_port}"])
    return msgspec.structs.replace(made, zenoh=link, mcap=Mcap(folder="mcap"))


class Watch:
    """Latencies of the present phase, in place of the daemon's own."""

    def __init__(self, inside: Callable[[int], None]) -> None:
        self.latest = RecentLatencies()
        self._inside = inside

    def add(self, latency_ns: int) -> None:
        self.latest.add(latency_ns)
        self._inside(latency_ns)


async def measure(folder: Path, seconds: float) -> str:
    udp, tcp, router_port = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
    up = await asyncio.to_thread(router, router_port)
    daemon = Daemon(settings(folder, udp, tcp, router_port))
    run = asyncio.create_task(serve(daemon))
    await daemon.up.wait()
    fused = daemon.live.to_fusion
    watch = Watch(fused.add)
    fused.add = watch.add  # type: ignore[method-assign]
    whole = seconds * PHASES + 2
    wheels = threading.Thread(target=turn_wheels, args=(whole,), name="(the benchmark's wheels)")
    wheels.start()
    found = {}
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with process("--feed", udp, "--seconds", whole):
        await asyncio.sleep(1)
        found[QUIET] = await during(watch, seconds)
        with process("--subscribe", tcp, "--seconds", whole) as reader:
            assert reader.stdout is not None
            await asyncio.to_thread(reader.stdout.readline)
            found[READ] = await during(watch, seconds)
            reader.send_signal(signal.SIGSTOP)
            found[STOPPED] = await during(watch, seconds)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, limits[1]))
        found[FULL_DISKS] = await during(watch, seconds)
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        await asyncio.to_thread(up.close)
        found[DEAD] = await during(watch, seconds)
        up = await asyncio.to_thread(router, router_port)
        found[BACK] = await during(watch, seconds)
        found[AGAIN] = await during(watch, seconds)
    losses = daemon.losses()
    daemon.stop()
    await run
    await asyncio.to_thread(up.close)
    await asyncio.to_thread(wheels.join)
    base = found[QUIET]
    lines = ["| receipt to fused, ms | p50 | p99 | p50 against quiet |", "|---|---|---|---|"]
    lines += [f"| {phase} | {p50:.2f} | {p99:.2f} | {p50 / base[0]:.2f} x |" for phase, (p50, p99) in found.items()]
    return "\n".join([*lines, "", f"losses, all counted: { {name: count for name, count in losses.items() if count} }"])


async def during(watch: Watch, seconds: float) -> tuple[float, float]:
    """p50 and p99 of a phase [ms], after half a second of transition."""
    await asyncio.sleep(0.5)
    watch.latest = RecentLatencies()
    await asyncio.sleep(seconds - 0.5)
    report = watch.latest.report()
    assert report is not None, "nothing was fused"
    return report.p50, report.p99


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.isolation", description=__doc__)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each phase")
    parser.add_argument("--out", type=Path, default=Path("out/isolation"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    print(asyncio.run(measure(options.out, options.seconds)))


if __name__ == "__main__":
    main(sys.argv[1:])
