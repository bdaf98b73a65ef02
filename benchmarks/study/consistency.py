"""Is the filter as wrong as it says, and as right as it could be: NEES, NIS and the Cramer-Rao bound in the nominal drive.

The filter is started off the truth by a draw of the covariance that it is told. It is looked at once a second, just before
a fix, when no fix is on its way, so that it has everything that the bound has.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from benchmarks.study import nominal
from benchmarks.study.bound import Bound
from benchmarks.study.report import Section, figure
from benchmarks.study.runs import BLOCKS, Ledger, drive, error, started
from benchmarks.study.world import Sensors, World
from fusiond.earth import Array
from fusiond.fusion import Fusion
from fusiond.plan import IMU
from fusiond.sections import Config
from fusiond.state import CONSTRAINT_RATIO, ERROR_SIZE

WHEEL_HZ = 50.0
LOOK_PHASE_S = 0.195  # just before a fix, and no fix is on its way
BOUND_RUNS = 3  # trajectories over which the bound is averaged
MAIN = ("position", "velocity", "attitude")


@dataclass
class Study:
    """Errors (runs, looks, n), claimed covariances (runs, looks, n, n), the bound's (looks, n, n); and by source all NIS,
    their degrees of freedom and the share of events that was rejected."""

    looks: list[float]
    errors: Array = field(default_factory=lambda: np.zeros(0))
    claimed: Array = field(default_factory=lambda: np.zeros(0))
    bound: Array = field(default_factory=lambda: np.zeros(0))
    nis: dict[str, list[float]] = field(default_factory=dict)
    freedom: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, float] = field(default_factory=dict)


def study(config: Config, runs: int, seed: int, rounds: int = 1) -> Study:
    """Run the nominal drive so often."""
    scenario = nominal.scenario(rounds)
    looks = [second + LOOK_PHASE_S for second in range(1, int(scenario.duration_s) - 1)]
    errors = np.zeros((runs, len(looks), ERROR_SIZE))
    claimed = np.zeros((runs, len(looks), ERROR_SIZE, ERROR_SIZE))
    bounds, found = [], Study(looks)
    for run in range(runs):
        random = np.random.default_rng([seed, run])
        world = World(scenario, config, random)
        fusion = Fusion(config, compiled=True)
        started(fusion, world, random)
        ledger = Ledger(fusion)
        errors[run], claimed[run] = observed(world, fusion, ledger, looks, found)
        for i, source in enumerate(fusion.plan.sources):
            if fusion.plan.models[i] != IMU:
                _, nis, found.freedom[source] = ledger.normalised(source)
                found.nis.setdefault(source, []).extend(nis.tolist())
                rejected = ledger.rejected(source)[1]
                found.rejected[source] = found.rejected.get(source, 0.0) + float(rejected.mean()) / runs
        if run < BOUND_RUNS:
            bounds.append(Bound(world, WHEEL_HZ).run(looks))
    found.errors, found.claimed, found.bound = errors, claimed, np.mean(bounds, axis=0)
    return found


@functools.cache
def nominal_study(runs: int, seed: int) -> Study:
    """Of two parts."""
    return study(nominal.config(), runs, seed)


def observed(
    world: World, fusion: Fusion, ledger: Ledger, looks: list[float], found: Study
) -> tuple[Array, Array]:
    """Errors (looks, n) and claimed covariances (looks, n, n) of one run."""
    errors, claimed = [], []

    def look(_: float, k: int) -> None:
        head = fusion.history.head
        errors.append(error(head, world, k))
        claimed.append(head.covariance.copy())
        ratio = float(head.auxiliary[CONSTRAINT_RATIO][0])
        if ratio > 0:
            found.nis.setdefault("non_holonomic", []).append(ratio * fusion.plan.gates[2])
            found.freedom["non_holonomic"] = 2

    drive(fusion, Sensors(world, WHEEL_HZ).measurements(), looks, look, ledger)
    return np.array(errors), np.array(claimed)


def nees(found: Study, block: slice) -> Array:
    """Normalised estimation error squared (runs, looks) of a block."""
    off, spread = found.errors[:, :, block], found.claimed[:, :, block, block]
    return np.asarray(np.einsum("rti,rti->rt", off, np.linalg.solve(spread, off[..., None])[..., 0]))


def band(freedom: int, runs: int) -> tuple[float, float]:
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
        f"{runs} runs of the nominal drive ({found.looks[-1]:.0f} s), seed {seed}. The average over the runs at one instant "
        "should lie within the 95 % chi-square band at 95 % of the instants; the average over all of them has the band "
        "given by the scatter from run to run."
    )
    rows = []
    picture, axes = figure(len(MAIN))
    for name, block in BLOCKS.items():
        values, freedom = nees(found, block), block.stop - block.start
        average, (low, high) = values.mean(axis=0), band(freedom, runs)
        spread = 1.96 * values.mean(axis=1).std(ddof=1) / np.sqrt(runs)
        inside = np.mean((average >= low) & (average <= high))
        rows.append(
            (name, str(freedom), f"{low:.2f} to {high:.2f}", f"{inside:.0%}", f"{values.mean():.2f} ± {spread:.2f}",
             "yes" if abs(values.mean() - freedom) <= spread else "no")
        )  # fmt: skip
        if name in MAIN:
            axis = axes[MAIN.index(name)]
            axis.plot(found.looks, average, lw=1)
            axis.axhspan(low, high, alpha=0.2, color="green")
            axis.set_title(f"NEES of {name}, {runs} runs", fontsize=8)
            axis.set_xlabel("s", fontsize=7)
            axis.set_ylim(0, 2 * freedom)
    head = ("block", "degrees", "95 % band", "instants inside", "average ± 95 %", "contains the degrees")
    section.table(head, rows)
    section.picture("nees", "average NEES over time against its band", picture)
    rows = []
    for source, nis in found.nis.items():
        freedom = found.freedom[source]
        low, high = band(freedom, len(nis))
        mean = float(np.mean(nis))
        share = found.rejected.get(source)
        rejected = "" if share is None else f"{share:.3%}"
        rows.append((source, str(freedom), f"{mean:.3f}", f"{low:.3f} to {high:.3f}", str(len(nis)), rejected))
    section.table(("source", "degrees", "average NIS", "95 % band", "innovations", "rejected"), rows)
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
