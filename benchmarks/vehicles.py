"""Many vehicles through one Zenoh router: what arrives, what is lost, and how late.

    python -m benchmarks.vehicles [--vehicles 20] [--rate 100] [--seconds 20] [--processes 4]

Each vehicle has its own session and publisher, as in the daemon. It publishes states at the rate, and each second a health
message and an event, which Zenoh delivers reliably. The router, the vehicles (several per process) and the reader run in
separate processes.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from fusiond.app.client import Client
from fusiond.config.outputs import Zenoh
from fusiond.estimator.solution import Mode, Solution, SolutionState
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
from fusiond_adapters.zenoh.session import KIND, ZenohPublisher, open_session

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
    with open_session(Zenoh(mode="router", listen=[f"tcp/127.0.0.1:{port}"])):
        print("ready", flush=True)
        sys.stdin.read()


def publish(port: int, names: list[str], rate: float, seconds: float) -> None:
    """Publish for several vehicles, in turn within each period. Prints the number of messages of each kind per vehicle."""
    section = Zenoh(mode="client", listen=[], connect=[f"tcp/127.0.0.1:{port}"])
    with ExitStack() as stack:
        vehicles = [
            stack.enter_context(ZenohPublisher(stack.enter_context(open_session(section)), name, "json")) for name in names
        ]
        begin, periods = time.monotonic(), round(rate * seconds)
        for number in range(periods):
            time.sleep(max(0.0, begin + number / rate - time.monotonic()))
            for vehicle in vehicles:
                vehicle.publish(state(vehicle.vehicle, time.time_ns()))
                if number % round(rate) == 0:
                    vehicle.publish(health(vehicle.vehicle, time.time_ns()))
                    vehicle.publish(EventMessage(vehicle=vehicle.vehicle, t_ns=time.time_ns(), kind="mode",
                                                 severity="info", subject="", text=str(number)))  # fmt: skip
        took = time.monotonic() - begin
        print(json.dumps({"periods": periods, "reliable": -(-periods // round(rate)), "seconds": took}), flush=True)
        sys.stdin.read()


def read(port: int) -> None:
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

    with Client(f"tcp/127.0.0.1:{port}", "*") as client, ExitStack() as stack:
        for kind in KINDS:
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


def measure(vehicles: int, rate: float, seconds: float, processes: int) -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    names = [f"vehicle{number:02d}" for number in range(vehicles)]
    with ExitStack() as stack:
        router = stack.enter_context(process("route", port))
        line(router)
        reader = stack.enter_context(process("read", port))
        line(reader)
        shares = [names[i::processes] for i in range(processes)]
        numbers = ("--rate", rate, "--seconds", seconds)
        publishers = [stack.enter_context(process("publish", port, *share, *numbers)) for share in shares]
        done = [json.loads(line(made)) for made in publishers]
        time.sleep(GRACE_S)
        end(reader)
        found = json.loads(line(reader))
        for made in (*publishers, router):
            end(made)
    periods = sum(one["periods"] * len(share) for one, share in zip(done, shares, strict=True))
    reliable = sum(one["reliable"] * len(share) for one, share in zip(done, shares, strict=True))
    achieved = periods / vehicles / max(one["seconds"] for one in done)
    rows = [("", "published", "arrived", "lost", "doubled")]
    for kind, sent in (("state", periods), ("health", reliable), ("events", reliable)):
        got = found["counts"][kind]
        rows.append((kind, str(sent), str(got), str(sent - got), str(found["doubles"].get(kind, 0))))
    late = ", ".join(f"{name} {ms:.2f}" for name, ms in found["late_ms"].items())
    head = f"{found['vehicles']} vehicles at {achieved:.1f} Hz for {seconds:g} s through one router, {os.cpu_count()} CPUs"
    table = "\n".join(f"{row[0]:8}" + "".join(f"{cell:>12}" for cell in row[1:]) for row in rows)
    return f"{head}\n{table}\nstates were late by [ms]: {late}"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.vehicles", description=__doc__)
    parser.add_argument("role", nargs="?", choices=("measure", "route", "publish", "read"), default="measure")
    parser.add_argument("rest", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--processes", type=int, default=4)
    options = parser.parse_args(arguments)
    if options.role == "measure":
        print(measure(options.vehicles, options.rate, options.seconds, options.processes))
        return
    port, *names = options.rest
    if options.role == "route":
        route(int(port))
    elif options.role == "read":
        read(int(port))
    else:
        publish(int(port), names, options.rate, options.seconds)


if __name__ == "__main__":
    main(sys.argv[1:])
