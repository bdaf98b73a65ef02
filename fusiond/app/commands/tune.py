"""fusiond tune: what a log tells of its noise, delays and installation, and a better configuration."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec

from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.arguments import add_config_and_logs, taken_config
from fusiond.app.replay.files import check_outputs, delivering
from fusiond.app.tuning.tune import text, tune

ABOUT = """\
Tell what the logs of one drive say of their own noise, delays and installation: each value with its uncertainty, and
whether the log can tell it at all. The first half of the log tells. Groups of values without which its spells without
GNSS are bridged better are not taken; how the others do in the second half is told. Writes the new configuration, and
shows the difference."""
EXAMPLES = """\
examples:
  fusiond tune car.toml drive.tlog drive.log -o tuned.toml
      write a better configuration; then compare: fusiond compare car.toml tuned.toml drive.tlog drive.log
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    add_config_and_logs(parser)
    parser.add_argument("-o", "--output", metavar="TUNED.toml", type=Path, help="write the new configuration")
    parser.add_argument("--json", metavar="OUT.json", type=Path, help="write what was found")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    name = taken_config(arguments)
    outputs = [path for path in (arguments.output, arguments.json) if path]
    check_outputs(outputs, [Path(name), *map(Path, arguments.logs)])
    found = tune(Path(name), arguments.logs)
    if arguments.output:
        with delivering(arguments.output):
            arguments.output.write_text(found.text, encoding="utf-8")
    if arguments.json:
        with delivering(arguments.json):
            arguments.json.write_bytes(msgspec.json.format(msgspec.json.encode(found), indent=2) + b"\n")
    print(text(found))
