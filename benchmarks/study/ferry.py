"""A vehicle on a ferry: its wheels read zero while it is carried, forwards or backwards."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import Ledger, begun, drive, error, spread
from benchmarks.study.world import GNSS_NAME, Fault, Sensors
from fusiond.filter.state import POSITION, RESETS, VELOCITY

IMU_HZ, WHEEL_HZ = 100.0, 20.0
LOOK_S = 0.5
ABOARD_S, ASHORE_S = 50.0, 230.0  # the wheels read zero in between
SPEEDS = {"carried forwards": 6.0, "carried backwards": -6.0, "not carried": 0.0}


def course(speed: float) -> list[tuple[float, float, float, float]]:
    """Drive aboard, be carried, drive off; the ferry is gentle: 0.2 m/s^2 at most."""
    turn = 40.0 if speed else 0.0
    carried = [(60, speed, 0, 0), (40, speed, turn, 0), (60, 0, 0, 0)]
    return [(30, 8, 90, 0), (10, 0, 0, 0), (20, 0, 0, 0), *carried, (20, 0, 0, 0), (15, 10, 0, 0), (25, 10, 90, 0)]


class Passage(NamedTuple):
    """Worst horizontal error aboard and ashore [m], worst velocity error aboard [m/s], share of fixes rejected, resets."""

    aboard: float
    ashore: float
    velocity: float
    rejected: float
    resets: int


def one(speed: float, seed: list[int]) -> Passage:
    random = np.random.default_rng(seed)
    config = nominal.config(motion={"standstill": True}, wheel={"unsigned": True, "least_mps": 0.1})
    scenario = nominal.scenario(course=course(speed), imu_hz=IMU_HZ)
    world, fusion = begun(scenario, config, random)
    ledger, found = Ledger(fusion), []

    def look(t: float, k: int) -> None:
        off = error(fusion.history.head, world, k)
        found.append((t, float(np.hypot(*(world.mat_ne[k] @ off[POSITION])[:2])), float(np.linalg.norm(off[VELOCITY]))))

    faults = tuple(Fault(name, "scale", ABOARD_S, ASHORE_S, 0.0) for name in config.wheel)
    looks = np.arange(LOOK_S, world.t[-1], LOOK_S).tolist()
    drive(fusion, Sensors(world, WHEEL_HZ, faults=faults).measurements(), looks, look, ledger)
    t, position, velocity = np.array(found).T
    aboard, ashore = (t >= ABOARD_S) & (t < ASHORE_S), t >= ASHORE_S + 10
    rejected = ledger.rejected(f"{GNSS_NAME}.position")[1]
    resets = int(fusion.history.head.stamps[RESETS])
    return Passage(position[aboard].max(), position[ashore].max(), velocity[aboard].max(), float(rejected.mean()), resets)


def ferry(runs: int, seed: int) -> Section:
    section = Section("Carried with the wheels at zero")
    section.say(f"{runs} runs each, seed {seed}: carried for three minutes, with GNSS throughout, then driving off.")
    rows = []
    for name, speed in SPEEDS.items():
        found = spread(one, [(speed, [seed, run]) for run in range(runs)])
        worst = Passage(*(max(values) for values in zip(*found, strict=True)))
        rows.append((name, f"{worst.aboard:.1f} m", f"{worst.velocity:.2f} m/s", f"{worst.ashore:.1f} m",
                     f"{worst.rejected:.1%}", worst.resets))  # fmt: skip
    head = ("case", "worst error aboard", "worst velocity error", "worst error ashore", "fixes rejected, worst",
            "resets, worst")  # fmt: skip
    section.table(head, rows)
    return section
