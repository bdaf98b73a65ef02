"""fusiond demo: the bundled drive, played to a daemon and explained."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from fusiond.app.commands.argument_types import positive
from fusiond.app.demo import demo
from fusiond_adapters.host import journal


def fill(parser: argparse.ArgumentParser) -> None:
    """The grammar."""
    parser.epilog = "examples:\n  fusiond demo --out out/demo\n  fusiond demo --publish --speed 1"
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("out/demo"), help="default: out/demo")
    parser.add_argument("--speed", metavar="X", type=positive, default=15.0, help="X times real time; default: 15")
    parser.add_argument("--publish", action="store_true", help="publish over Zenoh meanwhile: open `fusiond top` beside it")


def run(arguments: argparse.Namespace) -> None:
    """The action."""
    journal.set_up(logging.ERROR)  # what the daemon would log on the way is explained at the end
    demo.run(arguments.out, arguments.speed, publish=arguments.publish)
