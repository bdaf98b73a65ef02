"""The costs of a decision: metres that a lying receiver pulls the state against availability lost while it is right."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study.attacks import ATTACKS, attacked, begins
from benchmarks.study.report import Section, figure
from benchmarks.study.runs import spread
from fusiond.simulation.wire import GNSS

COSTS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of a metre of a swallowed spoof over that of one of dead reckoning
FIX_S = 0.2  # spacing of the fixes
LIES = (
    "spoof, position only, 0.2 m/s",
    "spoof, position only, 1.0 m/s",
    "spoof, velocity too, 0.2 m/s",
    "spoof, velocity too, 1.0 m/s",
    "spoof, step of 3 m, then 0.3 m/s, velocity too",
    "jump of 100 m held for 180 s",
)
RIGHT = (  # the receiver is right, and something else is wrong
    "gyro z +0.2 rad/s for 1 s",
    "gyro z bias step 0.02 rad/s",
    "accelerometer x +2 m/s2 for 1 s",
    "all wheels read 3.6 times too high",
    "all wheels spin, + 30 % for 5 s, in 60 s without GNSS",
    "IMU silent for 1.6 s in 60 s without GNSS",
)


class Found(NamedTuple):
    """Worst error [m] during the attack, seconds dishonest, seconds of fixes that came and were not fused."""

    pulled: float
    dishonest: float
    lost: float


def one(name: str, cost: float, seed: int, run: int) -> Found:
    seen, judged = attacked(name, seed, run, spoof_cost=cost, dead_reckoning_cost=1.0)
    k = int(np.searchsorted(seen.t, begins(seed, run)))
    rejected = seen.rejected[f"{GNSS}.position"]
    return Found(judged.during, judged.dishonest, (rejected[-1] - rejected[k]) * FIX_S)


def costs(runs: int, seed: int) -> Section:
    section = Section("What a decision costs")
    section.say(
        f"{runs} drives as in *Attacks* for each cost and attack, seed {seed}: `spoof_cost` over `dead_reckoning_cost`, "
        f"against what it does. Pulled: the worst error while a receiver lies ({len(LIES)} kinds of spoof). Lost: seconds "
        f"of good fixes that are not fused, in a run in which something else is wrong ({len(RIGHT)} attacks). Dishonest: "
        "seconds of an error beyond 2 m and 3 sigmas, mean of a run."
    )
    assert set(LIES + RIGHT) <= set(ATTACKS)
    rows, curve = [], []
    for cost in COSTS:
        lies = spread(one, [(name, cost, seed, run) for run in range(runs) for name in LIES])
        right = spread(one, [(name, cost, seed, run) for run in range(runs) for name in RIGHT])
        pulled, lost = [f.pulled for f in lies], [f.lost for f in right]
        curve.append((float(np.mean(lost)), float(np.mean(pulled))))
        spoofed, trusted = (float(np.mean([f.dishonest for f in found])) for found in (lies, right))
        rows.append(
            (f"{cost:g}", f"{np.mean(pulled):.1f} m", f"{max(pulled):.1f} m", f"{spoofed:.1f} s",
             f"{np.mean(lost):.1f} s", f"{max(lost):.1f} s", f"{trusted:.1f} s")
        )  # fmt: skip
    head = ("cost", "pulled, mean", "worst", "dishonest", "lost, mean", "worst", "dishonest")
    section.table(head, rows)
    picture, axis = figure()
    axis.plot(*zip(*curve, strict=True), "o-", ms=3, lw=1)
    for cost, point in zip(COSTS, curve, strict=True):
        axis.annotate(f"{cost:g}", point, fontsize=7)
    axis.set_xlabel("good fixes lost [s a run]", fontsize=7)
    axis.set_ylabel("pulled by a spoof [m]", fontsize=7)
    section.picture("costs", "metres pulled by a spoof over seconds of good fixes lost, for each cost", picture)
    return section
