"""RTK: a receiver whose fixes change between single, DGPS, float and fixed, each with its own accuracy and bias."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import msgspec
import numpy as np

from benchmarks.study.recorded import LOOK_S, SIGMAS_95, Recorded, changed, installed, recorded, scenario, watch
from benchmarks.study.report import Section
from benchmarks.study.runs import spread
from fusiond.config.schema import Config
from fusiond.simulation.wire import GNSS

DRIVE_S = 300.0
SETTLED_S = 5.0  # after a change of the fix type, until errors count as those of the new one
ERRORS: dict[str, tuple[float, float]] = {  # m: white noise, and sigma of the bias, horizontal, per axis
    "single": (0.4, 1.0),
    "dgps": (0.2, 0.4),
    "float": (0.05, 0.3),
    "fixed": (0.01, 0.01),
}
CHANGES = [(0, "fixed"), (80, "float"), (110, "fixed"), (140, "single"), (170, "dgps"), (200, "float"), (230, "fixed")]
STEADY = [(0, "fixed")]
VELOCITY = {"velocity_sigma_mps": 0.05, "velocity_correlation_s": 2.0}
FROM_S = 60.0


class Case(NamedTuple):
    """The fix types with their beginnings [s], the receiver's further keys, those of the IMU; wheels; GNSS keys off."""

    changes: list[tuple[int, str]]
    gnss: dict[str, Any] = {}  # noqa: RUF012 never changed
    imu: dict[str, Any] = {}  # noqa: RUF012
    wheels: bool = True
    delay_ms: float = 0.0


CASES = {
    "fixed all the time": Case(STEADY),
    "fixed all the time, no wheels": Case(STEADY, wheels=False),
    "fixed, no wheels, mount off by 0.2 deg": Case(STEADY, imu={"mount_deg": [0.2, 0.2, 0.2]}, wheels=False),
    "fixed, no wheels, delay off by 20 ms": Case(STEADY, wheels=False, delay_ms=20.0),
    "changing": Case(CHANGES),
    "changing, no wheels": Case(CHANGES, wheels=False),
    "changing, no accuracies given": Case(CHANGES, gnss={"report_accuracy": False}),
}


class Found(NamedTuple):
    """By fix type the square errors (N,) [m^2] and whether each lies in its 95 % ellipse; the longest time without a fused
    position [s], share of positions rejected, share of time at which a GNSS source was not nominal, resets."""

    squares: dict[str, list[float]]
    inside: dict[str, list[bool]]
    pause: float
    rejected: float
    bad: float
    resets: int


@functools.lru_cache(maxsize=2)
def drive(name: str, seed: int, run: int) -> tuple[Recorded, Config]:
    random, case = np.random.default_rng([seed, run, 4]), CASES[name]
    quality = [
        {"start_s": start, "fix": kind, "sigma_m": ERRORS[kind][0], "bias_sigma_m": ERRORS[kind][1]}
        for start, kind in case.changes
    ]
    gnss = VELOCITY | {"quality": quality} | case.gnss
    made = recorded(scenario(random, DRIVE_S, gnss=gnss, imu=case.imu), int(random.integers(1 << 31)))
    config = changed(installed(made.config), "gnss", delay_ms=case.delay_ms)
    if case.wheels:
        return made, config
    events = [event for event in made.events if event.source not in config.wheel]
    return Recorded(events, made.truth, made.config), msgspec.structs.replace(config, wheel={})


def one(name: str, seed: int, run: int) -> Found:
    made, config = drive(name, seed, run)
    seen = watch(made, made.events, config=config, from_s=FROM_S)
    squares, sigmas = seen.distance() ** 2, seen.sigmas()
    by_type: dict[str, list[float]] = {kind: [] for kind in ERRORS}
    inside: dict[str, list[bool]] = {kind: [] for kind in ERRORS}
    changes = CASES[name].changes
    for (start, kind), stop in zip(changes, [*(start for start, _ in changes[1:]), DRIVE_S], strict=True):
        rows = seen.between(start + SETTLED_S, stop)
        by_type[kind] += squares[rows].tolist()
        inside[kind] += (sigmas[rows] < SIGMAS_95).tolist()
    source = f"{GNSS}.position"
    fused, rejected = np.array(seen.fused[source]), np.array(seen.rejected[source])
    instants = np.flatnonzero(np.diff(fused) > 0)
    pause = float(np.diff([0, *instants, len(fused) - 1]).max() * LOOK_S)
    taken, refused = fused[-1] - fused[0], rejected[-1] - rejected[0]
    bad = max(share for of, share in seen.bad(seen.between(0, DRIVE_S)).items() if of.startswith(GNSS))
    return Found(by_type, inside, pause, float(refused / max(1, taken + refused)), bad, seen.resets)


def rtk(runs: int, seed: int) -> Section:
    section = Section("RTK: fix types and their changes")
    kinds = ", ".join(f"{kind} {white:g} and {bias:g} m" for kind, (white, bias) in ERRORS.items())
    schedule = ", ".join(f"{kind} from {start} s" for start, kind in CHANGES)
    section.say(
        f"{runs} drives of the simulator, seed {seed}. White noise and bias by fix type: {kinds}; the bias is drawn anew at "
        f"each change. Changing: {schedule}. The configuration has the installation's measurements and nothing of the "
        f"receiver's noise. RMSE: horizontal, from {FROM_S:.0f} s on, by fix type, from {SETTLED_S:.0f} s after each "
        "change; in brackets the share inside the published 95 % ellipse."
    )
    rows = []
    for name in CASES:
        found = spread(one, [(name, seed, run) for run in range(runs)])
        cells = []
        for kind in ERRORS:
            squares = [value for f in found for value in f.squares[kind]]
            inside = [value for f in found for value in f.inside[kind]]
            cells.append(f"{np.sqrt(np.mean(squares)):.3f} m ({np.mean(inside):.0%})" if squares else "")
        rows.append(
            (name, *cells, f"{max(f.pause for f in found):.1f} s", f"{np.mean([f.rejected for f in found]):.1%}",
             f"{np.mean([f.bad for f in found]):.1%}", sum(f.resets for f in found))
        )  # fmt: skip
    head = ("receiver", *ERRORS, "longest without a fused fix", "fixes rejected", "GNSS not nominal", "resets")
    section.table(head, rows)
    return section
