"""`make bench`: the cost of the filter, as medians and as ratios to a named reference measured in the same run.

    python -m benchmarks.run [--minutes M] [--repeats N] [--out FOLDER]

All times are CPU time of the process, which other work on the machine disturbs little. The log is simulated once
for the given length (default 60 minutes, seed in the output) and kept in the folder.
"""

from __future__ import annotations

import argparse
import math
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from fusiond import __version__
from fusiond.app.diagnosis.finding import NO_STATE
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.filter.kernel.interpreted import Kernel, make_kernel
from fusiond.filter.rows import ROW, Outcome
from fusiond.filter.state import NEVER, T_LAST, FilterState, T
from fusiond.simulation.scenario import parse
from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.logs.write import write_drive

SEED = 11
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
WHEEL_HZ, GNSS_HZ = 100, 10
T0 = 1_700_000_000 * SECOND
FORCE_B, RATE_B = np.array([0.1, 0.2, -9.8]), np.array([0.001, 0.002, 0.003])
LATITUDE, LONGITUDE, HEIGHT = 0.84, 0.2, 500.0  # rad, rad, m: where the vehicle of the rewinds stands
SHORTEST_S = 5.0  # of a simulated drive
COURSE = [  # one round of the simulated course: duration [s], speed at its end [m/s], turn [deg]
    (10, 0, 0), (10, 12, 0), (15, 12, 90), (20, 18, 0), (20, 18, -90),
    (15, 9, 60), (10, 0, 0), (10, 0, 0), (20, 15, 0), (20, 0, -60),
]  # fmt: skip

# The memory is Linux's high-water mark: ru_maxrss of a child starts at the value of its parent.
PRINT_USAGE = """
import atexit, resource
def print_usage():
    used = resource.getrusage(resource.RUSAGE_SELF)
    with open("/proc/self/status") as status:
        peak_kb = next(line.split()[1] for line in status if line.startswith("VmHWM"))
    print("USED", used.ru_utime + used.ru_stime, peak_kb)
atexit.register(print_usage)
"""
READ_MAVLINK = """
import os, sys
os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil
log = mavutil.mavlink_connection(sys.argv[1], dialect="common")
while log.recv_msg() is not None:
    pass
"""
READ_CAN = """
import can, sys
for message in can.LogReader(sys.argv[1]):
    pass
"""


class Line(NamedTuple):
    what: str
    median: str
    reference: str
    ratio: str
    wanted: str = ""


def median_us(function: Callable[[], object], repeats: int, number: int) -> float:
    """Median over `repeats` of the mean CPU time [us] of `number` calls."""
    times = []
    for _ in range(repeats):
        begin = time.process_time_ns()
        for _ in range(number):
            function()
        times.append((time.process_time_ns() - begin) / number / 1000)
    return statistics.median(times)


# --- The kernel


def config(**filter_keys: float) -> Config:
    wheel = {"bus": "bus", "message": "m", "signal": "s", "unsigned": False, "correlation_s": 0.1}
    raw = {
        "filter": {"heading_deg": 0.0, **filter_keys},
        "motion": {"standstill": False},
        "mavlink": {"link": {}},
        "can": {"bus": {}},
        "imu": {"imu0": {"link": "link"}},
        "gnss": {"gps0": {"link": "link", "position_correlation_s": 0.5, "lever_arm_m": (0.3, 0.1, -1.0)}},
        "wheel": {name: wheel | {"position_m": (1.0, 0.5, 0.5), "steered": "front" in name} for name in WHEELS},
    }
    return msgspec.convert(raw, Config)


def event(t_ns: int, source: str, sequence: int) -> Measurement:
    if source == "imu0":
        return Measurement(t_ns, source, sequence, t_ns, ImuSample((0.0, 0.0, -9.809), (0.0, 0.0, 0.0)))
    if source == "gps0.position":
        return Measurement(t_ns, source, sequence, t_ns, GnssPosition(LATITUDE, LONGITUDE, HEIGHT))
    if source == "gps0.velocity":
        return Measurement(t_ns, source, sequence, t_ns, GnssVelocity(0.01, 0.0, None))
    return Measurement(t_ns, source, sequence, t_ns, WheelSpeed(0.01))


def running(imu_hz: int, seconds: float, compiled: bool = True, **filter_keys: float) -> tuple[Fusion, int]:
    """A filter that ran for some seconds on an IMU, four wheels at 100 Hz and a receiver at 10 Hz, and the instant that it
    has reached. The receiver ends a second before the end."""

    def instants(rate_hz: int, first_ms: int, until_s: float) -> list[int]:
        count = math.ceil((until_s - first_ms / 1000) * rate_hz)
        return [T0 + first_ms * MILLISECOND + k * SECOND // rate_hz for k in range(count)]

    streams = {"imu0": instants(imu_hz, 0, seconds)}
    streams |= {wheel: instants(WHEEL_HZ, 3, seconds) for wheel in WHEELS}
    streams |= {f"gps0.{kind}": instants(GNSS_HZ, 7, seconds - 1) for kind in ("position", "velocity")}
    events = [event(t_ns, source, k) for source, stamps in streams.items() for k, t_ns in enumerate(stamps)]
    fusion = Fusion(config(**filter_keys), compiled)
    for measurement in sorted(events, key=lambda event: event.t_ns):
        fusion.fuse(measurement)
    return fusion, fusion.history.applied_ns


def one_row(kernel: Kernel, head: FilterState, fusion: Fusion, source: str) -> Callable[[], object]:
    """A call that fuses one measurement of a source at the head's own instant."""
    table, index = np.zeros(1, dtype=ROW), fusion.history.index[source]
    values = fusion._values(event(int(head.stamps[T]), source, 0))
    table[0]["t_ns"], table[0]["source"] = head.stamps[T], index
    table[0]["values"][: len(values)] = values
    kept = np.zeros((2, len(head.numbers))), np.zeros((2, len(head.whole)), dtype=np.int64), np.zeros(2, dtype=np.int64)
    kept[1][:] = head.whole
    kernel.attach(head, table, np.zeros((len(fusion.params.sources), len(Outcome)), dtype=np.int64), *kept)
    now = int(head.stamps[T])

    def run() -> None:
        head.source_stamps[index, T_LAST] = NEVER
        kernel.run(0, 1, 0, now, 1)

    return run


def kernel_lines(repeats: int) -> tuple[list[Line], Callable[[], object]]:
    """The kernel against its twin, and one propagation called from Python, which is the reference of the rewinds."""
    fusion, _ = running(200, 3.0)
    fast, twin = make_kernel(fusion.params, True), make_kernel(fusion.params, False)
    head = fusion.history.head
    state, other = head.copy(), head.copy()

    def predict() -> None:
        fast.propagate(state, 0.005, FORCE_B, RATE_B)

    unit = median_us(predict, repeats, 2000)
    slow = median_us(lambda: twin.propagate(other, 0.005, FORCE_B, RATE_B), repeats, 100)
    lines = [
        Line(
            "predict: one propagation of 5 ms",
            f"{unit:.2f} us",
            f"NumPy twin {slow:.0f} us",
            f"{slow / unit:.0f} x",
            ">= 40 x",
        )
    ]
    for source in ("gps0.position", "gps0.velocity", "front_left", "rear_left"):
        times = []
        for kernel, number in ((fast, 2000), (twin, 100)):
            times.append(median_us(one_row(kernel, head.copy(), fusion, source), repeats, number))
        name = {"front_left": "steered wheel", "rear_left": "wheel"}.get(source, source.replace("gps0.", "GNSS "))
        lines.append(
            Line(f"update: {name}", f"{times[0]:.2f} us", f"NumPy twin {times[1]:.0f} us", f"{times[1] / times[0]:.0f} x")
        )
    return lines, predict


# --- Rewinds


def rewind_lines(predict: Callable[[], object], repeats: int) -> list[Line]:
    """A late fix, as a whole: insert it, restore a snapshot, run everything after it again, take snapshots. The reference is
    measured alongside, so that the same disturbances affect both."""
    lines = []
    for imu_hz in (200, 400):
        for late_ms in (50, 100, 200, 500, 900):
            rows, times, units = [], [], []
            for _ in range(repeats):
                fusion, now = running(imu_hz, 3.0, horizon_s=1.0)
                for i in range(5):  # several at about one instant: each adds one event to the rewinds after it
                    late = event(now - late_ms * MILLISECOND + i, "gps0.position", 10**6 + i)
                    before, begin = fusion.history.rerun, time.process_time_ns()
                    fusion.fuse(late)
                    fusion.history.apply_rows()
                    times.append((time.process_time_ns() - begin) / 1000)
                    rows.append(fusion.history.rerun - before)
                    units.append(median_us(predict, 1, 200))
            cost, events, unit = statistics.median(times), statistics.median(rows), statistics.median(units)
            wanted = "<= 100 x" if (imu_hz, late_ms) == (200, 200) else ""
            what = f"fix {late_ms} ms late, IMU {imu_hz} Hz, 4 wheels at 100 Hz: {events:.0f} events"
            lines.append(Line(what, f"{cost:.0f} us", f"one predict {unit:.2f} us", f"{cost / unit:.0f} x", wanted))
            if (imu_hz, late_ms) == (200, 900):
                each = cost / events
                lines.append(
                    Line(
                        "one event of that rewind",
                        f"{each:.2f} us",
                        f"one predict {unit:.2f} us",
                        f"{each / unit:.2f} x",
                        "<= 1 x",
                    )
                )
    return lines


# --- Whole logs


def make_log(minutes: float, folder: Path) -> Path:
    """A simulated drive, with as much traffic as in a car: IMU at 200 Hz, GNSS at 10 Hz and 120 ms late, the other messages
    that PX4 sends to an onboard computer, and one CAN frame with four wheels at 100 Hz among 1500 frames a second."""
    target = folder / f"drive-{minutes:g}min-{SEED}"
    if (target / "fusiond.toml").is_file():
        return target
    segments, left = "", minutes * 60
    for duration, speed, turn in cycle(COURSE):
        if left < SHORTEST_S:
            break
        lasts = min(duration, left)
        segments += f"[[segment]]\nduration_s = {lasts}\nspeed_mps = {speed}\nturn_deg = {turn}\n"
        left -= lasts
    sensors = (
        "[autopilot]\ntelemetry = true\n[imu]\nrate_hz = 200.0\n[gnss]\nrate_hz = 10.0\ndelay_ms = 120.0\n"
        "[wheels]\nrate_hz = 100.0\ntraffic_hz = 1400.0\n"
    )
    text = f"seed = {SEED}\n{sensors}{segments}"
    target.mkdir(parents=True, exist_ok=True)
    write_drive(parse(text), target)
    return target


def run_python(*arguments: str) -> tuple[float, float]:
    """CPU time [s] and peak memory [MB] of a Python process: `-c CODE ...` or `MODULE ...`."""
    code = "import resource, runpy, sys; sys.argv = sys.argv[1:]; "
    if arguments[0] == "-c":
        code += arguments[1]
        rest = ["-", *arguments[2:]]
    else:
        code += f"runpy.run_module({arguments[0]!r}, run_name='__main__', alter_sys=True)"
        rest = list(arguments)
    wrapped = f"{PRINT_USAGE}\n{code}"
    done = subprocess.run([sys.executable, "-c", wrapped, *rest], check=False, capture_output=True, text=True)
    if done.returncode not in (0, NO_STATE):  # a short drive may end before it has a state
        raise subprocess.CalledProcessError(done.returncode, done.args, done.stdout, done.stderr)
    _, seconds, peak = next(line for line in reversed(done.stdout.splitlines()) if line.startswith("USED")).split()
    return float(seconds), int(peak) / 1024


def log_lines(minutes: float, repeats: int, folder: Path) -> list[Line]:
    """Replay of a whole log against only reading it, and the peak memory for a short and the long log."""
    long, short = make_log(minutes, folder), make_log(max(SHORTEST_S / 60, minutes / 12), folder)
    tlog, candump = logs = [str(long / "drive.tlog"), str(long / "drive.log")]
    used = []  # reading MAVLink [s] and CAN [s], replay [s] and its peak memory [MB]
    for _ in range(repeats):
        mavlink, _ = run_python("-c", READ_MAVLINK, tlog)
        can, _ = run_python("-c", READ_CAN, candump)
        used.append((mavlink, can, *run_python("fusiond", "replay", "--config", str(long / "fusiond.toml"), *logs)))
    mavlink, can, mine, peak = (statistics.median(column) for column in zip(*used, strict=True))
    theirs = statistics.median(each[0] + each[1] for each in used)
    ratio = statistics.median(each[2] / (each[0] + each[1]) for each in used)
    logs = [str(short / "drive.tlog"), str(short / "drive.log")]
    _, short_peak = run_python("fusiond", "replay", "--config", str(short / "fusiond.toml"), *logs)
    with (long / "drive.log").open("rb") as file:
        frames = sum(1 for _ in file)
    size = sum((long / name).stat().st_size for name in ("drive.tlog", "drive.log")) / 1e6
    return [
        Line(
            f"replay of {minutes:g} min ({size:.0f} MB; {frames / minutes / 60:.0f} CAN frames a second)",
            f"{mine:.1f} s",
            f"only reading it: pymavlink {mavlink:.1f} s, python-can {can:.1f} s, both {theirs:.1f} s",
            f"{ratio:.2f} x",
            "<= 0.5 x",
        ),
        Line(
            "  the same, faster than real time",
            f"{mine:.1f} s",
            f"the drive {minutes * 60:.0f} s",
            f"{minutes * 60 / mine:.0f} x",
        ),
        Line(
            "peak memory of that replay",
            f"{peak:.0f} MB",
            f"of a twelfth of it {short_peak:.0f} MB",
            f"{peak / short_peak:.2f} x",
            "flat",
        ),
    ]


def start_lines(repeats: int) -> list[Line]:
    """Start-up: a Python process that does nothing is the reference."""
    bare = statistics.median(run_python("-c", "pass")[0] for _ in range(repeats))
    lines = []
    for what, code in (
        ("import the core (fusiond.estimator.fusion)", "import fusiond.estimator.fusion"),
        ("import all of replay", "import fusiond.app.replay.job"),
        ("fusiond --version", "import fusiond.__main__ as m\ntry: m.main(['--version'])\nexcept SystemExit: pass"),
    ):
        seconds = statistics.median(run_python("-c", code)[0] for _ in range(repeats))
        lines.append(Line(what, f"{seconds * 1000:.0f} ms", f"bare Python {bare * 1000:.0f} ms", f"{seconds / bare:.1f} x"))
    return lines


def table(lines: list[Line]) -> str:
    rows = [("what", "median", "reference, same run", "ratio", "wanted"), ("---",) * 5, *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the simulated log")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    lines, predict = kernel_lines(options.repeats)
    lines += rewind_lines(predict, options.repeats)
    lines += start_lines(options.repeats)
    lines += log_lines(options.minutes, max(1, options.repeats // 2), options.out)
    versions = f"CPU times, medians; fusiond {__version__}, Python {platform.python_version()}, NumPy {np.__version__}"
    about = f"{versions}, {platform.machine()}, seed {SEED}"
    report = f"{about}\n\n{table(lines)}\n"
    print(report)
    (options.out / "report.md").write_text(report)


if __name__ == "__main__":
    main(sys.argv[1:])
