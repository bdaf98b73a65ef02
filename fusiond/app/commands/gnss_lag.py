"""fusiond gnss_lag: how much GNSS speed lags behind wheel speed in logs."""

from __future__ import annotations

import argparse

from fusiond.app.commands.arguments import add_config_and_logs, taken_config
from fusiond.app.inspection.drive import Drive, lag
from fusiond.config import load as config
from fusiond.errors import UnusableError
from fusiond_adapters.logs.merge import open_logs

ABOUT = """\
Measure how much the speed of GNSS lags behind that of the wheels in the logs of a drive, beyond the configured delays: where
the speed changes, the two fit best when shifted by it. The scale of the wheels is free."""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, "example:\n  fusiond gnss_lag car.toml drive.tlog drive.log"
    add_config_and_logs(parser, "as for replay")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    loaded = config.load(taken_config(arguments))
    drive = Drive(loaded, open_logs(arguments.logs, loaded))
    found = lag(drive.gnss_speed(), drive.wheel_speed())
    if found is None:
        raise UnusableError("too few speeds of GNSS and of wheels at the same time, or the speed does not change")
    lag_s, misfit = found
    print(f"GNSS speed lags by {1e3 * lag_s:.0f} ms beyond the configured delays; misfit {misfit:.3f} m/s")
