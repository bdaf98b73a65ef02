"""The drift of dead reckoning during a GNSS outage, and how soon GNSS is fused after it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section, figure
from benchmarks.study.runs import Ledger, begun, drive, error, spread
from benchmarks.study.world import GNSS_NAME, Fault, Sensors
from fusiond.filter.state import POSITION, RESETS

IMU_HZ, WHEEL_HZ = 100.0, 20.0
OUTAGES_S = (10.0, 30.0, 60.0, 120.0, 300.0, 600.0)
BEFORE_S, AFTER_S = 60.0, 20.0
LOOK_S = 0.5
RETURNED_S = 5.0  # after the return of GNSS, when the error is taken


class Outage(NamedTuple):
    """One outage: horizontal error at its end [m], the sigma claimed for it [m], metres driven, seconds until the first fix
    is fused after it, error some seconds after [m], resets."""

    error: float
    sigma: float
    driven: float
    fused_after: float
    after: float
    resets: int


def one(seconds: float, seed: list[int]) -> Outage:
    """Run one outage of so many seconds."""
    random, config = np.random.default_rng(seed), nominal.config()
    end = BEFORE_S + seconds
    scenario = nominal.scenario(int(np.ceil((end + AFTER_S) / 60)), imu_hz=IMU_HZ)
    world, fusion = begun(scenario, config, random)
    ledger, errors, sigmas = Ledger(fusion), {}, {}
    looks = np.arange(LOOK_S, end + AFTER_S, LOOK_S).tolist()

    def look(t: float, k: int) -> None:
        to_n, head = world.mat_ne[k], fusion.history.head
        errors[t] = float(np.hypot(*(to_n @ error(head, world, k)[POSITION])[:2]))
        sigmas[t] = float(np.sqrt(np.trace((to_n @ head.covariance[POSITION, POSITION] @ to_n.T)[:2, :2])))

    faults = (Fault(GNSS_NAME, "absent", BEFORE_S, end - 1e-6),)
    drive(fusion, Sensors(world, WHEEL_HZ, faults=faults).measurements(), looks, look, ledger)
    t, rejected = ledger.rejected(f"{GNSS_NAME}.position")
    fused = t[(t >= end - 1e-6) & ~rejected]
    inside = (world.t >= BEFORE_S) & (world.t < end)
    driven = float(np.abs(world.speed[inside]).sum() / world.sensor.rate_hz)
    fused_after = float(fused[0] - end) if len(fused) else np.inf
    return Outage(
        errors[end - LOOK_S], sigmas[end - LOOK_S], driven, fused_after, errors[end + RETURNED_S],
        int(fusion.history.head.stamps[RESETS]),
    )  # fmt: skip


def outage(runs: int, seed: int) -> Section:
    section = Section("GNSS outages")
    section.say(
        f"{runs} runs of each length in the nominal drive, seed {seed}, after {BEFORE_S:.0f} s with GNSS; IMU, four wheels "
        "and the non-holonomic constraint go on. Errors and claimed sigmas are horizontal."
    )
    rows, drift = [], []
    for seconds in OUTAGES_S:
        found = spread(one, [(seconds, [seed, run, int(seconds)]) for run in range(runs)])
        share = np.array([100 * o.error / o.driven for o in found])
        drift.append(share)
        rms = float(np.sqrt(np.mean([o.error**2 for o in found])))
        claimed = float(np.sqrt(np.mean([o.sigma**2 for o in found])))
        rows.append(
            (f"{seconds:.0f} s", f"{np.mean([o.driven for o in found]):.0f} m", f"{rms:.2f} m", f"{claimed:.2f} m",
             f"{np.median(share):.3f} %", f"{share.max():.3f} %", f"{max(o.fused_after for o in found):.1f} s",
             f"{max(o.after for o in found):.2f} m", sum(o.resets for o in found))
        )  # fmt: skip
    head = (
        "outage", "driven", "RMSE at its end", "claimed", "drift, median", "drift, worst", "GNSS fused again, worst",
        f"error {RETURNED_S:.0f} s later, worst", "resets",
    )  # fmt: skip
    section.table(head, rows)
    picture, axis = figure()
    axis.boxplot(drift, tick_labels=[f"{s:.0f}" for s in OUTAGES_S])
    axis.set_xlabel("outage [s]", fontsize=7)
    axis.set_ylabel("drift [% of distance]", fontsize=7)
    section.picture("outage", "drift in percent of the distance over the length of the outage", picture)
    return section
