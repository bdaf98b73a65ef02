"""fusiond doctor: finds what the data of recorded logs say against a configuration."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fusiond.app.colours import painted
from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.arguments import add_config_and_logs, add_verbosity, taken_config
from fusiond.app.commands.check import warnings
from fusiond.app.diagnosis.finding import exit_code, lines
from fusiond.app.replay.examination import examine
from fusiond.app.replay.summary import text
from fusiond.config import load as config

ABOUT = """\
Replay the logs of a drive, and name what in the configuration the data contradict: units, signs, signals, axes, mount,
delays, lever arms, senders, sigmas; or why there is no state. Each finding has the number behind it, and the line of the
configuration to change. What `fusiond check` warns of is repeated. See docs/doctor.md."""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description = ABOUT
    parser.epilog = f"example:\n  fusiond doctor car.toml drive.tlog drive.log\n\n{EXIT_CODES}"
    add_config_and_logs(parser, "as for replay")
    parser.add_argument("--json", metavar="SUMMARY.json", type=Path, help="write the replay's summary, with the findings")
    add_verbosity(parser, quiet="print findings only, and no bar", verbose="print the replay's summary too")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    name = taken_config(arguments)
    loaded = config.load(name)
    with config.located(name):
        odd = warnings(loaded)
        summary = examine(loaded, Path(name).name, arguments.logs, bar=not arguments.quiet, json=arguments.json)
    if arguments.verbose:
        print(text(summary) + "\n")
    for line in lines(summary.findings):
        print(painted(line, "red", sys.stdout) if line.startswith("found") else line)
    if not arguments.quiet:
        for warning in odd:
            print(painted(f"check warns: {warning}", "yellow", sys.stdout))
        if not summary.findings:
            print(f"{summary.span.seconds:.0f} s of data contradict nothing in {name}")
    return exit_code(summary.findings)
