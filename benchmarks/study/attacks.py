"""Attacks on a drive of the simulator, and sensors that lie: the worst of what is published meanwhile and afterwards.

`python -m benchmarks.study.attacks [--only TEXT] [--runs N] [--first RUN] [--jobs N] [--trace FILE]` runs some of them.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.study.recorded import (
    DISHONEST_M,
    DISHONEST_SIGMAS,
    LOOK_S,
    Recorded,
    Watched,
    changed,
    town,
    watch,
    write_trace,
)
from benchmarks.study.report import Section
from benchmarks.study.tampering import (
    ACCEL,
    GYRO,
    Random,
    Tamper,
    adds,
    clipped,
    forged_wheels,
    frozen,
    inertial,
    jump,
    later,
    meaconed,
    nothing,
    outage,
    position_only,
    reads,
    silent,
    spoof,
    together,
    wheels,
    with_velocity,
)
from fusiond.estimator.solution import Mode
from fusiond.events import ImuSample, Received
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import WHEELS
from fusiond.simulation.wire import GNSS, IMU
from fusiond.units import SECOND

DRIVE_S = 400.0
EARLIEST_S, LATEST_S = 80.0, 120.0  # of the beginning of an attack: the filter has learnt its biases
AFTER_S = 60.0  # for which a run goes on after the attack
HALF_MINUTE, MINUTE, LONG = 30.0, 60.0, 180.0
MOST_USELESS_S = 5.0  # without a state, or with one that is lost, in an attack with limits
USELESS = (Mode.ALIGNING, Mode.LOST)
BACK_S = 5.0  # after an attack, until fixes are fused for good
RETURNED_S = 0.15  # after the end of an attack, until the last fix that it has touched has arrived
UNTOUCHED, DEAF, LONG_DEAF = "nothing", "60 s without GNSS", "180 s without GNSS"  # what the others are compared with
ALL = "wheels"  # of the sources that an attack aims at


class Attack(NamedTuple):
    """What is done, for how long [s], to which source; what it may cost at most: an error [m] beyond that of the reference
    in the last seconds, dishonest seconds; how long the run goes on after it [s]; the reference: the same drive untouched,
    or without the receiver that lies."""

    tamper: Tamper
    seconds: float
    aims: str = IMU
    most_m: float = math.inf
    most_s: float = math.inf
    after: float = AFTER_S
    reference: str = UNTOUCHED


def single(sensor: str, axes: str, value: float) -> Attack:
    return Attack(inertial(sensor, axes, reads(value), samples=1), 0.01, IMU, 1.0, 2.0)


def lying(tamper: Tamper, most_m: float = 5.0, seconds: float = LONG) -> Attack:
    return Attack(tamper, seconds, GNSS, most_m, 0.0, HALF_MINUTE, LONG_DEAF)


def _attacks() -> dict[str, Attack]:
    found = {UNTOUCHED: Attack(nothing, MINUTE, "")}
    for axis in "xyz":
        found[f"one sample: gyro {axis} 5 rad/s"] = single(GYRO, axis, 5.0)
    for axis in "xyz":
        found[f"one sample: gyro {axis} 34.9 rad/s"] = single(GYRO, axis, 34.9)
    found["one sample: gyro x 0.5 rad/s"] = single(GYRO, "x", 0.5)
    found["one sample: all gyros 34.9 rad/s"] = single(GYRO, "xyz", 34.9)
    for axis in "xyz":
        found[f"one sample: accelerometer {axis} 159 m/s2"] = single(ACCEL, axis, 159.0)
    found["one sample: all accelerometers 159 m/s2"] = single(ACCEL, "xyz", 159.0)
    found["five samples: all gyros 5 rad/s"] = Attack(inertial(GYRO, "xyz", reads(5.0), samples=5), 0.05, IMU, 5.0, 3.0)
    for axis in "xyz":
        found[f"gyro {axis} +0.2 rad/s for 1 s"] = Attack(inertial(GYRO, axis, adds(0.2), 1.0), 1.0, IMU, 5.0, 3.0)
    for axis in "xyz":
        found[f"gyro {axis} bias step 0.02 rad/s"] = Attack(inertial(GYRO, axis, adds(0.02)), MINUTE, IMU, 10.0, 5.0)
    for axis in "xyz":
        found[f"accelerometer {axis} +2 m/s2 for 1 s"] = Attack(inertial(ACCEL, axis, adds(2.0), 1.0), 1.0, IMU, 5.0, 3.0)
    found["gyro z frozen for 20 s"] = Attack(frozen(20.0, GYRO, "z"), 20.0, IMU, 10.0, 5.0)
    found["gyro frozen for 20 s"] = Attack(frozen(20.0, GYRO, "xyz"), 20.0, IMU, 10.0, 5.0)
    found["accelerometer x frozen for 20 s"] = Attack(frozen(20.0, ACCEL, "x"), 20.0, IMU, 10.0, 5.0)
    found["gyro z clipped at 0.1 rad/s"] = Attack(inertial(GYRO, "z", clipped(0.1)), MINUTE, IMU, 10.0, 5.0)
    found["gyro z at the end of its range for 2 s"] = Attack(inertial(GYRO, "z", reads(34.9), 2.0), 2.0, IMU, 10.0, 5.0)
    found["accelerometer x at the end of its range for 2 s"] = Attack(
        inertial(ACCEL, "x", reads(156.9), 2.0), 2.0, IMU, 10.0, 5.0
    )
    for rate in (0.2, 0.5, 1.0, 2.0):
        found[f"spoof, position only, {rate} m/s"] = lying(position_only(rate, LONG))
    for rate in (0.2, 0.5, 1.0, 2.0):
        found[f"spoof, velocity too, {rate} m/s"] = lying(with_velocity(rate, LONG), 5.0 if rate > 0.2 else math.inf)
    found["spoof, step of 3 m, then 0.3 m/s, velocity too"] = lying(with_velocity(0.3, LONG, 3.0), math.inf)
    found["jump of 100 m held for 180 s"] = lying(jump(100.0, LONG))
    wrong_velocity = spoof(lambda _: 0.0, lambda _: 3.0, HALF_MINUTE)
    found["velocity off by 3 m/s for 30 s"] = lying(wrong_velocity, seconds=HALF_MINUTE)
    found["old fixes, lag growing 50 ms/s"] = lying(meaconed(0.05, LONG))
    dead = outage(MINUTE)
    found[DEAF] = Attack(dead, MINUTE, GNSS)
    found[LONG_DEAF] = Attack(outage(LONG), LONG, GNSS, after=HALF_MINUTE)
    found["all wheels read 0"] = Attack(wheels(0.0, MINUTE), MINUTE, ALL)
    found["all wheels read 0 from 20 s before 60 s without GNSS"] = Attack(
        together(wheels(0.0, 80.0), later(20.0, dead)), 80.0, ALL, reference=DEAF
    )
    found["one wheel reads 0 from 20 s before 60 s without GNSS"] = Attack(
        together(wheels(0.0, 80.0, WHEELS[:1]), later(20.0, dead)), 80.0, WHEELS[0], reference=DEAF
    )
    found["one wheel reads 3.6 times too high"] = Attack(wheels(3.6, MINUTE, WHEELS[2:3]), MINUTE, WHEELS[2])
    found["all wheels read 3.6 times too high"] = Attack(wheels(3.6, MINUTE), MINUTE, ALL)
    found["all wheels spin, + 30 % for 5 s"] = Attack(wheels(1.3, 5.0), 5.0, ALL)
    found["all wheels locked for 2 s"] = Attack(wheels(0.0, 2.0), 2.0, ALL)
    found["all wheels spin, + 30 % for 5 s, in 60 s without GNSS"] = Attack(
        together(dead, later(20.0, wheels(1.3, 5.0))), MINUTE, ALL, reference=DEAF
    )
    found["all wheels locked for 2 s, in 60 s without GNSS"] = Attack(
        together(dead, later(20.0, wheels(0.0, 2.0))), MINUTE, ALL, reference=DEAF
    )
    found["forged wheel frames for 8 s"] = Attack(forged_wheels(25.0, 8.0, 70.0), 8.0, ALL, 5.0, 3.0)
    found["IMU silent for 1.6 s in 60 s without GNSS"] = Attack(
        together(dead, later(20.0, silent(ImuSample, 1.6))), MINUTE, IMU, reference=DEAF
    )
    return found


ATTACKS = _attacks()


class Found(NamedTuple):
    """One run: worst error [m] during the attack and after it, and by how much it exceeds that of the reference; worst error
    in sigmas; seconds dishonest and beyond three sigmas; seconds after the attack until fixes were fused for good, and the
    share of fixes fused after it; seconds until a source aimed at was no longer called nominal (inf: never), what it was
    called, other sources that were; modes; seconds without a state or with one that is called lost; whether a speed beyond
    v_max was published; resets."""

    during: float
    after: float
    excess: float
    sigmas: float
    dishonest: float
    beyond: float
    back: float
    share: float
    named: float
    called: str
    others: str
    modes: str
    useless: float
    too_fast: bool
    resets: int


def begins(seed: int, run: int) -> float:
    """When the attacks of a run begin [s]: at any instant of the drive's third half minute or so."""
    return float(np.random.default_rng([seed, run, 1]).uniform(EARLIEST_S, LATEST_S))


def tampered(name: str, drive: Recorded, begin: float, seed: int, run: int) -> list[Received]:
    random: Random = np.random.default_rng([seed, run, 2])
    return ATTACKS[name].tamper(drive.events, drive.start_ns + round(begin * SECOND), random)


def attacked(name: str, seed: int, run: int, trace: bool = False, **keys: Any) -> tuple[Watched, Found]:
    """One attack in the drive of one run; keys of [filter] in place of the defaults."""
    attack, drive, begin = ATTACKS[name], town(seed, run, DRIVE_S), begins(seed, run)
    end = begin + attack.seconds
    events = tampered(name, drive, begin, seed, run)
    found = watch(drive, events, end + attack.after, changed(drive.config, "filter", **keys), ratios=trace)
    other = reference(attack.reference, seed, run)[: len(found.t)]
    other = np.max([np.roll(other, k) for k in range(round(BACK_S / LOOK_S))], axis=0)  # its worst while GNSS may come back
    excess = (found.distance() - other)[int(np.searchsorted(found.t, begin)) :]
    return found, judged(found, attack, begin, drive.config.filter.v_max_mps, float(np.nanmax(excess, initial=0.0)))


@functools.lru_cache(maxsize=8)
def reference(name: str, seed: int, run: int) -> Array:
    """Horizontal error [m] at each look of the drive in which something else happens."""
    drive, begin = town(seed, run, DRIVE_S), begins(seed, run)
    return watch(drive, tampered(name, drive, begin, seed, run), begin + LONG + AFTER_S).distance()


def judged(found: Watched, attack: Attack, begin: float, v_max: float, excess: float) -> Found:
    t, distance, sigmas = np.array(found.t), found.distance(), found.sigmas()
    end = begin + attack.seconds
    since, during, after = t >= begin, (t >= begin) & (t < end), t >= end
    fused, rejected = (np.array(of[f"{GNSS}.position"]) for of in (found.fused, found.rejected))
    k = min(int(np.searchsorted(t, end + RETURNED_S)), len(t) - 1)
    taken, refused = int(fused[-1] - fused[k]), int(rejected[-1] - rejected[k])
    named, called, others = math.inf, Counter[str](), set()
    for source, statuses in found.statuses.items():
        bad = np.flatnonzero(since & (np.array(statuses) != "nominal"))
        if not len(bad):
            continue
        if source.split(".")[0] == attack.aims or (attack.aims == ALL and source in WHEELS):
            named = min(named, float(t[bad[0]] - begin))
            called.update(statuses[b] for b in bad)
        else:
            others.add(source)
    speeds = np.array(found.speeds)[since]
    return Found(
        during=float(np.nanmax(distance[during], initial=0.0)),
        after=float(np.nanmax(distance[after], initial=0.0)),
        excess=excess,
        sigmas=float(np.nanmax(sigmas[since])),
        dishonest=float((since & found.dishonest()).sum() * LOOK_S),
        beyond=float((since & (sigmas > DISHONEST_SIGMAS)).sum() * LOOK_S),
        back=found.returned(f"{GNSS}.position", end + RETURNED_S) + RETURNED_S,
        share=taken / max(1, taken + refused),
        named=named,
        called=called.most_common(1)[0][0] if called else "-",
        others=" ".join(sorted(others)),
        modes=" ".join(sorted({mode.value for mode, now in zip(found.modes, since, strict=True) if now} - {"nominal"})),
        useless=float(sum(mode in USELESS for mode, now in zip(found.modes, since, strict=True) if now) * LOOK_S),
        too_fast=bool((speeds > v_max).any()),
        resets=found.resets,
    )


def chunk(names: Sequence[str], seed: int, run: int) -> list[tuple[str, int, Found]]:
    return [(name, run, attacked(name, seed, run)[1]) for name in names]


def run_all(names: Sequence[str], seed: int, runs: Sequence[int], jobs: int | None = None) -> dict[str, dict[int, Found]]:
    """By attack and run. A process does all attacks of a run, or a part of them, so that it makes the drive once."""
    parts = max(1, min(len(names), 8 // len(runs)))  # few runs are parted, so that all processes work
    work = [(names[part::parts], seed, run) for run in runs for part in range(parts)]
    found: dict[str, dict[int, Found]] = {name: {} for name in names}
    if jobs == 1:
        results = [chunk(*one) for one in work]
    else:
        with ProcessPoolExecutor(jobs) as pool:
            results = list(pool.map(chunk, *zip(*work, strict=True)))
    for name, run, result in (row for rows in results for row in rows):
        found[name][run] = result
    return found


HEAD = ("attack", "worst during", "after", "more than the reference", "in sigmas", "dishonest", "beyond 3 sigma",
        "GNSS again", "fixes fused then", "named", "after, worst", "called", "other sources called bad", "modes", "lost",
        "v > v_max", "as it must")  # fmt: skip


def kept(attack: Attack, found: Found) -> bool:
    """Whether a run stays within what the attack may cost."""
    accurate = found.excess <= attack.most_m and found.dishonest <= attack.most_s
    return accurate and found.useless <= MOST_USELESS_S and not found.too_fast


def summary(name: str, found: dict[int, Found]) -> tuple[str, ...]:
    """The worst of all runs of one attack."""
    runs, attack = list(found.values()), ATTACKS[name]
    names = [f.named for f in runs if math.isfinite(f.named)]
    called = Counter(f.called for f in runs if f.called != "-").most_common(1)
    others = Counter(source for f in runs for source in f.others.split())
    modes = sorted({mode for f in runs for mode in f.modes.split()})
    good = sum(kept(attack, f) for f in runs)
    wanted = math.isfinite(attack.most_m) or math.isfinite(attack.most_s)
    return (
        name, f"{max(f.during for f in runs):.1f} m", f"{max(f.after for f in runs):.1f} m",
        f"{max(f.excess for f in runs):.1f} m", f"{max(f.sigmas for f in runs):.1f}",
        f"{max(f.dishonest for f in runs):.1f} s",
        f"{max(f.beyond for f in runs):.1f} s", f"{max(f.back for f in runs):.1f} s", f"{min(f.share for f in runs):.0%}",
        f"{len(names)} of {len(runs)}",
        f"{max(names):.1f} s" if names else "-", called[0][0] if called else "-",
        ", ".join(f"{source} {count}" for source, count in others.most_common(3)) or "none", ", ".join(modes) or "nominal",
        f"{max(f.useless for f in runs):.1f} s", str(sum(f.too_fast for f in runs)),
        f"{good} of {len(runs)}" if wanted else "",
    )  # fmt: skip


def attacks(runs: int, seed: int) -> Section:
    section = Section("Attacks")
    section.say(
        f"{runs} drives of the simulator, seed {seed}: town and road at 8 to 20 m/s with bends, slopes and stops; IMU "
        "100 Hz, four wheels 20 Hz, GNSS 5 Hz; the configuration is the one that the simulator writes, so the installer's "
        f"measurements and else the defaults. An attack begins between {EARLIEST_S:.0f} and {LATEST_S:.0f} s. What is "
        f"published is read ten times a second, from then until {AFTER_S:.0f} s after the attack ({HALF_MINUTE:.0f} s after "
        "a long one). Errors are horizontal, and the worst of all drives; an error in sigmas is its Mahalanobis distance "
        f"in the published covariance. Dishonest: the error exceeds {DISHONEST_M:.0f} m and {DISHONEST_SIGMAS:.0f} sigmas. "
        "GNSS again: seconds after the attack until fixes are fused for good, without a pause of more than a second. "
        "The reference: the same drive untouched; for a lying receiver, or in an outage, the same drive with no receiver. "
        "Named: the status of a source aimed at is no longer nominal. Lost: seconds without a state, or with one that is "
        "called lost. As it must: drives in which errors and dishonest time stay within what the attack may cost, and in "
        f"which at most {MOST_USELESS_S:.0f} s are lost."
    )
    found = run_all(list(ATTACKS), seed, range(runs))
    section.table(HEAD, [summary(name, of) for name, of in found.items()])
    return section


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.study.attacks", description=__doc__)
    parser.add_argument("--only", action="append", default=[], help="only attacks with this text in their name; may repeat")
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--each", action="store_true", help="print every run, not only the worst")
    parser.add_argument("--trace", type=Path, help="write what the first attack and run published into this CSV")
    parser.add_argument("--list", action="store_true", help="print the names of the attacks")
    options = parser.parse_args(arguments)
    names = [name for name in ATTACKS if not options.only or any(text in name for text in options.only)]
    if not names or options.list:
        print(*ATTACKS, sep="\n")
        return
    if options.trace:
        watched, result = attacked(names[0], options.seed, options.first, trace=True)
        write_trace(watched, options.trace)
        print(f"{names[0]}, run {options.first}, from {begins(options.seed, options.first):.2f} s: {result}")
        return
    found = run_all(names, options.seed, range(options.first, options.first + options.runs), options.jobs)
    print(f"{'attack':56} {'during':>8} {'after':>8} {'excess':>8} {'sigmas':>7} {'dishon.':>7} {'>3sig':>6} {'back':>5} "
          f"{'fused':>5}  {'named':>5} {'after':>6} called / others / modes")  # fmt: skip
    for name, of in found.items():
        row = [cell.removesuffix(" m").removesuffix(" s") for cell in summary(name, of)]
        worst = max(of, key=lambda run: (not kept(ATTACKS[name], of[run]), of[run].dishonest, of[run].during, of[run].after))
        numbers = " ".join(f"{cell:>{width}}" for cell, width in zip(row[1:9], (8, 8, 8, 7, 7, 6, 5, 5), strict=True))
        print(f"{name:56} {numbers}  {row[9].replace(' of ', '/'):>5} {row[10]:>6} {' / '.join(row[11:14])}"
              f"{' ' + row[14] + ' s' if row[14] != '0.0' else ''}{' / V>VMAX ' + row[15] if row[15] != '0' else ''}"
              f" | {'ok ' + row[16] if row[16] else '-'}"
              f" | worst: run {worst} at {begins(options.seed, worst):.2f} s", flush=True)  # fmt: skip
        if options.each:
            for run, one in of.items():
                print(f"    run {run:2d} at {begins(options.seed, run):6.2f} s: {one}")


if __name__ == "__main__":
    main(sys.argv[1:])
