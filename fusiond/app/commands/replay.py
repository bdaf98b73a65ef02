"""fusiond replay: fuses recorded logs."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from fusiond.app.colours import painted
from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.argument_types import positive, rate
from fusiond.app.commands.arguments import add_config_and_logs, add_verbosity, taken_config
from fusiond.app.commands.replayed import add_circumstances, circumstances
from fusiond.app.diagnosis.finding import exit_code, lines
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.outages import parse_length
from fusiond.app.replay.summary import details, text
from fusiond.config import load as config
from fusiond.errors import UsageError
from fusiond_adapters.host import journal

ABOUT = """\
Fuse the logs of one drive in their order of receipt, as in a live run: late measurements are put where they belong in
time. Prints a summary; the same inputs always give the same files, byte for byte."""
EXAMPLES = """\
examples:
  fusiond replay car.toml drive.tlog drive.log --csv track.csv
      fuse a MAVLink log and a candump log into a track
  fusiond replay car.toml drive.tlog drive.log --truth truth.csv --window 10-30 --plot errors.png
      compare seconds 10 to 30 with a reference, and draw the errors
  fusiond replay car.toml drive.tlog drive.log --truth truth.csv --withhold gps0:12-22 --window 12-22
      how large is the error after ten seconds without GNSS?
  fusiond replay car.toml drive.tlog drive.log --truth truth.csv --outage-length 1000m
      how large are the errors after 1000 m without GNSS, anywhere in the drive?
  fusiond replay car.toml drive.tlog drive.log --speed 1 --publish
      publish over Zenoh everything that `fusiond run` would, in real time: run `fusiond top` beside it
  fusiond replay car.toml drive.tlog drive.log --speed 1 --outputs
      test everything that the configuration turns on: ROS 2, Foxglove, Prometheus, ...
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    add = parser.add_argument
    add_config_and_logs(parser, ".tlog, .log (candump -L), .asc, .blf, .trc, ..., also .gz; or NAME=LOG")
    add_verbosity(parser, quiet="print warnings only, and no bar", verbose="print what was read, and the clocks, too")
    add("--csv", metavar="OUT.csv", type=Path, help="write the track: one row per publication")
    add("--json", metavar="SUMMARY.json", type=Path, help="write the summary")
    add_circumstances(parser)
    add("--mcap", metavar="OUT.mcap", type=Path, help="write everything published, for Foxglove (extra `mcap`)")
    add("--plot", metavar="OUT.png", type=Path, help="draw the track and, with --truth, its errors (extra `plot`)")
    add(
        "--outage-length",
        metavar="LENGTH",
        help="with --truth: replay again with GNSS withheld over many stretches of this length, such as 1000m or 60s, and"
        " tell the errors at their ends",
    )
    add("--smooth", metavar="OUT.csv", type=Path, help="smooth the drive as well, and write that track (`fusiond smooth`)")
    add("--rate", metavar="HZ", type=rate, help="publications per second; default: publish.rate_hz of the config")
    add("--speed", metavar="X", type=positive, help="replay at X times real time; default: as fast as possible")
    add("--publish", action="store_true", help="publish over Zenoh, as configured, everything that `fusiond run` publishes")
    add("--outputs", action="store_true", help="send to every output that the configuration turns on, including Zenoh")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    name = taken_config(arguments)
    loaded = config.load(name)
    if arguments.outage_length and not arguments.truth:
        raise UsageError("--outage-length compares with a truth: give --truth as well")
    if arguments.publish or arguments.outputs:
        journal.set_up(logging.WARNING)  # reports the loss of an output
    options = Options(
        config=loaded,
        config_name=Path(name).name,
        logs=arguments.logs,
        csv=arguments.csv,
        json=arguments.json,
        plot=arguments.plot,
        mcap=arguments.mcap,
        **circumstances(arguments, loaded),
        outage_length=parse_length(arguments.outage_length) if arguments.outage_length else None,
        rate_hz=arguments.rate,
        smooth=arguments.smooth is not None,
        smooth_csv=arguments.smooth,
        speed=arguments.speed,
        publish=arguments.publish,
        outputs=arguments.outputs,
        bar=not arguments.quiet,
    )
    with config.located(name):
        summary = replay(options)
    if arguments.quiet:
        for line in (*(f"warning: {warning}" for warning in summary.warnings), *lines(summary.findings)):
            print(painted(line, "yellow", sys.stderr), file=sys.stderr)
    else:
        print(text(summary))
    if arguments.verbose:
        print("\n".join(details(summary)))
    return exit_code(summary.findings)
