"""fusiond smooth: the smoothed track of recorded logs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fusiond.app.colours import painted
from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.argument_types import rate
from fusiond.app.commands.arguments import add_config_and_logs, add_verbosity, taken_config
from fusiond.app.commands.replayed import add_circumstances, circumstances
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.summary import smoothed_lines, text, truth_lines
from fusiond.config import load as config

ABOUT = """\
Smooth the logs of one drive: replay them, and then work out each state from all that was measured, before and after it.
The track bridges outages from both sides, and leaves out what only the future shows to be wrong. For a drive that is
over: a live vehicle has no future yet. Needs room for temporary files of about 250 MB for an hour with four wheels."""
EXAMPLES = """\
examples:
  fusiond smooth car.toml drive.tlog drive.log --csv smoothed.csv
      write the smoothed track
  fusiond smooth car.toml drive.tlog drive.log --truth truth.csv --withhold gps0:12-22 --window 12-22
      how large are the errors in ten seconds without GNSS, of the filter and of the smoother?
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    add = parser.add_argument
    add_config_and_logs(parser)
    add_verbosity(parser, quiet="print warnings only, and no bar", verbose="print the summary of the replay, too")
    add("--csv", metavar="OUT.csv", type=Path, help="write the smoothed track: one row for each publication of the replay")
    add("--json", metavar="SUMMARY.json", type=Path, help="write the summary of the replay, with what the smoother gave")
    add_circumstances(parser)
    add("--rate", metavar="HZ", type=rate, help="states per second; default: publish.rate_hz of the config")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    name = taken_config(arguments)
    loaded = config.load(name)
    options = Options(
        config=loaded,
        config_name=Path(name).name,
        logs=arguments.logs,
        json=arguments.json,
        **circumstances(arguments, loaded),
        rate_hz=arguments.rate,
        smooth=True,
        smooth_csv=arguments.csv,
        bar=not arguments.quiet,
    )
    with config.located(name):
        summary = replay(options)
    if arguments.verbose:
        print(text(summary))
        return
    for warning in summary.warnings:
        print(painted(f"warning: {warning}", "yellow", sys.stderr), file=sys.stderr)
    if summary.smoothed and not arguments.quiet:
        if summary.truth:
            print("\n".join(truth_lines(summary.truth, "the filter's states ")))
        print("\n".join(smoothed_lines(summary.smoothed)))
