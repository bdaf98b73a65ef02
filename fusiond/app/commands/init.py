"""fusiond init: a configuration to start from, without a log."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.inspect import copy_beside, write
from fusiond.app.presets import FOLDER, names, preset
from fusiond.errors import UsageError

ABOUT = """\
Write a configuration to start from: an autopilot by MAVLink with its IMU and GNSS, and with --car the wheel speeds of a
maker of cars, whose DBC file is written beside it. With a log, `fusiond inspect --write-config` finds more."""
BARE = """\
# A vehicle with an autopilot by MAVLink. Measure every position from the IMU, below, on your vehicle.
# docs/configuration.md explains each key; wheel speeds of a car: fusiond init --car NAME.

[vehicle]
name = "vehicle"

[motion]
point_m = [-0.9, 0.0, 0.6]          # middle of the unsteered axle from the IMU: forward, right, down [m]

[mavlink.autopilot]
connection = "/dev/ttyACM0,115200"
system = 0                          # the first autopilot heard

[imu.imu0]
link = "autopilot"

[gnss.gps0]
link = "autopilot"
lever_arm_m = [0.2, 0.0, -0.9]      # antenna from the IMU [m]
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"example:\n  fusiond init --car toyota car.toml\n\n{EXIT_CODES}"
    parser.add_argument("target", metavar="C.toml", nargs="?", default="car.toml", help="file to write [%(default)s]")
    parser.add_argument("--car", metavar="NAME", choices=names(), help=f"wheel speeds of {', '.join(names())}")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    target = Path(arguments.target)
    if target.exists():
        raise UsageError(f"{target} is there already; choose another name")
    text = BARE if arguments.car is None else preset(arguments.car).read_text(encoding="utf-8")
    write(target, text)
    copied = copy_beside(target, [path for path in FOLDER.glob("*.dbc") if f'"{path.name}"' in text])
    written = ", ".join(map(str, (target, *copied)))
    print(f"written: {written}; next: measure the positions in it, then fusiond check {target}")
