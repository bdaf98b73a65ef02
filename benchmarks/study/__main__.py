"""`python -m benchmarks.study [part ...] [--runs N] [--seed S] [--out DIR]`: the evidence of docs/study.md."""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.study import (
    attacks,
    calibration,
    consistency,
    costs,
    delay,
    faults,
    ferry,
    gaps,
    heading,
    mismatch,
    outage,
    reboot,
    reckoning,
    rover,
    rtk,
    smoothing,
)
from benchmarks.study.report import Section, save
from fusiond import __version__

PARTS: dict[str, tuple[Callable[[int, int], Section], int]] = {  # and the number of runs of each
    "consistency": (consistency.consistency, 100),
    "bound": (consistency.bound, 100),
    "outage": (outage.outage, 20),
    "reckoning": (reckoning.reckoning, 40),
    "heading": (heading.heading, 100),
    "faults": (faults.faults, 20),
    "calibration": (calibration.calibration, 20),
    "ferry": (ferry.ferry, 10),
    "reboot": (reboot.reboot, 100),
    "attacks": (attacks.attacks, 20),
    "costs": (costs.costs, 3),
    "gaps": (gaps.gaps, 10),
    "mismatch": (mismatch.mismatch, 6),
    "rtk": (rtk.rtk, 10),
    "rover": (rover.rover, 20),
    "delay": (delay.delay, 10),
    "smoothing": (smoothing.smoothing, 24),
}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.study", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="which; default: all")
    parser.add_argument("--runs", type=int, help="runs of each part, in place of its own number")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of study.md and images/study")
    options = parser.parse_args(arguments)
    sections = {}
    for name in options.parts or PARTS:
        part, own_runs = PARTS[name]
        runs, begin = options.runs or own_runs, time.perf_counter()
        sections[name] = section = part(runs, options.seed)
        section.say(
            f"`python -m benchmarks.study {name} --runs {runs} --seed {options.seed}`: "
            f"{time.perf_counter() - begin:.0f} s on {os.cpu_count()} processors, "
            f"fusiond {__version__}, Python {platform.python_version()}, NumPy {np.__version__}."
        )
        print(section.text(), flush=True)
    save(sections, list(PARTS), options.out)


if __name__ == "__main__":
    main(sys.argv[1:])
