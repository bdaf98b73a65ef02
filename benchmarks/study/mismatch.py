"""Mismatch: a configuration that is wrong about the sensors. Is what is published still honest, and does the health tell?"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.study.recorded import SIGMAS_95, Recorded, changed, recorded, scenario, watch
from benchmarks.study.report import Section
from benchmarks.study.runs import spread
from fusiond.config.schema import Config

DRIVE_S, FROM_S = 300.0, 60.0
RECEIVER: dict[str, Any] = {
    "sigma_m": 0.3,
    "height_sigma_m": 0.6,
    "drift_sigma_m": 0.8,
    "height_drift_sigma_m": 1.6,
    "correlation_s": 20.0,
    "velocity_correlation_s": 2.0,
    "report_accuracy": False,
}
SPOKEN = 0.05  # share of the time at which a source is not nominal, from which on the health says something


Mistake = Callable[[Config], Config]


def mistake(table: str, keys: Sequence[str], new: Any) -> Mistake:
    """Keys of a table are put to a value, or changed by a function."""
    return lambda config: changed(config, table, **dict.fromkeys(keys, new))


def times(factor: float) -> Callable[[float], float]:
    return lambda right: right * factor


NOISES = {
    "GNSS position sigma": ("gnss", ("position_sigma_m", "height_sigma_m")),
    "GNSS velocity sigma": ("gnss", ("velocity_sigma_mps",)),
    "wheel sigma": ("wheel", ("sigma_mps",)),
    "gyro noise": ("imu", ("gyro_noise",)),
    "accelerometer noise": ("imu", ("accel_noise",)),
}
TIMES = {
    "GNSS position correlation": ("gnss", ("position_correlation_s",)),
    "GNSS velocity correlation": ("gnss", ("velocity_correlation_s",)),
}


def _cases() -> dict[str, Mistake]:
    found: dict[str, Mistake] = {"as it is": lambda config: config}
    for name, (table, keys) in NOISES.items():
        for factor, size in ((3.0, "x 3"), (2.0, "x 2"), (1 / 2, "/ 2"), (1 / 3, "/ 3")):
            found[f"{name} {size}"] = mistake(table, keys, times(factor))
    for name, (table, keys) in TIMES.items():
        for factor, size in ((4.0, "x 4"), (1 / 4, "/ 4"), (0.0, "0")):
            found[f"{name} {size}"] = mistake(table, keys, times(factor))
    found["both correlations 0"] = mistake("gnss", ("position_correlation_s", "velocity_correlation_s"), 0.0)
    for delay in (20.0, 50.0):
        found[f"GNSS delay off by {delay:.0f} ms"] = mistake("gnss", ("delay_ms",), delay)
    found["antenna off by 0.5 m"] = mistake("gnss", ("lever_arm_m",), lambda right: (right[0] + 0.5, *right[1:]))
    return found


CASES = _cases()


class Found(NamedTuple):
    """Root mean square error [m], share inside the 95 % ellipse, mean NEES over its degrees of freedom; by source the share
    of time at which it was not nominal; resets."""

    rmse: float
    inside: float
    nees: float
    bad: dict[str, float]
    resets: int


@functools.lru_cache(maxsize=2)
def drive(seed: int, run: int) -> Recorded:
    random = np.random.default_rng([seed, run, 3])
    return recorded(scenario(random, DRIVE_S, gnss=RECEIVER), int(random.integers(1 << 31)))


def one(seed: int, run: int) -> list[Found]:
    """All cases in the drive of one run."""
    found, made = [], drive(seed, run)
    for wrong in CASES.values():
        seen = watch(made, made.events, config=wrong(made.config), from_s=FROM_S)
        rows = seen.between(FROM_S, DRIVE_S)
        sigmas, distance = seen.sigmas()[rows], seen.distance()[rows]
        rmse, nees = float(np.sqrt(np.mean(distance**2))), float(np.mean(sigmas**2)) / 2
        found.append(Found(rmse, float((sigmas < SIGMAS_95).mean()), nees, seen.bad(rows), seen.resets))
    return found


def mismatch(runs: int, seed: int) -> Section:
    section = Section("Mismatch: a configuration that is wrong")
    section.say(
        f"{runs} drives of the simulator, seed {seed}, with a receiver whose errors last: position 0.3 m white and 0.8 m "
        "over 20 s, velocity 0.08 m/s over 2 s; it reports no accuracy. The configuration has one number multiplied by a "
        f"factor. Errors are horizontal, ten looks a second from {FROM_S:.0f} s on. Worst: the drive with the smallest "
        f"share inside. Health: sources that are not nominal for more than {SPOKEN:.0%} of the time in any drive, with the "
        "mean share of time."
    )
    rows = []
    for name, found in zip(CASES, zip(*spread(one, [(seed, run) for run in range(runs)]), strict=True), strict=True):
        spoken = {s: [f.bad[s] for f in found] for s in found[0].bad}
        said = [f"{source} {np.mean(shares):.0%}" for source, shares in spoken.items() if max(shares) > SPOKEN]
        rows.append(
            (name, f"{np.sqrt(np.mean([f.rmse**2 for f in found])):.2f} m", f"{np.mean([f.inside for f in found]):.1%}",
             f"{min(f.inside for f in found):.0%}", f"{np.mean([f.nees for f in found]):.2f}", ", ".join(said) or "nothing",
             sum(f.resets for f in found))
        )  # fmt: skip
    section.table(("configured", "RMSE", "inside 95 %", "worst", "NEES / 2", "what the health says", "resets"), rows)
    return section
