"""Calibration and bias states: the error of each against its sigma, over time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.consistency import LOOK_PHASE_S, Study, study
from benchmarks.study.report import Section, figure
from fusiond.config.schema import Config
from fusiond.filter.state import (
    ACCEL_BIAS,
    ANTENNA_ERROR,
    DELAYS_ERROR,
    FURTHER_SCALES_ERROR,
    GYRO_BIAS,
    MOUNT_ERROR,
    SCALE,
)
from fusiond.maths.typed import Array

AT_S = (5, 15, 30, 60, 115)
ROUNDS = 2
LEVER_M, DELAY_MS, VELOCITY_DELAY_MS = 0.3, 80.0, 40.0  # first sigmas
LEARNT: dict[str, dict[str, Any]] = {
    "filter": {"wheel_scale_by": "wheel"},
    "motion": {"interval_s": 1.0},  # slip that changes within a delay would hide it
    "gnss": {"lever_arm_sigma_m": LEVER_M, "delay_sigma_ms": DELAY_MS, "velocity_delay_sigma_ms": VELOCITY_DELAY_MS},
}


class Shown(NamedTuple):
    """A row of the table: the error states, and the factor from SI to the unit shown."""

    states: tuple[int, ...]
    scale: float = 1.0


MILLI, DEGREES = 1e3, 180 / np.pi
ROWS = {
    "wheel scale, front left [%]": Shown((SCALE.start,), 100.0),
    "wheel scale, front right [%]": Shown((FURTHER_SCALES_ERROR.start,), 100.0),
    "wheel scale, rear left [%]": Shown((FURTHER_SCALES_ERROR.start + 1,), 100.0),
    "wheel scale, rear right [%]": Shown((FURTHER_SCALES_ERROR.start + 2,), 100.0),
    "mount pitch [deg]": Shown((MOUNT_ERROR.start,), DEGREES),
    "mount yaw [deg]": Shown((MOUNT_ERROR.start + 1,), DEGREES),
    "lever arm, forward [m]": Shown((ANTENNA_ERROR.start,)),
    "lever arm, right [m]": Shown((ANTENNA_ERROR.start + 1,)),
    "lever arm, down [m]": Shown((ANTENNA_ERROR.start + 2,)),
    "GNSS delay [ms]": Shown((DELAYS_ERROR.start,), MILLI),
    "velocity delay, more [ms]": Shown((DELAYS_ERROR.start + 1,), MILLI),
    "gyro bias, 3 axes [deg/s]": Shown(tuple(range(GYRO_BIAS.start, GYRO_BIAS.stop)), DEGREES),
    "accelerometer bias, 3 axes [m/s^2]": Shown(tuple(range(ACCEL_BIAS.start, ACCEL_BIAS.stop))),
}


def config() -> Config:
    return nominal.config(**LEARNT)


def calibration(runs: int, seed: int) -> Section:
    found = study(config(), runs, seed, ROUNDS)
    section = Section("Calibration and bias states")
    section.say(
        f"{runs} runs of the nominal drive (but slip changes every 1 s, not every 0.1 s) with all states learnt at once and "
        f"true values drawn from the initial sigmas ({LEVER_M} m, {DELAY_MS:.0f} ms, {VELOCITY_DELAY_MS:.0f} ms, 1 %, "
        f"1 deg), seed {seed}. Each cell is RMSE / claimed sigma at an instant. Worst: the largest error of any run at the "
        "last instant, in sigmas. Within 2 sigma: the share of all errors (95.4 % for a consistent filter)."
    )
    rows = []
    picture, axes = figure(4)
    curves = ("wheel scale, rear left [%]", "mount yaw [deg]", "lever arm, right [m]", "GNSS delay [ms]")
    for name, shown in ROWS.items():
        error, sigma = errors(found, shown)
        rmse, claimed = np.sqrt((error**2).mean(axis=(0, 2))), np.sqrt((sigma**2).mean(axis=(0, 2)))
        looks = [int(np.argmin(np.abs(np.array(found.looks) - second - LOOK_PHASE_S))) for second in AT_S]
        at = [f"{rmse[i]:.3g} / {claimed[i]:.3g}" for i in looks]
        worst = np.max(np.abs(error[:, looks[-1]]) / sigma[:, looks[-1]])
        rows.append((name, *at, f"{worst:.1f}", f"{np.mean(np.abs(error) <= 2 * sigma):.1%}"))
        if name in curves:
            axis = axes[curves.index(name)]
            axis.semilogy(found.looks, rmse, lw=1, label="RMSE")
            axis.semilogy(found.looks, claimed, lw=1, ls="--", label="claimed")
            axis.set_title(name, fontsize=7)
    axes[0].legend(fontsize=6)
    section.table(("state", *(f"{s} s" for s in AT_S), "worst, sigmas", "within 2 sigma"), rows)
    section.picture("calibration", "error and claimed sigma of calibration states over time", picture)
    return section


def errors(found: Study, shown: Shown) -> tuple[Array, Array]:
    """Errors and claimed sigmas (runs, looks, states) in the row's unit."""
    states = list(shown.states)
    variance = np.stack([found.claimed[:, :, i, i] for i in states], axis=-1)
    return found.errors[:, :, states] * shown.scale, np.sqrt(variance) * shown.scale
