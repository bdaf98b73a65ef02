"""Gaps: an inertial sensor that is silent while there is no GNSS, and GNSS that comes and goes."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from benchmarks.study.recorded import LOOK_S, SIGMAS_95, Recorded, town, watch
from benchmarks.study.report import Section
from benchmarks.study.runs import spread
from benchmarks.study.tampering import Tamper, edited, later, nothing, outage, silent, together
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Received, WheelSpeed
from fusiond.simulation.scenario import WHEELS
from fusiond.simulation.wire import GNSS
from fusiond.units import SECOND

BEGIN_S, OUTAGE_S, AFTER_S = 80.0, 60.0, 30.0
DRIVE_S = BEGIN_S + 2 * OUTAGE_S + AFTER_S + 10
IMU_S = 20.0  # into the outage, when the inertial sensor falls silent
FIX_S = 0.2  # spacing of the fixes
FOUR, TWO = WHEELS, WHEELS[2:]


class Gap(NamedTuple):
    """What is missing, for how long in all [s], and the wheels that are heard."""

    tamper: Tamper
    seconds: float = OUTAGE_S
    wheels: tuple[str, ...] = FOUR


def sparse(every: float, seconds: float) -> Tamper:
    """One fix in so many seconds."""

    def edit(event: Received, since: float) -> Received | None:
        left_out = isinstance(event.payload, GnssPosition | GnssVelocity) and since % every >= FIX_S
        return None if left_out else event

    return edited(lambda _: edit, seconds)


def _gaps() -> dict[str, Gap]:
    dead = outage(OUTAGE_S)
    found = {"nothing missing": Gap(nothing)}
    for name, heard in (("four wheels", FOUR), ("two rear wheels", TWO)):
        found[f"60 s without GNSS, {name}"] = Gap(dead, wheels=heard)
        for seconds in (0.5, 1.0, 1.6, 2.0):
            quiet = later(IMU_S, silent(ImuSample, seconds))
            found[f"the same, {seconds} s of it without IMU, {name}"] = Gap(together(dead, quiet), wheels=heard)
    found["60 s without GNSS, 30 s of it without wheels"] = Gap(together(dead, later(15.0, silent(WheelSpeed, 30.0))))
    found["2 s without IMU"] = Gap(silent(ImuSample, 2.0), 2.0)
    found["5 s without GNSS"] = Gap(outage(5.0), 5.0)
    found["20 s without GNSS"] = Gap(outage(20.0), 20.0)
    found["a fix every 10 s for 120 s"] = Gap(sparse(10.0, 2 * OUTAGE_S), 2 * OUTAGE_S)
    return found


GAPS = _gaps()


class Found(NamedTuple):
    """Error [m] at the end of the gap and the sigma [m] published for it; worst error; looks of the gap inside the 95 %
    ellipse, as a share; seconds dishonest; seconds until GNSS is fused again; error 5 s after; resets."""

    error: float
    sigma: float
    worst: float
    inside: float
    dishonest: float
    back: float
    after: float
    resets: int


def heard(drive: Recorded, wheels: tuple[str, ...]) -> Recorded:
    """The drive with some of its wheels only."""
    deaf = set(WHEELS) - set(wheels)
    kept = {name: wheel for name, wheel in drive.config.wheel.items() if name not in deaf}
    events = [event for event in drive.events if event.source not in deaf] if deaf else drive.events
    return Recorded(events, drive.truth, msgspec.structs.replace(drive.config, wheel=kept))


def one(seed: int, run: int) -> list[Found]:
    """All gaps in the drive of one run."""
    found = []
    whole = town(seed, run, DRIVE_S)
    for gap in GAPS.values():
        drive, end = heard(whole, gap.wheels), BEGIN_S + gap.seconds
        events = gap.tamper(drive.events, drive.start_ns + round(BEGIN_S * SECOND), np.random.default_rng(0))
        seen = watch(drive, events, end + AFTER_S, from_s=BEGIN_S)
        distance, inside = seen.distance(), seen.between(BEGIN_S, end)
        last = np.flatnonzero(inside)[-1]
        found.append(
            Found(
                float(distance[last]), float(seen.claimed()[last]), float(distance.max()),
                float((seen.sigmas()[inside] < SIGMAS_95).mean()), float(seen.dishonest().sum() * LOOK_S),
                seen.returned(f"{GNSS}.position", end), float(distance[int(last + 5 / LOOK_S)]), seen.resets,
            )
        )  # fmt: skip
    return found


def gaps(runs: int, seed: int) -> Section:
    section = Section("Gaps")
    section.say(
        f"{runs} drives of the simulator, as in *Attacks*, seed {seed}. A gap begins at {BEGIN_S:.0f} s; the IMU falls "
        f"silent {IMU_S:.0f} s into it. Inside: share of the looks (ten a second) during the gap at which the error lies in "
        "the published 95 % ellipse. Dishonest: the error exceeds 2 m and 3 sigmas."
    )
    rows = []
    for name, found in zip(GAPS, zip(*spread(one, [(seed, run) for run in range(runs)]), strict=True), strict=True):
        rms, claimed = (float(np.sqrt(np.mean(np.square(v)))) for v in ([f.error for f in found], [f.sigma for f in found]))
        rows.append(
            (name, f"{rms:.2f} m", f"{claimed:.2f} m", f"{max(f.worst for f in found):.1f} m",
             f"{np.mean([f.inside for f in found]):.0%}", f"{max(f.dishonest for f in found):.1f} s",
             f"{max(f.back for f in found):.1f} s", f"{max(f.after for f in found):.2f} m", sum(f.resets for f in found))
        )  # fmt: skip
    head = ("gap", "RMSE at its end", "claimed", "worst error", "inside 95 %", "dishonest, worst", "GNSS fused again, worst",
            "error 5 s later, worst", "resets")  # fmt: skip
    section.table(head, rows)
    return section
