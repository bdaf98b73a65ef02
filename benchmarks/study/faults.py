"""Faults switched on in the nominal drive: how soon each is noticed, what it does to the position, and false alarms."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import Ledger, drive, error, started
from benchmarks.study.world import GNSS_NAME, Fault, Sensors, World
from fusiond.earth import Array
from fusiond.fusion import Fusion
from fusiond.plan import IMU
from fusiond.state import POSITION, RESETS

START_S, STOP_S = 40.0, 80.0
LOOK_S = 0.5
ALARM_EVENTS = {"gnss": 3, "wheel": 10}  # so many rejections in a row are an alarm; so many intervals without a message too
FAULTS = {
    "wheel slips 30 %": Fault("rear_left", "scale", START_S, STOP_S, 1.3),
    "wheel locked": Fault("rear_left", "scale", START_S, STOP_S, 0.0),
    "wheel frozen": Fault("rear_left", "stuck", START_S, STOP_S),
    "wheel absent": Fault("rear_left", "absent", START_S, STOP_S),
    "wheel noisy, 5 sigma": Fault("rear_left", "noisy", START_S, STOP_S, 5.0),
    "GNSS jumps 20 m": Fault(GNSS_NAME, "jump", START_S, STOP_S, 20.0),
    "GNSS drifts off at 1 m/s": Fault(GNSS_NAME, "drift", START_S, STOP_S, 1.0),
    "GNSS stuck": Fault(GNSS_NAME, "stuck", START_S, STOP_S),
    "GNSS absent": Fault(GNSS_NAME, "absent", START_S, STOP_S),
    "GNSS noisy, 5 sigma": Fault(GNSS_NAME, "noisy", START_S, STOP_S, 5.0),
}


class Result(NamedTuple):
    """Seconds from the fault to its alarm (inf: none), worst horizontal error during it and from 5 s after it on [m],
    resets, alarms of other sources."""

    noticed: float
    during: float
    after: float
    resets: int
    others: int


def alarms(ledger: Ledger, source: str, interval: float, end: float) -> Array:
    """Begins [s] of the alarms of a source."""
    t, rejected = ledger.rejected(source)
    row = ALARM_EVENTS["gnss" if "." in source else "wheel"]
    ends = np.flatnonzero(np.convolve(rejected, np.ones(row), "full")[: len(t)] >= row - 0.5) if len(t) else np.zeros(0, int)
    first = ends[np.diff(ends, prepend=-2) > 1]
    stamps = np.append(t, end)
    gaps = np.flatnonzero(np.diff(stamps) > (row + 0.5) * interval)
    return np.sort(np.concatenate([t[first], stamps[gaps] + (row + 0.5) * interval]))


def one(fault: Fault | None, seed: list[int]) -> Result:
    random, config = np.random.default_rng(seed), nominal.config()
    world, fusion = World(nominal.scenario(2), config, random), Fusion(config, compiled=True)
    started(fusion, world, random)
    ledger, errors = Ledger(fusion), []
    looks = np.arange(LOOK_S, world.t[-1], LOOK_S)

    def look(_: float, k: int) -> None:
        errors.append(float(np.hypot(*(world.mat_ne[k] @ error(fusion.history.head, world, k)[POSITION])[:2])))

    sensors = Sensors(world, faults=() if fault is None else (fault,))
    drive(fusion, sensors.measurements(), looks.tolist(), look, ledger)
    off, noticed, others = np.array(errors), [np.inf], 0
    for source, model in zip(fusion.plan.sources, fusion.plan.models, strict=True):
        if model == IMU:
            continue
        interval = config.gnss[GNSS_NAME].interval_s if "." in source else 1 / sensors.wheel_hz
        begins = alarms(ledger, source, interval, float(looks[-1]) - 1.0)
        if fault is not None and source.split(".")[0] == fault.source:
            noticed += (begins[(begins >= START_S) & (begins < STOP_S)] - START_S).tolist()
        else:
            others += len(begins)
    during = (looks >= START_S) & (looks < STOP_S)
    return Result(
        min(noticed), off[during].max(), off[looks >= STOP_S + 5].max(), int(fusion.history.head.stamps[RESETS]), others
    )


def faults(runs: int, seed: int) -> Section:
    section = Section("Faults")
    section.say(
        f"{runs} runs each in the nominal drive, seed {seed}; the fault lasts from {START_S:.0f} s to {STOP_S:.0f} s. "
        f"Noticed: {ALARM_EVENTS['gnss']} GNSS or {ALARM_EVENTS['wheel']} wheel events in a row rejected, or as many "
        "missing. Errors are horizontal, worst of all runs."
    )
    rows = []
    for name, fault in FAULTS.items():
        found = [one(fault, [seed, run]) for run in range(runs)]
        times = np.array([r.noticed for r in found])
        seen = times[np.isfinite(times)]
        median, worst = (f"{np.median(seen):.2f} s", f"{seen.max():.2f} s") if len(seen) else ("-", "-")
        rows.append(
            (name, f"{len(seen)} of {runs}", median, worst, f"{max(r.during for r in found):.1f} m",
             f"{max(r.after for r in found):.1f} m", sum(r.resets for r in found), sum(r.others for r in found))
        )  # fmt: skip
    head = ("fault", "noticed", "after, median", "worst", "error during", "error 5 s after", "resets", "others blamed")
    section.table(head, rows)
    clean = [one(None, [seed, 1000 + run]) for run in range(runs)]
    hours = runs * 120 / 3600
    section.say(f"Without a fault: {sum(r.others for r in clean)} alarms in {hours:.2f} h.")
    return section
