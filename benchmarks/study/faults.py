"""Faults in the nominal drive: how soon each is detected, its effect on the position, and false alarms."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import begun, drive, error, spread
from benchmarks.study.world import GNSS_NAME, T0, Fault, Sensors
from fusiond.filter.state import POSITION, RESETS
from fusiond.units import nanoseconds

IMU_HZ, WHEEL_HZ = 100.0, 20.0
START_S, STOP_S, END_S = 40.0, 65.0, 120.0
LOOK_S = 0.05
AFTER_S = 5.0  # after the end of the fault, until errors count as after it
FAULTS = {
    "wheel slips 30 %": Fault("rear_left", "scale", START_S, STOP_S, 1.3),
    "wheel locked, reads 0": Fault("rear_left", "scale", START_S, STOP_S, 0.0),
    "wheel frozen": Fault("rear_left", "stuck", START_S, STOP_S),
    "wheel absent": Fault("rear_left", "absent", START_S, STOP_S),
    "wheel noisy, 5 sigma": Fault("rear_left", "noisy", START_S, STOP_S, 5.0),
    "GNSS jumps 20 m": Fault(GNSS_NAME, "jump", START_S, STOP_S, 20.0),
    "GNSS drifts off at 1 m/s, velocity too": Fault(GNSS_NAME, "drift", START_S, STOP_S, 1.0),
    "GNSS drifts off at 1 m/s, position only": Fault(GNSS_NAME, "creep", START_S, STOP_S, 1.0),
    "GNSS stuck": Fault(GNSS_NAME, "stuck", START_S, STOP_S),
    "GNSS absent": Fault(GNSS_NAME, "absent", START_S, STOP_S),
    "GNSS noisy, 5 sigma": Fault(GNSS_NAME, "noisy", START_S, STOP_S, 5.0),
}
STOP_AND_GO = [(8, 0, 0, 0), (12, 0, 0, 0), (10, 14, 0, 0), (12, 14, 90, 2), (8, 0, 0, 0), (10, 8, -90, 0)]  # 60 s
CITY = {"motion": {"standstill": True}, "wheel": {"unsigned": True, "least_mps": 0.1}}
CORRELATED = {"gnss": {"position_correlation_s": 10.0, "velocity_correlation_s": 1.0}}
GOOD_ROUNDS = 3  # of 60 s each
GOOD: dict[str, tuple[list[tuple[float, float, float, float]], dict[str, dict[str, Any]]]] = {
    "nominal": (nominal.TOWN, {}),
    "GNSS errors correlated over 10 s, and configured so": (nominal.TOWN, CORRELATED),
    "stop and go, unsigned wheels": (STOP_AND_GO, CITY),
}


class Watched(NamedTuple):
    """The status of each source at each look, and horizontal errors (looks,) [m]."""

    looks: list[float]
    statuses: dict[str, list[str]]
    errors: list[float]
    resets: int


class Named(NamedTuple):
    """Seconds from a fault until its source is no longer called nominal (inf: never), what it is called most, worst error
    during the fault and from AFTER_S after it on [m], alarms of other sources."""

    after: float
    status: str
    during: float
    later: float
    others: int


def watched(
    rounds: int, course: list[tuple[float, float, float, float]], changes: dict[str, dict[str, Any]],
    faults: tuple[Fault, ...], seed: list[int],
) -> Watched:  # fmt: skip
    """Drive `rounds` of a course, and read the health of the sources every LOOK_S."""
    random, config = np.random.default_rng(seed), nominal.config(**changes)
    world, fusion = begun(nominal.scenario(rounds, course=course, imu_hz=IMU_HZ), config, random)
    looks = np.arange(LOOK_S, world.t[-1], LOOK_S).tolist()
    statuses: dict[str, list[str]] = {source: [] for source in fusion.params.sources}
    errors: list[float] = []

    def look(t: float, k: int) -> None:
        for source, health in fusion.health(T0 + nanoseconds(t)).items():
            statuses[source].append(health.status)
        errors.append(float(np.hypot(*(world.mat_ne[k] @ error(fusion.history.head, world, k)[POSITION])[:2])))

    drive(fusion, Sensors(world, WHEEL_HZ, faults=faults).measurements(), looks, look)
    return Watched(looks, statuses, errors, int(fusion.history.head.stamps[RESETS]))


def alarms(statuses: list[str]) -> int:
    """How often the status of a source changes from nominal to another."""
    bad = [status != "nominal" for status in statuses]
    return sum(now and not before for before, now in zip([False, *bad], bad, strict=False))


def named(fault: Fault, seed: list[int]) -> Named:
    found = watched(2, nominal.TOWN, {}, (fault,), seed)
    looks, errors = np.array(found.looks), np.array(found.errors)
    during = (looks >= fault.start) & (looks < fault.stop)
    after, called, others = np.inf, [], 0
    for source, statuses in found.statuses.items():
        if source.split(".")[0] != fault.source:
            others += alarms(statuses)
            continue
        row = np.array(statuses)
        bad = during & (row != "nominal")
        called += row[bad].tolist()
        if bad.any():
            after = min(after, float(looks[bad][0] - fault.start))
    status = max(sorted(set(called)), key=called.count) if called else "-"
    return Named(after, status, errors[during].max(), errors[looks >= fault.stop + AFTER_S].max(), others)


def false_alarms(name: str, seed: list[int]) -> dict[str, int]:
    """Of each source, in one good drive; and the resets."""
    course, changes = GOOD[name]
    found = watched(GOOD_ROUNDS, course, changes, (), seed)
    return {source: alarms(statuses) for source, statuses in found.statuses.items()} | {"resets": found.resets}


def faults(runs: int, seed: int) -> Section:
    section = Section("Faults")
    section.say(
        f"{runs} runs each in the nominal drive (IMU {IMU_HZ:.0f} Hz, wheels {WHEEL_HZ:.0f} Hz, GNSS 5 Hz), seed {seed}; "
        f"the fault lasts from {START_S:.0f} s to {STOP_S:.0f} s. Detected: the status of the source, or of one of a "
        f"receiver's two sources, is no longer nominal; sampled every {LOOK_S * 1e3:.0f} ms. Errors are horizontal, worst "
        "of all runs."
    )
    rows = []
    for name, fault in FAULTS.items():
        found = spread(named, [(fault, [seed, run]) for run in range(runs)])
        times = np.array([f.after for f in found])
        called = [f.status for f in found]
        rows.append(
            (name, f"{np.isfinite(times).sum()} of {runs}", max(sorted(set(called)), key=called.count),
             f"{np.median(times):.2f} s", f"{times.max():.2f} s", f"{max(f.during for f in found):.1f} m",
             f"{max(f.later for f in found):.1f} m", sum(f.others for f in found))
        )  # fmt: skip
    head = ("fault", "detected", "usual status", "after, median", "worst", "error during",
            f"error from {AFTER_S:.0f} s after on", "other sources blamed")  # fmt: skip
    section.table(head, rows)
    section.say(
        "False alarms, in drives without a fault: how often the status of a source stops being nominal, summed over all "
        "sources (IMU, GNSS position and velocity, four wheels)."
    )
    good = []
    for i, name in enumerate(GOOD):
        drives = spread(false_alarms, [(name, [seed, i, run]) for run in range(2 * runs)])
        hours = len(drives) * GOOD_ROUNDS * 60 / 3600
        counts = {source: sum(d[source] for d in drives) for source in drives[0]}
        resets = counts.pop("resets")
        which = ", ".join(f"{source} {count}" for source, count in counts.items() if count) or "none"
        total = sum(counts.values())
        good.append((name, f"{hours:.1f} h", total, f"{total / hours:.2f}", which, resets))
    section.table(("drive", "driven", "alarms", "an hour", "which", "resets"), good)
    return section
