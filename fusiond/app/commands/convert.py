"""fusiond convert: writes public drives of others as logs that fusiond reads."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.argument_types import positive, seconds
from fusiond.app.convert import FORMS, Wanted, converter
from fusiond.errors import UsageError

ABOUT = """\
Write a public drive as logs: drive.tlog, drive.candump.log where it has CAN frames, and its reference as truth.csv. Only the
form is changed. The forms:"""
EXAMPLES = """\
examples:
  fusiond convert comma2k19 comma2k19/Example_1 -o rav4 --stop 30
      the first 30 s of the sample segment, as in the README
  fusiond convert kitti 2011_09_26/2011_09_26_drive_0005_extract -o kitti
      a drive of KITTI's raw data, with a configuration
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    forms = "\n".join(f"  {name:<12}{about}" for name, about in FORMS.items())
    parser.description, parser.epilog = f"{ABOUT}\n{forms}", f"{EXAMPLES}\n{EXIT_CODES}"
    add = parser.add_argument
    add("form", choices=FORMS, help="the form of the drive")
    add("folder", metavar="FOLDER", type=Path, help="the drive's folder, as it was downloaded")
    add("-o", "--out", metavar="OUT", required=True, type=Path, help="folder to write to; created if missing")
    add("--start", metavar="S", type=seconds, default=0.0, help="begin so many seconds after the first inertial sample")
    add("--stop", metavar="S", type=positive, default=math.inf, help="end so many seconds after it")
    add("--arrival", action="store_true", help="stamp fixes with the boot time of their arrival, as most autopilots do")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    if arguments.stop <= arguments.start:
        raise UsageError(f"--stop {arguments.stop:g} is not after --start {arguments.start:g}")
    wanted = Wanted(arguments.folder, arguments.out, arguments.start, arguments.stop, arguments.arrival)
    for path in converter(arguments.form)(wanted):
        print(f"{path}  {path.stat().st_size / 1e3:.0f} kB")
