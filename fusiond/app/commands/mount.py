"""fusiond mount: the mounting angles of the IMU."""

from __future__ import annotations

import argparse
import sys

from fusiond.app.commands.arguments import add_config_and_logs, taken_config
from fusiond.app.mounting.report import text
from fusiond.app.mounting.rotation import find
from fusiond.app.mounting.windows import Gathering
from fusiond.app.progress import shown
from fusiond.config import load as config
from fusiond.timeline.clock import Clock
from fusiond_adapters.logs.merge import open_logs

ABOUT = """\
Estimate the rotation of the IMU against forward-right-down from the logs of a drive, and print the rotation_deg to
configure: any rotation, upside down included. With that configured, a second run shows the remaining rotation. The drive
needs a minute or more, mostly forward, with pulling away, braking, and bends both ways. The configuration is not changed."""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, "example:\n  fusiond mount car.toml drive.tlog drive.log"
    add_config_and_logs(parser, "as for replay")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    loaded = config.load(taken_config(arguments))
    ((name, imu),) = loaded.imu.items()
    logs, clock, gathering = open_logs(arguments.logs, loaded), Clock(loaded), Gathering(loaded)
    progress = shown(logs, lambda: logs.bytes_read / logs.bytes_total, lambda: gathering.elapsed_ns, sys.stderr)
    for received in progress:
        if clock.steps_back(received):
            clock.forget()
            gathering.begin_session(received.t_receive_ns)
        measurement = clock.align(received)
        if measurement is not None:
            gathering.add(measurement)
    print(text(find(gathering.windows(), imu.rotation_deg), name))
