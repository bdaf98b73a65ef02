"""fusiond demo: plays the bundled drive to a daemon, and explains the result."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from fusiond.app.commands.argument_types import positive
from fusiond.app.demo import demo
from fusiond_adapters.host import journal


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = "examples:\n  fusiond demo --out out/demo\n  fusiond demo --publish --speed 1"
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("out/demo"), help="default: out/demo")
    parser.add_argument("--speed", metavar="X", type=positive, default=15.0, help="X times real time; default: 15")
    parser.add_argument("--publish", action="store_true", help="publish over Zenoh meanwhile: run `fusiond top` beside it")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    journal.set_up(logging.ERROR)  # the explanation at the end covers what the daemon would log
    demo.run(arguments.out, arguments.speed, publish=arguments.publish)
