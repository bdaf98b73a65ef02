"""Each calibration state's error against its sigma, over time."""

from __future__ import annotations

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.consistency import study
from benchmarks.study.report import Section, figure
from benchmarks.study.runs import BLOCKS

AT_S = (5, 15, 30, 60, 110)
ROUNDS = 2
NAVIGATION = ("position", "velocity", "attitude")


def calibration(runs: int, seed: int) -> Section:
    found = study(nominal.config(), runs, seed, ROUNDS)
    section = Section("Calibration and bias states")
    section.say(
        f"{runs} runs of the nominal drive, seed {seed}: RMSE per axis / claimed sigma at some instants, and the share of "
        "all errors within 2 sigma (95.4 % for an honest filter)."
    )
    blocks = {name: block for name, block in BLOCKS.items() if name not in NAVIGATION}
    rows = []
    picture, axes = figure(len(blocks))
    for axis, (name, block) in zip(axes, blocks.items(), strict=True):
        error = found.errors[:, :, block]
        sigma = np.sqrt(np.einsum("rtii->rti", found.claimed[:, :, block, block]))
        rmse, claimed = np.sqrt((error**2).mean(axis=(0, 2))), np.sqrt((sigma**2).mean(axis=(0, 2)))
        at = [f"{rmse[s]:.3g} / {claimed[s]:.3g}" for s in AT_S]
        rows.append((name, *at, f"{np.mean(np.abs(error) <= 2 * sigma):.1%}"))
        axis.semilogy(found.looks, rmse, lw=1, label="RMSE")
        axis.semilogy(found.looks, claimed, lw=1, ls="--", label="claimed")
        axis.set_title(name, fontsize=8)
    axes[0].legend(fontsize=6)
    section.table(("state", *(f"{s} s" for s in AT_S), "within 2 sigma"), rows)
    section.picture("calibration", "error and claimed sigma of each calibration state over time", picture)
    return section
