"""The parts shared by the checks: the service on its drive, its reader, and its status in systemd."""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reader import SECOND, Reader, Truth
from vehicle import Vehicle

DEADLINE_S = 20.0  # for anything awaited that has no deadline of its own
SANE_M = 5.0  # a state that lies farther from the truth is wrong
PUBLISHING_S = 3.0  # a killed service is back, and publishing, within this
LIBRARIES = "import asyncio, can, cantools, numpy, pymavlink.dialects.v20.common, zenoh"
STEADY_GAP_S = 1.0  # others never fall silent for longer (to delete an interface alone stops the guest for 0.5 s)
URGENT = -10  # the vehicle's niceness, above the service's: a real one does not wait for it; what the checks call is at 0
UNIT = "fusiond.service"
INTERFACE, BOX = "vcan0", Path("/var/lib/fusiond/box")


class Failed(Exception):
    """A check failed; the message says why."""


def call(*command: str, check: bool = True) -> str:
    """The output of a command. Raises Failed."""
    done = subprocess.run(("nice", "-n", str(-URGENT), *command), capture_output=True, text=True, check=False, timeout=120)
    if check and done.returncode:
        raise Failed(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()}")
    return done.stdout


def wait(what: str, condition: Callable[[], bool], timeout_s: float = DEADLINE_S, look_s: float = 0.01) -> float:
    """Wait until a condition holds; returns the time it took [s]. Raises Failed."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > timeout_s:
            raise Failed(f"not within {timeout_s:g} s: {what}")
        time.sleep(look_s)
    return time.monotonic() - began


def is_gone(pid: int) -> bool:
    """Whether a process has ended, reaped or not."""
    try:
        return re.search(r"^State:\s+[ZX]", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE) is not None
    except (FileNotFoundError, ProcessLookupError):
        return True


def libraries_s() -> float:
    """Time that this machine takes to import the service's libraries: a measure of its speed."""
    began = time.monotonic()
    call(sys.executable, "-c", LIBRARIES)
    return time.monotonic() - began


@dataclass
class Bench:
    """A running service, the vehicle that it listens to, and a reader of its states."""

    vehicle: Vehicle
    reader: Reader
    truth: Truth
    unit: str = UNIT
    libraries_s: float = 0.0

    def show(self, name: str) -> str:
        """A property of the unit."""
        return call("systemctl", "show", "--property", name, "--value", self.unit).strip()

    @property
    def pid(self) -> int:
        return int(self.show("MainPID"))

    @property
    def restarts(self) -> int:
        return int(self.show("NRestarts"))

    def rss_mb(self) -> float:
        """Memory of the service's process."""
        pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def journal(self, since: float) -> str:
        """The service's log since an instant of the monotonic clock."""
        lines = call("journalctl", "--unit", self.unit, "--output", "short-monotonic", "--no-pager", "--boot")
        stamped = ((re.match(r"\[\s*([\d.]+)\]", line), line) for line in lines.splitlines())
        return "\n".join(line for stamp, line in stamped if stamp and float(stamp[1]) >= since)

    def error_m(self, message: dict[str, Any]) -> float | None:
        """Distance of a state from the vehicle at its instant [m]; instants count from the wall clock at the start."""
        return self.truth.error_m(message["t_ns"] - self.vehicle.start_unix_ns + self.vehicle.begin_ns, message)

    def is_sane(self, message: dict[str, Any]) -> bool:
        """Nominal, and near where the vehicle is now."""
        error = self.error_m(message)
        return message["mode"] == "nominal" and error is not None and error < SANE_M

    def errors(self, since_ns: int, until_ns: int) -> list[float]:
        """The errors of the states that came between two instants [m]. Raises Failed if there are none."""
        arrivals = self.reader.since(since_ns, until_ns)
        found = [self.error_m(arrival.decoded()) for arrival in arrivals[:: max(1, len(arrivals) // 200)]]
        errors = [error for error in found if error is not None]
        if not errors:
            raise Failed(f"no state among {len(arrivals)} messages")
        return errors

    def fused_hz(self, seconds: float = 1.0) -> float:
        """Measurements fused per second, by the latest states."""
        arrivals = self.reader.since(time.monotonic_ns() - round(seconds * SECOND))
        if len(arrivals) < 2:
            return 0.0
        fused = arrivals[-1].decoded()["outcomes"]["fused"] - arrivals[0].decoded()["outcomes"]["fused"]
        return float(fused * SECOND / (arrivals[-1].t_ns - arrivals[0].t_ns))

    def steady(self, since_ns: int, restarts: int, max_m: float = SANE_M) -> str:
        """Check that since an instant nothing restarted, states came without a gap with errors below `max_m`, and that they
        are right now. Returns the figures."""
        first = self.reader.first(time.monotonic_ns(), self.is_sane, DEADLINE_S)
        if first is None:
            raise Failed(f"no sane state within {DEADLINE_S:g} s; {self.describe()}")
        now = time.monotonic_ns()
        gap, errors = self.reader.longest_gap(since_ns, now), self.errors(since_ns, now)
        if self.restarts != restarts:
            raise Failed(f"{self.restarts - restarts} restart(s); {self.describe()}")
        if gap > STEADY_GAP_S:
            raise Failed(f"silent for {gap:.2f} s")
        if max(errors) > max_m:
            raise Failed(f"{max(errors):.1f} m off")
        return f"longest gap {1000 * gap:.0f} ms, error median {statistics.median(errors):.2f} m, most {max(errors):.2f} m"

    def fused(self) -> int:
        """Measurements fused since the service's start, by the latest state."""
        return int(self.reader.arrivals[-1].decoded()["outcomes"]["fused"])

    def back(self, killed_ns: int, fused: int) -> str:
        """Check that a killed service publishes again soon, and that its states are right. Returns the figures."""
        again = self.reader.first(killed_ns, lambda message: message["outcomes"]["fused"] < fused, DEADLINE_S)
        if again is None:
            raise Failed(f"nothing published within {DEADLINE_S:g} s; {self.describe()}")
        sane = self.reader.first(again.t_ns, self.is_sane, DEADLINE_S)
        if sane is None:
            raise Failed(f"no sane state within {DEADLINE_S:g} s; {self.describe()}")
        publishing, nominal = (again.t_ns - killed_ns) / SECOND, (sane.t_ns - killed_ns) / SECOND
        found = f"publishing after {publishing:.2f} s, where its libraries take {self.libraries_s:.2f} s"
        if publishing > PUBLISHING_S:
            raise Failed(found)
        return f"{found}, nominal after {nominal:.2f} s"

    def describe(self) -> str:
        """Details for the report of a failure."""
        last = self.reader.arrivals[-1].decoded() if self.reader.arrivals else {}
        error = self.error_m(last) if last else None
        return f"status {self.show('StatusText')!r}, last mode {last.get('mode')}, error {error}, fault {last.get('fault')}"
