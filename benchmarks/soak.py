"""A long run under full load: whether memory stays flat, every event is counted, and a replay of the recording publishes
the same bytes.

    python -m benchmarks.soak [--minutes 60] [--real-time] [--out out/soak]
    python -m benchmarks.soak --attacked [--as-installed] [--minutes 60] [--seed 1] [--attacks NAME,...]

The load is that of benchmarks.latency. By default frames go straight into the inboxes with stamps of a simulated clock, as
fast as they are processed. With --real-time they come over UDP and a virtual CAN bus. With --attacked they do so among the
attackers of benchmarks.hostile, and 99 % of the states must arrive in time; nothing is replayed. The exit status is 1 on
failure.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

import msgspec

from benchmarks.hostile import ATTACKS, as_installed, report, under_attack
from benchmarks.latency import CAN_HZ, IMU_HZ, configuration, free_port, process, sent_by_autopilot, turn_wheels
from fusiond.app.live.daemon import Daemon
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config.schema import Config
from fusiond.messages.codec import encode
from fusiond.messages.types import StateMessage
from fusiond.units import SECOND
from fusiond_adapters.can.bus import CanFrame
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.play import PlayedClock

BEGIN_NS = 1_760_000_000 * SECOND
SINCE_BOOT_NS = 60 * SECOND  # at the start
APART_NS = 200_000  # between frames of one instant
WARM_UP_S = 300.0  # after this, memory must stay flat
FLAT_MB = 2.0
DIGEST = 8  # bytes of a publication's digest
IN_TIME_MS = 5.0  # from the instant of a state to the subscriber, 99 %
LOOKS = 20  # reports of the memory in a run


def rss_mb() -> float:
    """Memory of this process now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Published:
    """Digests of everything published, in a file: a list in memory would itself grow."""

    def __init__(self, file: BinaryIO) -> None:
        self.count = 0
        self._file = file

    def add(self, message: StateMessage) -> None:
        """Called by the estimator."""
        self.count += 1
        self._file.write(digest(message))


def digest(message: StateMessage) -> bytes:
    return hashlib.blake2b(encode(message, "json"), digest_size=DIGEST).digest()


class Memory:
    """Reports the memory during the run, and its growth after the warm-up."""

    def __init__(self, seconds: float) -> None:
        self.after_warm_up_mb: float | None = None
        self.latest_mb = 0.0
        self._warm_up_s, self._every = min(WARM_UP_S, seconds / 2), seconds / LOOKS
        self._next = 0.0

    def look(self, elapsed_s: float) -> None:
        """Call this often."""
        self.latest_mb = rss_mb()
        if self.after_warm_up_mb is None and elapsed_s >= self._warm_up_s:
            self.after_warm_up_mb = self.latest_mb
        if elapsed_s >= self._next:
            self._next += self._every
            print(f"{elapsed_s:6.0f} s  {self.latest_mb:7.2f} MB", flush=True)

    def growth_mb(self) -> float:
        """Since the warm-up."""
        assert self.after_warm_up_mb is not None
        return rss_mb() - self.after_warm_up_mb


def frames(seconds: float) -> Iterator[tuple[int, bytes | CanFrame]]:
    """Instants [ns from the start] and frames: those of benchmarks.latency, of a vehicle at rest."""
    for number, (imu, *others) in enumerate(sent_by_autopilot(SINCE_BOOT_NS, seconds)):
        t_ns = number * SECOND // IMU_HZ
        yield t_ns, imu
        if number % (IMU_HZ // CAN_HZ) == 0:
            yield t_ns + APART_NS, CanFrame(256, False, bytes(8))
        for place, datagram in enumerate(others, 2):
            yield t_ns + place * APART_NS, datagram


def accelerated(settings: Config, seconds: float, published: Published, memory: Memory, box: Path) -> Daemon:
    """Run on a simulated clock, as fast as possible."""
    clock = PlayedClock(BEGIN_NS, 1.0)
    daemon = Daemon(settings, sinks=[published.add], zenoh=False, clock=clock)
    link, bus = daemon.inputs["mavlink.fc"], daemon.inputs["can.car"]
    bus.prepare()
    with ExitStack() as stack:
        files: dict[str, BinaryIO] = {}

        def record(kind: str, _t_ns: int, data: bytes) -> None:
            if kind not in files:
                files[kind] = stack.enter_context((box / kind).open("wb"))
            files[kind].write(data)

        daemon.live.record = record
        for since_ns, frame in frames(seconds):
            clock.set(BEGIN_NS + since_ns)
            (bus if isinstance(frame, CanFrame) else link).inbox.put(clock.now_ns(), frame)
            daemon.live.step(daemon.inputs)
            memory.look(since_ns / SECOND)
    return daemon


async def in_real_time(settings: Config, seconds: float, published: Published, memory: Memory) -> Daemon:
    """Run over the live inputs."""
    daemon = Daemon(settings, sinks=[published.add])
    run = asyncio.create_task(daemon.run())
    await daemon.up.wait()
    port = settings.mavlink["fc"].connection.rpartition(":")[2]
    wheels = threading.Thread(target=turn_wheels, args=(seconds,), name="(the benchmark's wheels)")
    began = time.monotonic()
    with process("--feed", port, "--seconds", seconds):
        wheels.start()
        while (elapsed_s := time.monotonic() - began) < seconds:
            memory.look(elapsed_s)
            await asyncio.sleep(1.0)
    await asyncio.to_thread(wheels.join)
    daemon.stop()
    await run
    return daemon


def replayed(settings: Config, box: Path, digests: Path) -> tuple[int, int]:
    """The number of states that a replay of the recording publishes, and how many differ from those published live."""
    count = other = 0
    with digests.open("rb") as file:

        def compare(message: StateMessage, _: object) -> None:
            nonlocal count, other
            count += 1
            other += file.read(DIGEST) != digest(message)

        logs = [str(path) for path in sorted(box.glob("*log"))]
        Replay(settings, ReplayTask(settings.publish.rate_hz, on_tick=[compare])).run(open_logs(logs, settings))
    return count, other


def soak(seconds: float, out: Path, *, real_time: bool) -> bool:
    """Run, print the results, and return whether all is well."""
    settings = configuration(out, free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM))
    memory, digests = Memory(seconds), out / "digests"
    with TemporaryDirectory(dir=out.resolve()) as box:  # a relative folder would be relative to the configuration
        with digests.open("wb") as file:
            published = Published(file)
            begin = time.monotonic()
            if real_time:
                record = msgspec.structs.replace(settings.record, folder=box)
                settings = msgspec.structs.replace(settings, record=record)
                daemon = asyncio.run(in_real_time(settings, seconds, published, memory))
            else:
                daemon = accelerated(settings, seconds, published, memory, Path(box))
        growth_mb = memory.growth_mb()
        took_s = time.monotonic() - begin
        print(f"{seconds:.0f} s of load in {took_s:.0f} s")
        print(f"memory after the warm-up {memory.after_warm_up_mb:.2f} MB, then {growth_mb:+.2f} MB")
        totals = daemon.live.engine.fusion.totals()
        accounted = sum(totals.values()) == daemon.live.offered
        print(f"measurements: {daemon.live.offered} offered, {sum(totals.values())} accounted for: {totals}")
        print(f"lost: {daemon.losses()}")
        count, other = replayed(settings, Path(box), digests)
    print(f"states: {published.count} published, {count} replayed, {other} of them with other bytes")
    return growth_mb <= FLAT_MB and accounted and count > 0 and not other


def attacked(seconds: float, out: Path, attacks: list[str], seed: int) -> bool:
    """Run among attackers, print the results, and return whether all is well."""
    memory = Memory(seconds)
    result = asyncio.run(under_attack(out, seconds, attacks, seed, memory.look))
    assert memory.after_warm_up_mb is not None
    p99_ms = result.p99_ms()
    growth_mb = memory.latest_mb - memory.after_warm_up_mb  # later this process holds the subscriber's result as well
    print(report(result))
    print(f"memory after the warm-up {memory.after_warm_up_mb:.2f} MB, then {growth_mb:+.2f} MB")
    print(f"99 % of the states arrived within {p99_ms:.2f} ms of their instant; required {IN_TIME_MS:g} ms")
    return result.good() and growth_mb <= FLAT_MB and p99_ms <= IN_TIME_MS


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--real-time", action="store_true")
    way.add_argument("--attacked", action="store_true")
    parser.add_argument("--attacks", default=",".join(ATTACKS), help="those of benchmarks.hostile; default: all")
    parser.add_argument("--as-installed", action="store_true", help="with the priority of the unit; needs a privilege")
    parser.add_argument("--seed", type=int, default=1, help="of the attackers")
    parser.add_argument("--out", type=Path, default=Path("out/soak"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.as_installed:
        as_installed()
    if options.attacked:
        return 0 if attacked(60 * options.minutes, options.out, options.attacks.split(","), options.seed) else 1
    return 0 if soak(60 * options.minutes, options.out, real_time=options.real_time) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
