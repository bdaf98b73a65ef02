"""Every fault that the service must survive: one function each, which returns its figures."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from itertools import pairwise

from bench import BOX, DEADLINE_S, INTERFACE, SECOND, Bench, Failed, call, is_gone, wait

WITHOUT_WHEELS_HZ = 200.0  # fused, of 100 from the IMU, 20 from GNSS and constraints on top; with wheels 200 more
MANY = 10  # times the usual load
SETTLED_S = 8.0  # after a reboot: it takes three, and then the heading has to be found
WITHOUT_IMU_M = 30.0  # a state that coasted through a bend may be so far off until then


def kill(bench: Bench) -> str:
    """SIGKILL."""
    pid, restarts, fused = bench.pid, bench.restarts, bench.fused()
    os.kill(pid, signal.SIGKILL)
    found = bench.back(time.monotonic_ns(), fused)
    _once(bench, restarts)
    return found


def hang(bench: Bench) -> str:
    """SIGSTOP: the watchdog detects it."""
    pid, restarts, fused = bench.pid, bench.restarts, bench.fused()
    os.kill(pid, signal.SIGSTOP)
    noticed_s = wait("the watchdog ends it", lambda: is_gone(pid))
    found = bench.back(time.monotonic_ns(), fused)
    _once(bench, restarts)
    return f"killed after {noticed_s:.1f} s; {found}"


def _once(bench: Bench, restarts: int) -> None:
    if bench.restarts != restarts + 1:
        raise Failed(f"{bench.restarts - restarts} restarts in place of one")


def interface_down(bench: Bench) -> str:
    """The CAN interface goes down, and comes up again."""
    began, restarts = time.monotonic_ns(), bench.restarts
    call("ip", "link", "set", INTERFACE, "down")
    wait("the wheels are missed", lambda: bench.fused_hz() < WITHOUT_WHEELS_HZ)
    call("ip", "link", "set", INTERFACE, "up")
    return _wheels_back(bench, began, restarts)


def interface_deleted(bench: Bench) -> str:
    """The CAN interface is deleted, and created again."""
    began, restarts = time.monotonic_ns(), bench.restarts
    call("ip", "link", "delete", INTERFACE)
    wait("the wheels are missed", lambda: bench.fused_hz() < WITHOUT_WHEELS_HZ)
    call("ip", "link", "add", "dev", INTERFACE, "type", "vcan")
    call("ip", "link", "set", INTERFACE, "up")
    return _wheels_back(bench, began, restarts)


def _wheels_back(bench: Bench, began_ns: int, restarts: int) -> str:
    seconds = wait("the wheels are fused again", lambda: bench.fused_hz() > WITHOUT_WHEELS_HZ + 50)
    return f"wheels back after {seconds:.1f} s; {bench.steady(began_ns, restarts)}"


def autopilot_reboot(bench: Bench) -> str:
    """The autopilot is silent for three seconds, and its boot time starts again. In a bend that costs the heading, which
    must be found again."""
    began, restarts, requests = time.monotonic_ns(), bench.restarts, bench.vehicle.requests
    bench.vehicle.reboot()
    wait("the messages are requested again", lambda: bench.vehicle.requests >= requests + 3)
    seconds = (time.monotonic_ns() - began) / SECOND
    wait("the state has settled", lambda: time.monotonic_ns() > began + round(SETTLED_S * SECOND))
    return f"asked again after {seconds:.1f} s; {bench.steady(began, restarts, WITHOUT_IMU_M)}"


def clock_step(bench: Bench) -> str:
    """The wall clock is set forward by an hour, and back."""
    began, restarts = time.monotonic_ns(), bench.restarts
    for hours in (1, -1):
        stepped = time.clock_gettime_ns(time.CLOCK_REALTIME) + hours * 3600 * SECOND
        time.clock_settime_ns(time.CLOCK_REALTIME, stepped)
        first = bench.reader.first(time.monotonic_ns() + 2 * SECOND, lambda _: True, DEADLINE_S)
        if first is None:
            raise Failed(f"nothing published after a step of {hours:+} h; {bench.describe()}")
    stamps = [arrival.decoded()["t_ns"] for arrival in bench.reader.since(began)]
    if steps := [b - a for a, b in pairwise(stamps) if not 0 < b - a < SECOND]:
        raise Failed(f"published stamps step by {steps[0] / SECOND:.0f} s")
    return bench.steady(began, restarts)


def disk_full(bench: Bench) -> str:
    """The state folder's disk is full, and later has room again."""
    began, restarts = time.monotonic_ns(), bench.restarts
    filler = BOX.parent / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 16))
        except OSError:
            filled = time.monotonic()
    wait("the journal reports it", lambda: "No space left" in bench.journal(filled), 30.0, 1.0)
    filler.unlink()
    names = set(BOX.iterdir())

    def goes_on() -> bool:
        return any(path.stat().st_size for path in set(BOX.iterdir()) - names)

    seconds = wait("the black box goes on", goes_on, look_s=0.2)
    return f"box back {seconds:.0f} s after there was room; {bench.steady(began, restarts)}"


def many_times_the_load(bench: Bench) -> str:
    """Ten times the load for ten seconds."""
    usual = _sent_in(bench, 2.0) / 2.0
    began, restarts = time.monotonic_ns(), bench.restarts
    bench.vehicle.load = MANY
    try:
        sent = _sent_in(bench, 10.0) / 10.0
        rate = bench.fused_hz(5.0)
    finally:
        bench.vehicle.load = 1
    found = bench.steady(began, restarts)
    return f"{sent:.0f} frames a second, {sent / usual:.1f} times the usual, {rate:.0f} measurements fused a second; {found}"


def _sent_in(bench: Bench, seconds: float) -> int:
    """The number of frames that the vehicle sends in a time."""
    before, until = bench.vehicle.sent, time.monotonic() + seconds
    wait(f"{seconds:g} s pass", lambda: time.monotonic() > until)
    return bench.vehicle.sent - before


def garbage(bench: Bench) -> str:
    """Garbage on every input for eight seconds: random bytes, flipped bits, wheels of random speeds, error frames."""
    began, restarts = time.monotonic_ns(), bench.restarts
    bench.vehicle.noise = True
    try:
        wait("eight seconds pass", lambda: time.monotonic_ns() > began + 8 * SECOND)
    finally:
        bench.vehicle.noise = False
    return bench.steady(began, restarts)


def reload(bench: Bench) -> str:
    """`systemctl reload`."""
    began, restarts, pid = time.monotonic_ns(), bench.restarts, bench.pid
    call("systemctl", "reload", bench.unit)
    wait("the reload is logged", lambda: "reloaded: " in bench.journal(began / SECOND), look_s=0.5)
    if bench.pid != pid:
        raise Failed("it was restarted")
    return bench.steady(began, restarts)


def stop(bench: Bench) -> str:
    """`systemctl stop`: an orderly end."""
    memory = bench.rss_mb()
    began = time.monotonic()
    call("systemctl", "stop", bench.unit)
    result = bench.show("Result"), bench.show("ExecMainStatus")
    if result != ("success", "0"):
        raise Failed(f"ended with {result}")
    seconds = time.monotonic() - began
    if seconds > DEADLINE_S / 2:
        raise Failed(f"took {seconds:.1f} s")
    return f"ended after {seconds:.2f} s; {memory:.0f} MB at the end"


FAULTS: list[tuple[str, Callable[[Bench], str]]] = [
    ("SIGKILL", kill),
    ("hang, seen by the watchdog", hang),
    ("vcan down and up", interface_down),
    ("vcan deleted and back", interface_deleted),
    ("autopilot reboot", autopilot_reboot),
    ("clock step, +1 h and -1 h", clock_step),
    ("disk full", disk_full),
    ("10x load", many_times_the_load),
    ("garbage on every input", garbage),
    ("reload", reload),
    ("orderly end", stop),
]
