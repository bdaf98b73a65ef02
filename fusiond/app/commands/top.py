"""fusiond top: a running vehicle in the terminal."""

from __future__ import annotations

import argparse

from fusiond.app.client import ClientError
from fusiond.app.commands import EXIT_CODES
from fusiond.app.top import terminal
from fusiond.errors import OutputError

ABOUT = """\
Show the state of a running vehicle, what becomes of the measurements of each source, latencies, inputs, outputs and the
latest events, as published over Zenoh. Yellow: look at it; red: out of order. q ends it. Without a terminal: one screen."""


def fill(parser: argparse.ArgumentParser) -> None:
    """The grammar."""
    parser.description, parser.epilog = ABOUT, f"example:\n  fusiond top --connect tcp/192.168.1.5:7447\n\n{EXIT_CODES}"
    parser.add_argument("--vehicle", metavar="NAME", help="which one; default: the only one that is there")
    parser.add_argument(
        "--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447", help="fusiond or router; default: %(default)s"
    )
    parser.add_argument("--zenoh", metavar="FILE", help="Zenoh's own configuration file, for TLS and the like")
    parser.add_argument("--once", action="store_true", help="print one screen as text, and end")


def run(arguments: argparse.Namespace) -> None:
    """The action."""
    try:
        terminal.run(arguments.connect, arguments.vehicle, arguments.zenoh, just_once=arguments.once)
    except ClientError as error:
        raise OutputError(str(error)) from error
