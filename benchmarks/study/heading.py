"""Starts without a heading: how long it takes to find it, and whether its sigma is consistent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import drive, spread
from benchmarks.study.world import T0, Sensors, World
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.units import nanoseconds

IMU_HZ, WHEEL_HZ = 100.0, 20.0
LOOK_S = 0.1
GOOD, SIGMAS = np.radians(5.0), 3.0
IN_TIME_S = 10.0  # of driving
MOVING_MPS = 1.0  # from here on it is driving
LATE_S = 60.0
LEVEL_DEG = 3.0  # the default: it levels itself, on a biased accelerometer and in motion


class Case(NamedTuple):
    """A start: the course [duration s, end speed m/s, turn deg, grade deg], first speed [m/s], grade [deg], when GNSS
    comes [s], whether wheel speeds are signed."""

    course: list[tuple[float, float, float, float]]
    speed: float = 0.0
    grade: float = 0.0
    gnss_from: float = 0.0
    signed: bool = False


BACK = [(10, 0, 0, 0), (4, -2, 0, 0), (6, -4, 0, 0), (10, -3, 60, 0), (8, 0, 0, 0), (15, 10, 0, 0)]
BACKING = [(12, -4, 40, 0), (12, -2, -60, 0), (6, 0, 0, 0), (15, 10, 0, 0)]
CASES = {
    "at rest, then drives off": Case([(10, 0, 0, 0), (8, 10, 0, 0), (10, 10, 60, 0), (12, 12, 0, 0)]),
    "in motion": Case([(15, 12, 40, 0), (15, 10, -60, 0)], speed=10.0),
    "in slow motion": Case([(15, 4, 40, 0), (15, 10, -60, 0)], speed=3.0),
    "in reverse out of the parking place": Case(BACK),
    "the same, signed wheels": Case(BACK, signed=True),
    "rolling back at 2 to 4 m/s": Case(BACKING, speed=-2.5),
    "the same, with signed wheels": Case(BACKING, speed=-2.5, signed=True),
    "on a slope of 5 deg": Case([(10, 0, 0, 5), (8, 10, 0, 5), (15, 10, 60, 5)], grade=5.0),
    "GNSS a minute late, in motion": Case(
        [(10, 0, 0, 0), (10, 10, 0, 0), (20, 10, 90, 0), (40, 12, 0, 0), (20, 12, 60, 0)], gnss_from=LATE_S
    ),
    "GNSS a minute late, at rest": Case([(70, 0, 0, 0), (8, 10, 0, 0), (15, 10, 60, 0)], gnss_from=LATE_S),
}


class Start(NamedTuple):
    """One start: seconds of driving (with GNSS) until the heading is right for good, error then at IN_TIME_S [rad], that in
    sigmas, and the share of all later instants at which it is within 3 sigma."""

    right_after: float
    error: float
    in_sigmas: float
    honest: float


def settings(signed: bool) -> Config:
    return nominal.config(
        filter={"mount_sigma_deg": 0.5, "level_sigma_deg": LEVEL_DEG},
        motion={"standstill": True},
        wheel={"unsigned": not signed, "least_mps": 0.1},
    )


def one(case: Case, heading_deg: float, seed: list[int]) -> Start:
    random, config = np.random.default_rng(seed), settings(case.signed)
    scenario = nominal.scenario(
        heading_deg=heading_deg, course=case.course, speed=case.speed, grade_deg=case.grade, imu_hz=IMU_HZ
    )
    world, fusion = World(scenario, config, random), Fusion(config, compiled=True)
    looks = np.arange(LOOK_S, world.t[-1], LOOK_S)
    errors, sigmas = np.full(len(looks), np.inf), np.full(len(looks), np.inf)
    index = iter(range(len(looks)))

    def look(t: float, k: int) -> None:
        i = next(index)
        state = fusion.solution_at(T0 + nanoseconds(t)).state
        if state is not None:
            truth = np.arctan2(world.mat_nb[k, 1, 0], world.mat_nb[k, 0, 0])
            errors[i] = abs((state.euler()[2] - truth + np.pi) % (2 * np.pi) - np.pi)
            sigmas[i] = state.sigma_yaw()

    drive(fusion, Sensors(world, WHEEL_HZ).measurements(case.gnss_from), looks.tolist(), look)
    driving = np.interp(looks, world.t, np.abs(world.speed)) > MOVING_MPS
    driving &= looks >= case.gnss_from
    since = np.cumsum(driving) * LOOK_S
    wrong = np.flatnonzero(errors > GOOD)
    right = 0.0 if not len(wrong) else since[wrong[-1]] if wrong[-1] + 1 < len(looks) else np.inf
    at = int(np.searchsorted(since, IN_TIME_S))
    with np.errstate(invalid="ignore"):
        in_sigmas = np.where(np.isfinite(sigmas), errors / sigmas, np.inf)
    return Start(float(right), float(errors[at]), float(in_sigmas[at]), float(np.mean(in_sigmas[at:] <= SIGMAS)))


def heading(runs: int, seed: int) -> Section:
    section = Section("Start without a heading")
    section.say(
        f"{runs} seeds, start headings evenly spread over the circle, seed {seed}. Right: within 5 deg from then on. Time "
        "is counted while GNSS is available and the vehicle drives faster than 1 m/s."
    )
    rows = []
    for name, case in CASES.items():
        found = spread(one, [(case, 360.0 * run / runs, [seed, run]) for run in range(runs)])
        times, errors = np.array([s.right_after for s in found]), np.degrees([s.error for s in found])
        right = sum(s.right_after <= IN_TIME_S for s in found)
        both = sum(s.right_after <= IN_TIME_S and s.in_sigmas <= SIGMAS for s in found)
        rows.append(
            (name, f"{np.median(times):.1f} s", f"{times.max():.1f} s", f"{np.median(errors):.2f} deg",
             f"{errors.max():.2f} deg", f"{max(s.in_sigmas for s in found):.1f}", f"{right} of {runs}",
             f"{both} of {runs}", f"{np.mean([s.honest for s in found]):.1%}")
        )  # fmt: skip
    head = ("start", "right after, median", "worst", f"error at {IN_TIME_S:.0f} s, median", "worst", "worst in sigmas",
            f"right within {IN_TIME_S:.0f} s", f"and at {IN_TIME_S:.0f} s within 3 sigma",
            "later instants within 3 sigma (99.7 % if consistent)")  # fmt: skip
    section.table(head, rows)
    return section
