"""Many vehicles through one Zenoh router: what arrives, what is lost, and how late.

    python -m benchmarks.vehicles [--vehicles 20] [--rate 100] [--seconds 20] [--processes 4] [--light]
    python -m benchmarks.vehicles --table [--seconds 10]

Each vehicle has its own session and publisher, as in the daemon. It publishes states at the rate, and each second a health
message and an event, which Zenoh delivers reliably. The router, the vehicles (several per process) and the reader run in
separate processes. `--light` publishes states that are encoded before, and does not decode them: vehicles and reader then
leave the machine to the router. `--table` measures 20, 100 and 200 vehicles at 10, 50 and 100 Hz so, a row each.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import socket
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

import numpy as np
import zenoh

from fusiond.app.client import Client
from fusiond.config.outputs import Zenoh
from fusiond.estimator.solution import Mode, Solution, SolutionState
from fusiond.messages.codec import encode
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import (
    EventMessage,
    HealthMessage,
    InputHealth,
    LatencyHealth,
    Message,
    OutcomeCounts,
    SourceHealth,
    StateMessage,
)
from fusiond_adapters.zenoh.session import KIND, ZenohPublisher, open_session, session_config, state_key

GRACE_S = 3.0  # after the last publication, for messages that are fetched again
COUNTS = OutcomeCounts(fused=48_211, rejected=37)
KINDS: tuple[type[Message], ...] = (StateMessage, HealthMessage, EventMessage)


def state(vehicle: str, t_ns: int) -> StateMessage:
    three = (0.1234567891234, -2.3456789, 0.012345678)
    solution = SolutionState(
        latitude=0.8401234, longitude=0.2012345, height=112.3, velocity_n=three, quaternion_nb=(0.98, 0.1, 0.1, 0.1),
        angular_rate_b=three, acceleration_b=three, gyro_bias=three, accel_bias=three, wheel_scale=0.012, mount=(0.01, 0.02),
        covariance=np.eye(9) * 0.123456789, sigma_gyro_bias=three, sigma_accel_bias=three, sigma_wheel_scale=1e-3,
        sigma_mount=(1e-3, 2e-3),
    )  # fmt: skip
    return state_message(Solution(t_ns, Mode.NOMINAL, 2_500_000, 0, solution), vehicle, COUNTS)


def health(vehicle: str, t_ns: int) -> HealthMessage:
    source = SourceHealth(outcomes=COUNTS, present=True, age_ms=3.0, rate_hz=100.0, test_ratio=0.1, nis_mean=1.0)
    return HealthMessage(
        vehicle=vehicle, t_ns=t_ns, version="1", uptime_s=1.0, mode=Mode.NOMINAL, resets=0, outcomes=COUNTS,
        latency_ms=LatencyHealth(), sources={f"source{i}": source for i in range(7)},
        inputs={"mavlink.fc": InputHealth(received=1, dropped=0, counts={})}, outputs={},
    )  # fmt: skip


# --- The processes


def route(port: int) -> None:
    config = session_config(Zenoh(mode="router", listen=[f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("transport/unicast/max_sessions", "10000")  # as configs/zenoh/yard.json5 has it
    with zenoh.open(config):
        print("ready", flush=True)
        sys.stdin.read()
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(json.dumps({"cpu_s": used.ru_utime + used.ru_stime, "peak_mb": used.ru_maxrss / 1024}), flush=True)


def stamped(t_ns: int, rest: bytes) -> bytes:
    """A state of which only the stamp is new."""
    return t_ns.to_bytes(8, "big") + rest


def publish(port: int, names: list[str], rate: float, seconds: float, light: bool) -> None:
    """Publish for several vehicles, in turn within each period. Prints the number of messages of each kind per vehicle."""
    section = Zenoh(mode="client", listen=[], connect=[f"tcp/127.0.0.1:{port}"])
    with ExitStack() as stack:
        vehicles = [
            stack.enter_context(ZenohPublisher(stack.enter_context(open_session(section)), name, "json")) for name in names
        ]
        rest = encode(state("vehicle000", time.time_ns()), "json")[8:]
        begin, periods = time.monotonic(), round(rate * seconds)
        for number in range(periods):
            time.sleep(max(0.0, begin + number / rate - time.monotonic()))
            for vehicle in vehicles:
                if light:
                    vehicle._publishers[state_key(vehicle.vehicle)].put(stamped(time.time_ns(), rest))
                else:
                    vehicle.publish(state(vehicle.vehicle, time.time_ns()))
                if number % round(rate) == 0:
                    vehicle.publish(health(vehicle.vehicle, time.time_ns()))
                    vehicle.publish(EventMessage(vehicle=vehicle.vehicle, t_ns=time.time_ns(), kind="mode",
                                                 severity="info", subject="", text=str(number)))  # fmt: skip
        took = time.monotonic() - begin
        print(json.dumps({"periods": periods, "reliable": -(-periods // round(rate)), "seconds": took}), flush=True)
        sys.stdin.read()


def read(port: int, light: bool) -> None:
    """Count what arrives, each message once, until standard input ends; then print the counts."""
    seen: dict[type[Message], set[tuple[str, int]]] = {kind: set() for kind in KINDS}
    doubles: Counter[str] = Counter()
    late_ms: list[float] = []

    def keeper(kind: type[Message]) -> Callable[[Message], None]:
        def keep(message: Message) -> None:
            assert isinstance(message, StateMessage | HealthMessage | EventMessage)
            identity = message.vehicle, message.t_ns
            doubles[KIND[kind]] += identity in seen[kind]
            seen[kind].add(identity)
            if kind is StateMessage:
                late_ms.append((time.time_ns() - message.t_ns) / 1e6)

        return keep

    def keep_light(sample: zenoh.Sample) -> None:
        t_ns = int.from_bytes(sample.payload.to_bytes()[:8], "big")
        late_ms.append((time.time_ns() - t_ns) / 1e6)
        identity = str(sample.key_expr), t_ns
        doubles["state"] += identity in seen[StateMessage]
        seen[StateMessage].add(identity)

    with Client(f"tcp/127.0.0.1:{port}", "*") as client, ExitStack() as stack:
        if light:
            stack.enter_context(client._session.declare_subscriber(state_key("*"), keep_light))
        for kind in KINDS[1:] if light else KINDS:
            stack.enter_context(client.subscribed(kind, keeper(kind)))
        print("ready", flush=True)
        sys.stdin.read()
    cuts = statistics.quantiles(late_ms, n=1000)
    counts = {KIND[kind]: len(found) for kind, found in seen.items()}
    late = {"p50": cuts[499], "p99": cuts[989], "p99.9": cuts[998], "max": max(late_ms)}
    vehicles = len({vehicle for vehicle, _ in seen[StateMessage]})
    print(json.dumps({"counts": counts, "doubles": doubles, "late_ms": late, "vehicles": vehicles}), flush=True)


# --- Together


@contextmanager
def process(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "benchmarks.vehicles", *map(str, arguments)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as made:
        try:
            yield made
        finally:
            made.kill()


def line(made: subprocess.Popen[str]) -> str:
    assert made.stdout is not None
    return made.stdout.readline()


def end(made: subprocess.Popen[str]) -> None:
    assert made.stdin is not None
    made.stdin.close()


class Measured(NamedTuple):
    """What one run gave."""

    vehicles: int
    achieved_hz: float
    seconds: float
    counts: dict[str, tuple[int, int, int]]  # by kind: published, arrived, doubled
    late_ms: dict[str, float]
    router_cpu: float  # processors
    router_mb: float

    def lost(self, kind: str) -> int:
        published, arrived, _ = self.counts[kind]
        return published - arrived


def measure(vehicles: int, rate: float, seconds: float, processes: int, light: bool) -> Measured:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    names = [f"vehicle{number:03d}" for number in range(vehicles)]
    mode = ["--light"] if light else []
    with ExitStack() as stack:
        router = stack.enter_context(process("route", port))
        line(router)
        reader = stack.enter_context(process("read", port, *mode))
        line(reader)
        shares = [names[i::processes] for i in range(processes)]
        numbers = ("--rate", rate, "--seconds", seconds, *mode)
        publishers = [stack.enter_context(process("publish", port, *share, *numbers)) for share in shares]
        done = [json.loads(line(made)) for made in publishers]
        time.sleep(GRACE_S)
        end(reader)
        found = json.loads(line(reader))
        for made in (*publishers, router):
            end(made)
        used = json.loads(line(router))
    periods = sum(one["periods"] * len(share) for one, share in zip(done, shares, strict=True))
    reliable = sum(one["reliable"] * len(share) for one, share in zip(done, shares, strict=True))
    achieved = periods / vehicles / max(one["seconds"] for one in done)
    counts = {
        kind: (sent, found["counts"][kind], found["doubles"].get(kind, 0))
        for kind, sent in (("state", periods), ("health", reliable), ("events", reliable))
    }
    took = max(one["seconds"] for one in done)
    assert found["vehicles"] == vehicles, f"{found['vehicles']} of {vehicles} vehicles were heard"
    return Measured(vehicles, achieved, took, counts, found["late_ms"], used["cpu_s"] / took, used["peak_mb"])


def text(found: Measured) -> str:
    rows = [("", "published", "arrived", "lost", "doubled")]
    for kind, (sent, got, doubled) in found.counts.items():
        rows.append((kind, *map(str, (sent, got, sent - got, doubled))))
    late = ", ".join(f"{name} {ms:.2f}" for name, ms in found.late_ms.items())
    head = (
        f"{found.vehicles} vehicles at {found.achieved_hz:.1f} Hz for {found.seconds:.0f} s through one router,"
        f" {os.cpu_count()} CPUs"
    )
    table = "\n".join(f"{row[0]:8}" + "".join(f"{cell:>12}" for cell in row[1:]) for row in rows)
    router = f"the router took {100 * found.router_cpu:.0f} % of a CPU and {found.router_mb:.0f} MB"
    return f"{head}\n{table}\nstates were late by [ms]: {late}\n{router}"


HEADS = "| vehicles | Hz wanted | Hz | states | lost | reliable | lost | p50 ms | p99 ms | router CPU % | MB |"


def row(found: Measured, wanted_hz: float) -> str:
    reliable = found.counts["health"][0] + found.counts["events"][0]
    cells = (
        found.vehicles, f"{wanted_hz:g}", f"{found.achieved_hz:.1f}", found.counts["state"][0], found.lost("state"),
        reliable, found.lost("health") + found.lost("events"), f"{found.late_ms['p50']:.2f}", f"{found.late_ms['p99']:.1f}",
        f"{100 * found.router_cpu:.0f}", f"{found.router_mb:.0f}",
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.vehicles", description=__doc__)
    parser.add_argument("role", nargs="?", choices=("measure", "route", "publish", "read"), default="measure")
    parser.add_argument("rest", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--light", action="store_true")
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args(arguments)
    if options.table:
        print(f"{HEADS}\n|{'---|' * HEADS.count(' | ')}---|")
        for vehicles in (20, 100, 200):
            for rate in (10.0, 50.0, 100.0):
                print(row(measure(vehicles, rate, options.seconds, options.processes, True), rate), flush=True)
        return
    if options.role == "measure":
        print(text(measure(options.vehicles, options.rate, options.seconds, options.processes, options.light)))
        return
    port, *names = options.rest
    if options.role == "route":
        route(int(port))
    elif options.role == "read":
        read(int(port), options.light)
    else:
        publish(int(port), names, options.rate, options.seconds, options.light)


if __name__ == "__main__":
    main(sys.argv[1:])
