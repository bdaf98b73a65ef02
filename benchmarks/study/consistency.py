"""Consistency and efficiency of the filter in the nominal drive: NEES, NIS and the Cramer-Rao bound.

The filter starts from the truth plus a random error of its initial covariance. It is sampled once a second, just before a
fix, when no fix is on its way, so that it has used every measurement that the bound has.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from benchmarks.study import nominal
from benchmarks.study.bound import Bound
from benchmarks.study.report import Section, figure
from benchmarks.study.runs import BLOCKS, Ledger, begun, drive, error, spread
from benchmarks.study.world import Sensors, World
from fusiond.config.schema import Config
from fusiond.filter.observations import IMU
from fusiond.filter.state import CONSTRAINT_RATIO
from fusiond.maths.typed import Array

IMU_HZ, WHEEL_HZ = 100.0, 20.0
LOOK_PHASE_S = 0.195  # just before a fix, and no fix is on its way
BOUND_RUNS = 3  # trajectories over which the bound is averaged
CONSTRAINT = "non-holonomic"
MAIN = ("position", "velocity", "attitude")


class Run(NamedTuple):
    """One run: errors (looks, n), claimed covariances (looks, n, n); and by source all NIS, their degrees of freedom and
    the share of events that was rejected."""

    errors: Array
    claimed: Array
    nis: dict[str, list[float]]
    freedom: dict[str, int]
    rejected: dict[str, float]


class Study(NamedTuple):
    """Errors (runs, looks, n), claimed covariances (runs, looks, n, n), the bound's (looks, n, n), and the runs."""

    looks: list[float]
    errors: Array
    claimed: Array
    bound: Array
    runs: list[Run]

    def nis(self, source: str) -> list[float]:
        return [value for run in self.runs for value in run.nis[source]]


def instants(rounds: int) -> list[float]:
    return [second + LOOK_PHASE_S for second in range(1, int(nominal.scenario(rounds).duration_s) - 1)]


def study(config: Config, runs: int, seed: int, rounds: int = 1, bounds: int = 0) -> Study:
    """Run the nominal drive so often, and the bound's recursion in the first of them."""
    looks = instants(rounds)
    found = spread(one, [(config, rounds, [seed, run]) for run in range(runs)])
    bound = spread(least, [(config, rounds, [seed, run]) for run in range(bounds)]) if bounds else []
    return Study(
        looks, np.array([run.errors for run in found]), np.array([run.claimed for run in found]),
        np.mean(bound, axis=0) if bound else np.zeros(0), found,
    )  # fmt: skip


@functools.cache
def nominal_study(runs: int, seed: int) -> Study:
    """Of two parts."""
    return study(nominal.config(), runs, seed, bounds=BOUND_RUNS)


def least(config: Config, rounds: int, seed: list[int]) -> Array:
    """The bound (looks, n, n) in the world of one run."""
    world = World(nominal.scenario(rounds, imu_hz=IMU_HZ), config, np.random.default_rng(seed))
    return Bound(world, WHEEL_HZ).run(instants(rounds))


def one(config: Config, rounds: int, seed: list[int]) -> Run:
    random = np.random.default_rng(seed)
    world, fusion = begun(nominal.scenario(rounds, imu_hz=IMU_HZ), config, random)
    ledger, constraint = Ledger(fusion), fusion.params.gates[2]
    errors, claimed = [], []
    nis: dict[str, list[float]] = {CONSTRAINT: []}

    def look(_: float, k: int) -> None:
        head = fusion.history.head
        errors.append(error(head, world, k))
        claimed.append(head.covariance.copy())
        ratio = float(head.auxiliary[CONSTRAINT_RATIO][0])
        if ratio > 0:
            nis[CONSTRAINT].append(ratio * constraint)

    drive(fusion, Sensors(world, WHEEL_HZ).measurements(), instants(rounds), look, ledger)
    freedom, rejected = {CONSTRAINT: 2}, {}
    for i, source in enumerate(fusion.params.sources):
        if fusion.params.models[i] != IMU:
            values, freedom[source] = ledger.normalised(source)[1:]
            nis[source], rejected[source] = values.tolist(), float(ledger.rejected(source)[1].mean())
    return Run(np.array(errors), np.array(claimed), nis, freedom, rejected)


def nees(found: Study, block: slice) -> Array:
    """Normalised estimation error squared (runs, looks) of a block."""
    off, spread = found.errors[:, :, block], found.claimed[:, :, block, block]
    return np.asarray(np.einsum("rti,rti->rt", off, np.linalg.solve(spread, off[..., None])[..., 0]))


def band(freedom: float, runs: int) -> tuple[float, float]:
    """The two-sided 95 % band of an average of `runs` independent chi-square variables."""
    low, high = chi2.ppf([0.025, 0.975], freedom * runs) / runs
    return float(low), float(high)


def ratio(found: Study, block: slice, part: slice = slice(None)) -> tuple[float, float]:
    """RMSE over the bound, and claimed sigma over the bound, of a block."""
    bound = np.trace(found.bound[part, block, block], axis1=1, axis2=2).mean()
    square = (found.errors[:, part, block] ** 2).sum(axis=-1).mean()
    claimed = np.trace(found.claimed[:, part, block, block], axis1=2, axis2=3).mean()
    return float(np.sqrt(square / bound)), float(np.sqrt(claimed / bound))


def consistency(runs: int, seed: int) -> Section:
    found = nominal_study(runs, seed)
    section = Section("Consistency: NEES and NIS")
    section.say(
        f"{runs} runs of the nominal drive ({found.looks[-1]:.0f} s), seed {seed}, sampled once a second. Two statistics "
        "of the NEES. Instants: the average over the runs at one instant, whose band is that of a chi-square variable of "
        "runs x degrees; a consistent filter is inside at 95 % of the instants, but neighbouring instants share their "
        "errors. Average: over all instants and runs. The runs are independent, and the scatter of their means gives the "
        "degrees of freedom of one run (2 degrees^2 / variance of the means); with the number of runs this gives the band."
    )
    rows = []
    picture, axes = figure(len(MAIN))
    for name, block in BLOCKS.items():
        values, freedom = nees(found, block), block.stop - block.start
        average, (low, high) = values.mean(axis=0), band(freedom, runs)
        inside = np.mean((average >= low) & (average <= high))
        worth = 2 * freedom**2 / float(values.mean(axis=1).var(ddof=1))
        least, most = (limit * freedom / worth for limit in band(worth, runs))
        rows.append(
            (name, str(freedom), f"{low:.2f} to {high:.2f}", f"{inside:.0%}", f"{worth:.0f}", f"{least:.2f} to {most:.2f}",
             f"{values.mean():.2f}", "yes" if least <= values.mean() <= most else "no")
        )  # fmt: skip
        if name in MAIN:
            axis = axes[MAIN.index(name)]
            axis.plot(found.looks, average, lw=1)
            axis.axhspan(low, high, alpha=0.2, color="green")
            axis.set_title(f"NEES of {name}, {runs} runs", fontsize=8)
            axis.set_xlabel("s", fontsize=7)
            axis.set_ylim(0, 2 * freedom)
    head = ("block", "degrees", "band at an instant", "instants inside", "degrees of one run", "band of the average",
            "average", "inside")  # fmt: skip
    section.table(head, rows)
    section.picture("nees", "average NEES over time against its band", picture)
    judged = []
    for source, freedom in found.runs[0].freedom.items():
        nis = found.nis(source)
        low, high = band(freedom, len(nis))
        shares = [run.rejected[source] for run in found.runs if source in run.rejected]
        rejected = f"{np.mean(shares):.3%}" if shares else ""
        judged.append((source, str(freedom), f"{np.mean(nis):.3f}", f"{low:.3f} to {high:.3f}", str(len(nis)), rejected))
    section.table(("source", "degrees", "average NIS", "95 % band", "innovations", "rejected"), judged)
    return section


def bound(runs: int, seed: int) -> Section:
    found = nominal_study(runs, seed)
    section = Section("Against the Cramer-Rao bound")
    section.say(f"{runs} runs of the nominal drive, seed {seed}; root mean square over all instants and runs.")
    rows = []
    for name, block in BLOCKS.items():
        rmse = float(np.sqrt((found.errors[:, :, block] ** 2).sum(axis=-1).mean()))
        real, claimed = ratio(found, block)
        late, late_claimed = ratio(found, block, slice(len(found.looks) // 2, None))
        rows.append((name, f"{rmse:.4g}", f"{real:.3f}", f"{claimed:.3f}", f"{late:.3f}", f"{late_claimed:.3f}"))
    head = ("block", "RMSE (SI)", "RMSE / bound", "claimed / bound", "2nd half: RMSE / bound", "2nd half: claimed / bound")
    section.table(head, rows)
    return section
