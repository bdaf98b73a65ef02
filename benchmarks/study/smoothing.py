"""The smoother against the filter: in an outage of a minute, and whether its covariance holds its errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import begun, drive, error, spread
from benchmarks.study.world import GNSS_NAME, T0, Fault, Sensors, World
from fusiond.estimator.archive import Archive, Spool
from fusiond.estimator.smoother import Smoother
from fusiond.estimator.solution import ATTITUDE, POSITION, VELOCITY, Solution
from fusiond.filter import state as layout
from fusiond.maths.rotation import matrix
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import radii
from fusiond.units import SECOND, nanoseconds

IMU_HZ, WHEEL_HZ = 100.0, 20.0
BEFORE_S, OUTAGE_S, AFTER_S = 60.0, 60.0, 60.0
LOOK_S = 0.5
BLOCKS = {"position": POSITION, "velocity": VELOCITY, "attitude": ATTITUDE, "all nine": slice(0, 9)}


class Run(NamedTuple):
    """One drive, at each look: seconds, horizontal errors of filter and smoother [m], and the smoother's NEES by block."""

    t: Array
    filtered: Array
    smoothed: Array
    nees: dict[str, Array]


def true_error(solution: Solution, world: World, k: int) -> Array:
    """Error (9,) of a solution at the IMU's k-th instant, north-east-down: true = estimate (+) error."""
    state = solution.state
    assert state is not None
    lat, lon, height = world.latitude[k], world.longitude[k], world.height[k]
    meridian, transverse = radii(float(lat))
    found = np.empty(9)
    found[0] = (lat - state.latitude) * (meridian + height)
    found[1] = (lon - state.longitude) * (transverse + height) * np.cos(lat)
    found[2] = -(height - state.height)
    found[VELOCITY] = world.velocity_n[k] - state.velocity_n
    turn = world.mat_nb[k] @ matrix(np.array(state.quaternion_nb)).T
    found[ATTITUDE] = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return found


def one(seed: list[int]) -> Run:
    """Run one drive with an outage."""
    random, config = np.random.default_rng(seed), nominal.config()
    end = BEFORE_S + OUTAGE_S + AFTER_S
    scenario = nominal.scenario(int(np.ceil(end / 60)), imu_hz=IMU_HZ)
    world, fusion = begun(scenario, config, random)
    archive = Archive(fusion.params, Spool.in_memory())
    fusion.history.archive = archive.add
    looks = np.arange(LOOK_S, end - 1, LOOK_S)
    filtered: dict[float, float] = {}
    places: dict[float, int] = {}

    def look(t: float, k: int) -> None:
        off = world.mat_ne[k] @ error(fusion.history.head, world, k)[layout.POSITION]
        filtered[t], places[t] = float(np.hypot(off[0], off[1])), k

    faults = (Fault(GNSS_NAME, "absent", BEFORE_S, BEFORE_S + OUTAGE_S - 1e-6),)
    drive(fusion, Sensors(world, WHEEL_HZ, faults=faults).measurements(), looks.tolist(), look)
    fusion.history.finish()
    archive.finish()
    instants = np.array([T0 + nanoseconds(t) for t in looks])
    smoother = Smoother(archive, instants)
    smoother.smooth()
    t, errors = list[float](), list[float]()
    nees: dict[str, list[float]] = {name: [] for name in BLOCKS}
    for solution in smoother.solutions():
        second = (solution.t_ns - T0) / SECOND
        assert solution.state is not None
        off = true_error(solution, world, places[round(second / LOOK_S) * LOOK_S])
        t.append(second)
        errors.append(float(np.hypot(off[0], off[1])))
        for name, block in BLOCKS.items():
            nees[name].append(float(off[block] @ np.linalg.solve(solution.state.covariance[block, block], off[block])))
    times = np.array(t)
    found = np.array([filtered[round(second / LOOK_S) * LOOK_S] for second in t])
    return Run(times, found, np.array(errors), {name: np.array(values) for name, values in nees.items()})


def smoothing(runs: int, seed: int) -> Section:
    section = Section("Smoothing")
    section.say(
        f"{runs} runs in the nominal drive, seed {seed}: {BEFORE_S:.0f} s with GNSS, {OUTAGE_S:.0f} s without, "
        f"{AFTER_S:.0f} s with it. Horizontal errors at the same instants, and the smoother's normalised squared errors."
    )
    found = spread(one, [([seed, run],) for run in range(runs)])
    inside = (found[0].t >= BEFORE_S) & (found[0].t < BEFORE_S + OUTAGE_S)
    rows = []
    for name, where in (("in the outage", inside), ("else", ~inside)):
        filtered, smoothed = (
            float(np.sqrt(np.mean([getattr(run, kind)[where] ** 2 for run in found]))) for kind in ("filtered", "smoothed")
        )
        worst = max(float(run.smoothed[where].max()) for run in found)
        rows.append((name, f"{filtered:.3f} m", f"{smoothed:.3f} m", f"{filtered / smoothed:.1f}", f"{worst:.2f} m"))
    section.table(("", "filter, RMSE", "smoother, RMSE", "times better", "smoother, worst"), rows)
    nees = []
    for name, block in BLOCKS.items():
        freedom = len(range(*block.indices(9)))
        means = [float(np.mean([run.nees[name][where] for run in found])) for where in (inside, ~inside)]
        nees.append((name, freedom, *(f"{mean:.2f}" for mean in means)))
    section.table(("mean NEES", "expected", "in the outage", "else"), nees)
    return section
