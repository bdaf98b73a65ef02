"""fusiond top: shows a running vehicle in the terminal."""

from __future__ import annotations

import argparse

from fusiond.app.client import DEFAULT_ENDPOINT, ClientError
from fusiond.app.commands import EXIT_CODES
from fusiond.app.top import terminal
from fusiond.errors import OutputError

ABOUT = """\
Show the state of a running vehicle, the outcomes of each source's measurements, latencies, inputs, outputs and the
latest events, as published over Zenoh. Yellow: needs attention; red: failed. The keys 1 to 5 choose a part, arrows and
page keys scroll, q quits. $NO_COLOR turns colours off. Without a terminal, or on a dumb one: everything once, as text."""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"example:\n  fusiond top --connect 192.168.1.5:7447\n\n{EXIT_CODES}"
    parser.add_argument("--vehicle", metavar="NAME", help="which one; default: the only one that is running")
    parser.add_argument(
        "--connect",
        metavar="HOST[:PORT]",
        default=DEFAULT_ENDPOINT,
        help="fusiond or router, or an endpoint of Zenoh such as tls/HOST:PORT; default: %(default)s",
    )
    parser.add_argument("--zenoh", metavar="FILE", help="Zenoh's own configuration file, for example for TLS")
    parser.add_argument("--once", action="store_true", help="print everything as text, and exit")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    try:
        terminal.run(arguments.connect, arguments.vehicle, arguments.zenoh, just_once=arguments.once)
    except ClientError as error:
        raise OutputError(str(error)) from error
