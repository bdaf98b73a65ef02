"""The checks, where they run: as root under systemd with vcan. Installs the package, runs the service through its faults.

    /opt/fusiond/bin/python checks.py FOLDER     with drive/, perhaps rav4/, and NAME.deb in FOLDER

Writes FOLDER/out/checks.json; the exit status is 1 where a check failed.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bench import BOX, DEADLINE_S, INTERFACE, SECOND, UNIT, URGENT, Bench, Failed, call, libraries_s, wait
from faults import FAULTS
from reader import Truth, reading
from vehicle import Vehicle

if TYPE_CHECKING:
    from fusiond.messages.types import StateMessage

ETC = Path("/etc/fusiond")
PORT, ENDPOINT = 14550, "tcp/127.0.0.1:7447"
EXPOSURE = 1.9  # the most that systemd may find
LIMITS = {"MemoryMax": "536870912", "TasksMax": "256", "LimitNOFILE": "1024"}  # of the running service
TRACE_RMSE_M = 1.0  # of the captured trace: 0.31 m replayed
READY_S = 15.0
MISSING_SHARE = 0.02  # of the states: a reader that is slow on a slow machine
STOOD_STILL_S = 1.0  # a machine that stopped for this long says nothing about the service


class Check(NamedTuple):
    """One line of the table."""

    name: str
    passed: bool
    found: str


class Checks:
    """Runs checks and keeps their results."""

    def __init__(self) -> None:
        self.done: list[Check] = []

    def run(self, name: str, check: Callable[[], str]) -> bool:
        """Run one check. Any exception in it is its failure."""
        try:
            self.done.append(Check(name, True, check()))
        except (Failed, OSError, subprocess.SubprocessError, ValueError, LookupError) as error:
            self.done.append(Check(name, False, str(error) or repr(error)))
        last = self.done[-1]
        print(f"{'ok    ' if last.passed else 'FAILED'} {name}: {last.found}", flush=True)
        return last.passed


def installed() -> str:
    """The files are in place, and the units are valid."""
    version = call("/usr/bin/fusiond", "--version").strip()
    call("id", "fusiond")
    complaints = subprocess.run(
        ["systemd-analyze", "verify", "fusiond.service", "fusiond@car.service"], capture_output=True, text=True, check=False
    )
    if complaints.returncode or "fusiond" in complaints.stderr:
        raise Failed(f"systemd-analyze verify: {complaints.stderr.strip()}")
    exposures = []
    for unit in ("fusiond.service", "fusiond@.service"):
        out = call("systemd-analyze", "security", "--offline=true", f"/usr/lib/systemd/system/{unit}")
        found = re.search(r"Overall exposure level for .*: ([\d.]+)", out)
        exposures.append(float(found[1]) if found else 10.0)
    if max(exposures) > EXPOSURE:
        raise Failed(f"exposure {exposures}")
    return f"{version}, exposure {' and '.join(map(str, exposures))}"


def adapt(text: str, channel: str, box: Path, file_mb: float) -> str:
    """A configuration for this machine: the CAN interface, the black box, 100 states a second."""
    text = re.sub(r"^(interface|channel|rate_hz|encoding|listen|connection) = .*\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(\[can\.\w+\])", rf'\1\ninterface = "socketcan"\nchannel = "{channel}"', text, flags=re.MULTILINE)
    text = re.sub(r"^(\[mavlink\.\w+\])", rf'\1\nconnection = "udpin:127.0.0.1:{PORT}"', text, flags=re.MULTILINE)
    text = re.sub(r"^\[(publish|zenoh)\].*\n", "", text, flags=re.MULTILINE)
    record = f'[record]\nfolder = "{box}"\nfile_mb = {file_mb}\ntotal_mb = {3 * file_mb}\n'
    return f"{text}\n[publish]\nrate_hz = 100.0\n\n{record}"


def make_interface(name: str) -> None:
    """A virtual CAN interface, up."""
    call("ip", "link", "add", "dev", name, "type", "vcan")
    call("ip", "link", "set", name, "up")


def start(unit: str) -> float:
    """Start a unit; returns the time until it is ready [s]. Raises Failed."""
    began = time.monotonic()
    call("systemctl", "start", unit)
    seconds = time.monotonic() - began
    if seconds > READY_S:
        raise Failed(f"ready only after {seconds:.1f} s")
    return seconds


def trace(folder: Path) -> str:
    """A captured drive through fusiond@rav4: its accuracy; and its black box, replayed, publishes the same bytes."""
    unit, box = "fusiond@rav4.service", Path("/var/lib/fusiond/rav4/box")
    text = adapt((folder / "rav4.toml").read_text(), "can0", box, 64.0)
    (ETC / "rav4.toml").write_text(text)
    (ETC / "rav4.dbc").write_bytes((folder / "rav4.dbc").read_bytes())
    make_interface("can0")
    ready_s = start(unit)
    vehicle = Vehicle(folder, "drive.tlog", "drive.candump.log", "can0", PORT)
    with reading("rav4", ENDPOINT) as reader:
        bench = Bench(vehicle, reader, Truth(folder / "truth.csv"), unit)
        wait("the reader is connected", reader.is_connected)
        began = time.monotonic_ns()
        vehicle.start()
        vehicle.join(60.0)
        errors = bench.errors(began + 10 * SECOND, time.monotonic_ns())
        call("systemctl", "stop", unit)
        payloads = [arrival.payload for arrival in reader.arrivals]
    rmse = statistics.fmean(error**2 for error in errors) ** 0.5
    if rmse > TRACE_RMSE_M:
        raise Failed(f"{rmse:.2f} m RMSE, most {max(errors):.1f} m")
    same = replayed_identically(ETC / "rav4.toml", box, payloads)
    return (f"ready after {ready_s:.1f} s, {rmse:.2f} m RMSE, replay of the box: {same}; "
            f"player late by {vehicle.late_ns / 1e6:.0f} ms at most")


def replayed_identically(file: Path, box: Path, payloads: list[bytes]) -> str:
    """The number of states of a replay of the black box that are, byte for byte, those received live, and of those that
    Zenoh dropped. Raises Failed."""
    from fusiond.app.replay.replay import Replay, ReplayTask  # noqa: PLC0415
    from fusiond.config import load as config  # noqa: PLC0415 - installed by the check before
    from fusiond.messages.codec import encode  # noqa: PLC0415
    from fusiond_adapters.logs.merge import open_logs  # noqa: PLC0415

    settings = config.load(file)
    again: dict[int, bytes] = {}

    def keep(message: StateMessage, _: object) -> None:
        again[message.t_ns] = encode(message, "json")

    logs = [str(path) for path in sorted(box.glob("*log"))]
    Replay(settings, ReplayTask(settings.publish.rate_hz, on_tick=[keep])).run(open_logs(logs, settings))
    live = {int(json.loads(payload)["t_ns"]): payload for payload in payloads}
    both = again.keys() & live.keys()
    other = sum(again[t_ns] != live[t_ns] for t_ns in both)
    missing = len(again) - len(both)
    if other or missing > MISSING_SHARE * len(again) or len(again) < 1000:
        raise Failed(f"of {len(again)} states replayed {other} are not as received live, {missing} were not received")
    return f"{len(both)} states as received live, byte for byte, {missing} dropped on their way"


def limited(bench: Bench) -> str:
    """The running service has its limits, and is far from them."""
    found = {name: bench.show(name) for name in LIMITS}
    if found != LIMITS:
        raise Failed(f"limits {found}")
    files, threads = (len(list(Path(f"/proc/{bench.pid}/{name}").iterdir())) for name in ("fd", "task"))
    if max(4 * bench.rss_mb() / 512, 4 * threads / 256, 4 * files / 1024) > 1:
        raise Failed(f"over a quarter of a limit: {bench.rss_mb():.0f} MB, {threads} threads, {files} files")
    return f"{bench.rss_mb():.0f} MB of 512 MiB, {threads} threads of 256, {files} files of 1024"


def journal_fields(unit: str) -> str:
    """The service's log is structured."""
    lines = call("journalctl", "--unit", unit, "--output", "json", "--no-pager", "--boot").splitlines()
    entries: list[dict[str, Any]] = [json.loads(line) for line in lines]
    for name in ("FUSIOND_SOURCE", "FUSIOND_MODE", "CODE_FUNC", "MESSAGE_ID"):
        if not any(name in entry for entry in entries):
            raise Failed(f"no entry of {len(entries)} has {name}")
    return f"{len(entries)} entries, FUSIOND_SOURCE, FUSIOND_MODE, CODE_*, MESSAGE_ID found"


def removed() -> str:
    """Removing the package leaves only configuration and recordings."""
    call("dpkg", "--remove", "fusiond")
    left = [path for path in ("/opt/fusiond", "/usr/bin/fusiond", "/usr/share/fusiond") if Path(path).exists()]
    left += call("systemctl", "list-unit-files", "--no-legend", "fusiond*", check=False).split()
    if left or not (ETC / "fusiond.toml").is_file():
        raise Failed(f"left: {left or 'not even the configuration'}")
    return "nothing left but /etc/fusiond and /var/lib/fusiond"


def prepare(folder: Path) -> None:
    """Configuration and a small disk for the state folder."""
    text = (folder / "fusiond.toml").read_text()
    (ETC / "fusiond.toml").write_text(adapt(text, INTERFACE, BOX, 1.0))
    (ETC / "wheels.dbc").write_bytes((folder / "wheels.dbc").read_bytes())
    user = call("id", "-u", "fusiond").strip()
    call("mount", "-t", "tmpfs", "-o", f"size=6m,mode=0750,uid={user}", "tmpfs", str(BOX.parent))
    make_interface(INTERFACE)


def tried(fault: Callable[[Bench], str], bench: Bench) -> str:
    """Try a fault; once more if it failed while the machine itself stopped, by the delay of the vehicle."""
    bench.vehicle.late_ns = 0
    try:
        return fault(bench)
    except Failed as failed:
        stood_s = bench.vehicle.late_ns / SECOND
        if stood_s < STOOD_STILL_S:
            raise
        return f"{fault(bench)} (at the second try; before, while the machine stood still for {stood_s:.1f} s: {failed})"


def keep_box(folder: Path) -> None:
    """Keep the black box and its configuration, to replay a failure."""
    with contextlib.suppress(OSError):  # a box that is away, or turns over, must not end the checks
        for file in (ETC / "fusiond.toml", ETC / "wheels.dbc", *sorted(BOX.iterdir())):
            folder.mkdir(exist_ok=True)
            shutil.copy2(file, folder)


def run_through(checks: Checks, folder: Path) -> None:
    """The service on its drive, and then every fault."""
    prepare(folder)
    vehicle = Vehicle(folder, "drive.tlog", "drive.log", INTERFACE, PORT, counted_id=0x1D0)
    with reading("bench", ENDPOINT) as reader:
        bench = Bench(vehicle, reader, Truth(folder / "truth.csv"), libraries_s=libraries_s())

        def begin() -> str:
            ready_s = start(UNIT)
            vehicle.start()
            began = time.monotonic_ns()
            first = reader.first(began, bench.is_sane, DEADLINE_S)
            if first is None:
                raise Failed(f"no sane state within {DEADLINE_S:g} s; {bench.describe()}")
            nominal_s = (first.t_ns - began) / SECOND
            wait("wheels are fused", lambda: bench.fused_hz() > 250.0)
            began = time.monotonic_ns()
            wait("three seconds pass", lambda: time.monotonic_ns() > began + 3 * SECOND)
            return f"ready after {ready_s:.1f} s, nominal after {nominal_s:.1f} s; {bench.steady(began, 0)}"

        if checks.run("states over Zenoh", begin):
            checks.run("limits of the unit", lambda: limited(bench))
            for name, fault in FAULTS:
                if not checks.run(name, lambda fault=fault: tried(fault, bench)):  # type: ignore[misc]
                    keep_box(folder.parent / "out" / re.sub(r"\W+", "-", name))
            vehicle.end()
    checks.run("journal", lambda: journal_fields(UNIT))


def main(folder: Path) -> int:
    """All checks."""
    checks = Checks()
    os.nice(URGENT)
    ETC.mkdir(exist_ok=True)
    if checks.run("installed, units sound", installed):
        if (folder / "rav4").is_dir():
            checks.run("captured trace, black box", lambda: trace(folder / "rav4"))
        run_through(checks, folder / "drive")
        checks.run("package removed", removed)
    out = folder / "out"
    (out / "journal.txt").write_text(call("journalctl", "--no-pager", "--output", "short-precise"))
    (out / "checks.json").write_text(json.dumps([check._asdict() for check in checks.done], indent=1))
    return int(not all(check.passed for check in checks.done))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
