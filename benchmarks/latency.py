"""The time from a publication to a subscriber in another process, and where the daemon's CPU time goes.

    python -m benchmarks.latency [--seconds 30] [--runs 5] [--as-installed] [--by-clock] [--out out/latency]

Load: IMU at 400 Hz, GNSS at 10 Hz and 200 ms late, both as MAVLink over UDP from a separate process; four wheels at 100 Hz
in one CAN frame on python-can's virtual bus; 100 publications a second over Zenoh, with the black box running.
Reference, in the same run: a process that only puts the same number of bytes at the same rate to the same kind of reader,
while the autopilot's process sends as before. It is measured from the instant at which a put was due, too.
On a virtual machine the processor time that the host takes (steal) affects all figures. It is printed for each run, and a
second row has only the arrivals that it did not disturb: the steal counter, which counts units of 10 ms, did not change
from 250 ms before the publication to 250 ms after the arrival.
A publication waits for the next inertial sample (`publish.on_imu`). With --by-clock it does not, as by default in the
configuration: then the sample is up to 2.5 ms old, with a phase that is random in each run. With --as-installed the daemon
has the priority and the timer slack of systemd/fusiond.service; the other processes never have.
"""

from __future__ import annotations

import argparse
import asyncio
import bisect
import ctypes
import os
import platform
import resource
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import msgspec
import zenoh
from pymavlink.dialects.v20 import common

from fusiond import __version__
from fusiond.app.client import Client
from fusiond.app.live.daemon import Daemon
from fusiond.app.live.serve import serve
from fusiond.config import load as config
from fusiond.config.outputs import Zenoh
from fusiond.config.schema import Config
from fusiond.messages.types import StateMessage
from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.zenoh.session import open_session

IMU_HZ, GNSS_HZ, CAN_HZ, PUBLISH_HZ = 400, 10, 100, 100
GNSS_LATE_US = 200_000
NICE, TIMER_SLACK_NS = -5, 1000  # as in systemd/fusiond.service
USUAL_SLACK_NS = 50_000  # Linux's
PR_SET_TIMERSLACK = 29  # prctl(2)
WARM_UP = 200  # first publications, which are left out
MAX_PACKED_S = 300.0  # a run up to this long is packed before it is sent
STATE_BYTES = 1900  # of a state in JSON
REFERENCE_KEY = "benchmark/reference"
CHANNEL = "latency"
LOOK_S = 0.02  # between readings of the steal counter
APART_NS = 250 * MILLISECOND  # without steal for this long before and after
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
SIGNALS = "\n".join(f' SG_ {name} : {16 * i}|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX' for i, name in enumerate(WHEELS))
DBC = f'VERSION ""\nBU_: ECU\nBO_ 256 WHEELS: 8 ECU\n{SIGNALS}\n'


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def configuration(folder: Path, udp: int, tcp: int, *, on_imu: bool = False) -> Config:
    (folder / "wheels.dbc").write_text(DBC)
    wheels = "".join(f'[wheel.{name}]\nbus = "car"\nmessage = "WHEELS"\nsignal = "{name}"\n' for name in WHEELS)
    text = f"""
[vehicle]
name = "bench"
[filter]
heading_deg = 30.0
[publish]
rate_hz = {PUBLISH_HZ}
on_imu = {str(on_imu).lower()}
[zenoh]
listen = ["tcp/127.0.0.1:{tcp}"]
[record]
folder = "box"
[mavlink.fc]
connection = "udpin:127.0.0.1:{udp}"
[can.car]
dbc = ["wheels.dbc"]
interface = "virtual"
channel = "{CHANNEL}"
[imu.imu0]
link = "fc"
rate_hz = {IMU_HZ}
[gnss.gps0]
link = "fc"
{wheels}"""
    (folder / "latency.toml").write_text(text)
    return config.load(folder / "latency.toml")


# --- The processes around the daemon


def every(hz: int, seconds: float) -> Iterator[int]:
    """Numbers at a rate, by the monotonic clock."""
    begin = time.monotonic()
    for number in range(round(hz * seconds)):
        wait = begin + number / hz - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        yield number


def feed(port: int, seconds: float) -> None:
    """The autopilot of a vehicle at rest. Its messages are packed before they are sent, as far as memory allows: a real
    autopilot has its own processor and does not use fusiond's."""
    packed = sent_by_autopilot(time.monotonic_ns(), seconds)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        if seconds <= MAX_PACKED_S:
            packed = iter(list(packed))
        for _, datagrams in zip(every(IMU_HZ, seconds), packed, strict=True):
            for datagram in datagrams:
                peer.sendto(datagram, ("127.0.0.1", port))


def sent_by_autopilot(begin_ns: int, seconds: float) -> Iterator[list[bytes]]:
    """The datagrams of each inertial sample. The autopilot's clock starts at `begin_ns`: fusiond finds that offset."""
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)

    def packed(message: common.MAVLink_message) -> bytes:
        data = bytes(message.pack(link))
        link.seq = (link.seq + 1) & 0xFF
        return data

    for number in range(round(IMU_HZ * seconds)):
        now_us = begin_ns // 1000 + number * 1_000_000 // IMU_HZ
        wobble = 0.01 * (number % 7 - 3)
        found = [packed(common.MAVLink_highres_imu_message(
            now_us, wobble, 0.0, -9.81, 1e-4, wobble / 10, 0.0, *(0.0,) * 7, 0x3F, 0))]  # fmt: skip
        if number % (IMU_HZ // GNSS_HZ) == 0:
            found.append(packed(common.MAVLink_gps_raw_int_message(
                now_us - GNSS_LATE_US, 3, 481374300, 115754900, 563000, 80, 120, 0, 0, 14, 563000, 500, 800, 50,
            )))  # fmt: skip
        if number % IMU_HZ == 0:
            kind, maker = common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_GENERIC
            found.append(packed(common.MAVLink_heartbeat_message(kind, maker, 0, 0, common.MAV_STATE_ACTIVE, 3)))
        yield found


def publish_only(port: int, seconds: float) -> None:
    """The reference: put the size of a state, with the instant at which it was due, at the rate of publications."""
    section = Zenoh(listen=[f"tcp/127.0.0.1:{port}"])
    with open_session(section) as session:
        publisher = session.declare_publisher(
            REFERENCE_KEY, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
        )
        print("ready", flush=True)
        begin_ns = time.time_ns()
        for number in every(PUBLISH_HZ, seconds):
            due_ns = begin_ns + number * SECOND // PUBLISH_HZ
            publisher.put(due_ns.to_bytes(8, "little") + bytes(STATE_BYTES))


class Arrival(msgspec.Struct, array_like=True):
    """One publication at its reader."""

    t_ns: int  # the instant of the publication
    arrived_ns: int
    age_ms: float = 0.0  # of its newest IMU sample at the instant of the publication


class Reading(msgspec.Struct):
    """The result of a reader."""

    arrivals: list[Arrival]
    stolen: list[tuple[int, int]]  # instant [ns] and steal counter [ticks of all processors]
    dropped: int = 0  # publications dropped on the way to Zenoh

    def stolen_share(self) -> float:
        """The share of the processors' time that the host took."""
        (begin_ns, before), (end_ns, after) = self.stolen[0], self.stolen[-1]
        return (after - before) / os.sysconf("SC_CLK_TCK") / ((end_ns - begin_ns) / SECOND * (os.cpu_count() or 1))

    def undisturbed(self) -> list[Arrival]:
        """Arrivals that steal did not disturb."""
        instants = [t_ns for t_ns, _ in self.stolen]
        found = []
        for arrival in self.arrivals:
            before = bisect.bisect_right(instants, arrival.t_ns - APART_NS) - 1
            after = bisect.bisect_left(instants, arrival.arrived_ns + APART_NS)
            if before >= 0 and after < len(instants) and self.stolen[before][1] == self.stolen[after][1]:
                found.append(arrival)
        return found


def watch_host(seconds: float) -> list[tuple[int, int]]:
    """The steal counter of this machine, read repeatedly."""
    found = []
    for _ in every(round(1 / LOOK_S), seconds):
        found.append((time.time_ns(), int(Path("/proc/stat").read_text().split(maxsplit=9)[8])))
    return found


def report(reading: Reading) -> None:
    """Write the result for the process that started this one."""
    reading.arrivals = reading.arrivals[WARM_UP:]
    sys.stdout.buffer.write(msgspec.json.encode(reading))


def subscribe_only(port: int, seconds: float) -> None:
    """The reader of the reference."""
    found: list[Arrival] = []

    def take(sample: zenoh.Sample) -> None:
        found.append(Arrival(int.from_bytes(sample.payload.to_bytes()[:8], "little"), time.time_ns()))

    section = Zenoh(mode="client", listen=[], connect=[f"tcp/127.0.0.1:{port}"])
    with open_session(section) as session, session.declare_subscriber(REFERENCE_KEY, take):
        stolen = watch_host(seconds)
    report(Reading(found, stolen))


def subscribe(port: int, seconds: float) -> None:
    """A reader of states."""
    found: list[Arrival] = []

    def take(message: StateMessage) -> None:
        found.append(Arrival(message.t_ns, time.time_ns(), message.age_ms or 0.0))

    with Client(f"tcp/127.0.0.1:{port}", "bench") as client, client.subscribed(StateMessage, take):
        print("ready", flush=True)
        stolen = watch_host(seconds)
        dropped = client.health().outputs["zenoh"].dropped
    report(Reading(found, stolen, dropped))


def since_due_ms(arrival: Arrival) -> float:
    return (arrival.arrived_ns - arrival.t_ns) / 1e6


def since_sample_ms(arrival: Arrival) -> float:
    return since_due_ms(arrival) + arrival.age_ms


def quantiles(found: list[float]) -> str:
    if len(found) < 2:
        return f"{len(found)} arrivals"
    cuts = statistics.quantiles(found, n=1000)
    values = ", ".join(f"{name} {cuts[at]:.2f}" for name, at in (("p50", 499), ("p90", 899), ("p99", 989), ("p99.9", 998)))
    return f"{values}, max {max(found):.2f} ms ({len(found)} arrivals)"


def turn_wheels(seconds: float) -> None:
    with can.Bus(interface="virtual", channel=CHANNEL) as bus:
        for _ in every(CAN_HZ, seconds):
            bus.send(can.Message(arbitration_id=256, is_extended_id=False, data=bytes(8)))


# --- CPU time


class Meter:
    """CPU time of calls by stage, in the calling thread. A stage inside another one is not counted twice."""

    def __init__(self) -> None:
        self.spent: dict[str, int] = {}
        self._inner = 0

    def watch(self, holder: Any, name: str, stage: str) -> None:
        """Measure a method from now on."""
        inside: Callable[..., Any] = getattr(holder, name)

        def measured(*arguments: Any, **named: Any) -> Any:
            begin, outer, self._inner = time.thread_time_ns(), self._inner, 0
            try:
                return inside(*arguments, **named)
            finally:
                took = time.thread_time_ns() - begin
                self.spent[stage] = self.spent.get(stage, 0) + took - self._inner
                self._inner = outer + took

        setattr(holder, name, measured)


def watch_stages(daemon: Daemon, meter: Meter) -> None:
    """Measure the stages of the estimator's thread."""
    live = daemon.live
    for source in daemon.inputs.values():
        meter.watch(source, "decode", f"decode {source.name}")
        meter.watch(source, "record", "black box")
    meter.watch(live, "record", "black box")
    meter.watch(live.engine.fusion, "feed", "align and fuse")
    meter.watch(live.engine, "message", "predict and make the state message")
    assert live.engine.publication is not None
    meter.watch(live.engine.publication, "health", "health")
    meter.watch(live, "step", "the rest of a step: order, ticks, settled, innovations, hand-over")


def threads_ms() -> dict[str, float]:
    """CPU time of every thread of this process so far, by name."""
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    tick_ms = 1000 / os.sysconf("SC_CLK_TCK")
    found: dict[str, float] = {}
    for task in Path("/proc/self/task").iterdir():
        name, _, rest = (task / "stat").read_text().partition(") ")
        fields = rest.split()
        thread = names.get(int(task.name)) or f"Zenoh's own: {name.split('(', 1)[1]}"
        found[thread] = found.get(thread, 0.0) + (int(fields[11]) + int(fields[12])) * tick_ms
    return found


def set_timer_slack(slack_ns: int) -> None:
    """Set the timer slack of the calling thread and of the threads that it starts."""
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_TIMERSLACK, slack_ns) != 0:
        raise OSError(ctypes.get_errno(), "prctl")


@contextmanager
def process(*arguments: object, module: str = "benchmarks.latency") -> Iterator[subprocess.Popen[str]]:
    """A module in a process of its own, of normal priority, whose output can be read; it is killed at the end."""
    command = ["nice", "-n", str(-os.nice(0)), sys.executable, "-m", module, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as made:
        try:
            yield made
        finally:
            made.kill()


def reference(udp: int, seconds: float) -> Reading:
    """The result of `subscribe_only`."""
    port = free_port(socket.SOCK_STREAM)
    longer = ("--seconds", seconds + 2)
    with process("--publish-only", port, *longer) as publisher, process("--feed", udp, *longer):
        assert publisher.stdout is not None
        publisher.stdout.readline()
        with process("--subscribe-only", port, "--seconds", seconds) as reader:
            return msgspec.json.decode(reader.communicate()[0], type=Reading)


async def measure(folder: Path, seconds: float, *, on_imu: bool) -> tuple[Reading, str]:
    """The subscriber's result, and the daemon's own figures."""
    udp, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    daemon, meter = Daemon(configuration(folder, udp, tcp, on_imu=on_imu)), Meter()
    run = asyncio.create_task(serve(daemon))
    await daemon.up.wait()
    watch_stages(daemon, meter)
    wheels = threading.Thread(target=turn_wheels, args=(seconds + 1,), name="(the benchmark's wheels)")
    with process("--subscribe", tcp, "--seconds", seconds + 1) as reader, process("--feed", udp, "--seconds", seconds + 2):
        assert reader.stdout is not None
        await asyncio.to_thread(reader.stdout.readline)
        wheels.start()
        await asyncio.sleep(1)
        before, begin = threads_ms(), time.monotonic()
        meter.spent.clear()
        await asyncio.sleep(seconds - 1)
        after, took_ms = threads_ms(), (time.monotonic() - begin) * 1000
        result = await asyncio.to_thread(reader.stdout.read)
    health = daemon.health
    await asyncio.to_thread(wheels.join)
    daemon.stop()
    await run
    assert health is not None
    lines = []
    for name, latency in (("receipt to fused", health.latency_ms.fused), ("tick to outputs", health.latency_ms.published)):
        lines.append(f"inside, {name}: {latency}")
    lines.append(f"inside, tick to Zenoh: {health.outputs['zenoh'].latency_ms}")
    spent = {name: ms - before.get(name, 0.0) for name, ms in after.items()}
    lines += ["", f"CPU, in percent of one core: {100 * sum(spent.values()) / took_ms:.1f}"]
    lines += [f"  {100 * ms / took_ms:5.1f}  {name}" for name, ms in sorted(spent.items(), key=lambda item: -item[1])]
    lines += ["of these, in the estimator's thread:"]
    stages = sorted(meter.spent.items(), key=lambda item: -item[1])
    lines += [f"  {100 * ns / 1e6 / took_ms:5.1f}  {stage}" for stage, ns in stages]
    lines += [f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB; {daemon.losses()}"]
    return msgspec.json.decode(result, type=Reading), "\n".join(lines)


def summary(what: str, readings: list[Reading], latency_ms: Callable[[Arrival], float] = since_due_ms) -> str:
    """The latencies of one or several runs, in words."""
    share = statistics.fmean(reading.stolen_share() for reading in readings)
    every_ms = [latency_ms(arrival) for reading in readings for arrival in reading.arrivals]
    calm_ms = [latency_ms(arrival) for reading in readings for arrival in reading.undisturbed()]
    return f"""{what}: {quantiles(every_ms)}
  the host took {100 * share:.1f} % of the processors; while it took nothing: {quantiles(calm_ms)}"""


def whole_summary(states: list[Reading], references: list[Reading]) -> str:
    rows = (
        summary("from the instant of a publication to the subscriber", states),
        summary("from the stamp of its newest IMU sample to the subscriber", states, since_sample_ms),
        summary("reference, a bare Zenoh publisher to its subscriber", references),
    )
    return "\n".join(rows)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.latency", description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--out", type=Path, default=Path("out/latency"))
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--as-installed", action="store_true", help=f"nice {NICE}, as the unit has it; needs a privilege")
    parser.add_argument("--by-clock", action="store_true", help="a publication does not wait for an inertial sample")
    parser.add_argument("--feed", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--subscribe", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--publish-only", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--subscribe-only", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.feed or options.subscribe or options.publish_only or options.subscribe_only:
        set_timer_slack(USUAL_SLACK_NS)
    if options.feed:
        feed(options.feed, options.seconds)
    elif options.subscribe:
        subscribe(options.subscribe, options.seconds)
    elif options.publish_only:
        publish_only(options.publish_only, options.seconds)
    elif options.subscribe_only:
        subscribe_only(options.subscribe_only, options.seconds)
    else:
        options.out.mkdir(parents=True, exist_ok=True)
        nice = os.nice(NICE if options.as_installed else 0)
        if options.as_installed:
            set_timer_slack(TIMER_SLACK_NS)
        way = "by the clock" if options.by_clock else "on inertial samples"
        python, cpus = platform.python_version(), os.cpu_count()
        print(f"fusiond {__version__}, Python {python}, {cpus} CPUs, nice {nice}, {options.seconds:g} s, {way}", flush=True)
        states, references = [], []
        for number in range(options.runs):
            reading, figures = asyncio.run(measure(options.out, options.seconds, on_imu=not options.by_clock))
            states.append(reading)
            references.append(reference(free_port(socket.SOCK_DGRAM), options.seconds))
            print(f"run {number + 1}: {len(reading.arrivals)} states, {reading.dropped} dropped on the way to Zenoh")
            print(whole_summary([reading], references[-1:]))
            print(figures, flush=True)
        print(f"\nall {options.runs} runs")
        print(whole_summary(states, references))


if __name__ == "__main__":
    main(sys.argv[1:])
