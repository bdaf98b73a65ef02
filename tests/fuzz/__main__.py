"""Runs the fuzzers: damaged input must raise nothing, hang nothing, and be accounted for to the last frame.

    python -m tests.fuzz [TARGET...] [--seed 1] [--seconds 60] [--case N]

Without `--seconds` each target tries its full number; with it, the time is shared evenly. A case is made by seed, target and
number alone: `--case N` runs one again. Exit status 1 where a case failed; it is printed with the command that repeats it.
"""

from __future__ import annotations

import argparse
import logging
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from types import FrameType

from tests.fuzz.targets import TARGETS, Target

CASE_LIMIT_S = 60  # a case takes a second at most on a quiet machine
MEMORY_BYTES = 3 << 30  # address space: what wants more raises MemoryError
FAILURES = 5  # of a target, after which it ends


class Stuck(Exception):
    """A case takes too long."""


def _stuck(_number: int, _frame: FrameType | None) -> None:
    raise Stuck(f"not done in {CASE_LIMIT_S} s")


def run(name: str, target: Target, seed: int, cases: range | None, ends: float | None) -> tuple[int, Counter[str], int]:
    """Run cases of a target until it has tried its full number or the time is over. Returns how many frames, texts or files
    were tried, the outcomes, and the number of cases that failed."""
    tried, failed, number = 0, 0, cases.start if cases else 0
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="fusiond-fuzz-") as folder:
        while (number in cases) if cases else (tried < target.full and (ends is None or time.monotonic() < ends)):
            signal.alarm(CASE_LIMIT_S)
            try:
                case = target.run(random.Random(f"{seed} {name} {number}"), Path(folder))
            except Exception:
                failed += 1
                print(f"FAILED: python -m tests.fuzz {name} --seed {seed} --case {number}")
                print(traceback.format_exc(), flush=True)
                if failed == FAILURES:
                    break
            else:
                tried += case.tried
                outcomes += case.outcomes
            finally:
                signal.alarm(0)
            number += 1
    return tried, outcomes, failed


def main(argv: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.split("\n\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; default: all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, help="for all targets together")
    parser.add_argument("--case", type=int, help="the number of one case")
    options = parser.parse_args(argv)
    names = options.targets or list(TARGETS)
    if unknown := set(names) - set(TARGETS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    signal.signal(signal.SIGALRM, _stuck)
    logging.disable()
    warnings.simplefilter("ignore", ResourceWarning)
    cases = None if options.case is None else range(options.case, options.case + 1)
    failures, began = 0, time.monotonic()
    print(f"seed {options.seed}", flush=True)
    for place, name in enumerate(names, 1):
        target, since = TARGETS[name], time.monotonic()
        ends = None if options.seconds is None else began + options.seconds * place / len(names)
        tried, outcomes, failed = run(name, target, options.seed, cases, ends)
        failures += failed
        listed = ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))
        seconds = time.monotonic() - since
        print(f"{name}: {tried} {target.about} in {seconds:.0f} s, {failed} cases failed; {listed}", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
