"""fusiond fleet: shows many running vehicles at once, and their alarms."""

from __future__ import annotations

import argparse

from fusiond.app.client import DEFAULT_ENDPOINT, Client, ClientError
from fusiond.app.commands import EXIT_CODES
from fusiond.app.fleet import terminal
from fusiond.app.fleet.terminal import Address
from fusiond.errors import OutputError

ABOUT = """\
Show all running vehicles, one line each: mode, age and rate of the states, position, speed, alarms. Those with alarms
come first. Arrows and page keys scroll, q quits. Without a terminal, or with --alarms: a line where an alarm begins or
ends, until it is stopped."""
EXAMPLES = """\
examples:
  fusiond fleet --connect router.example
  fusiond fleet --connect tls/router.example:7447 --zenoh reader.json5 --alarms >> alarms.log
  fusiond fleet --connect router.example --alarms --prometheus 127.0.0.1:9465 --foxglove 127.0.0.1:8766
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    add = parser.add_argument
    add(
        "--connect",
        metavar="HOST[:PORT]",
        default=DEFAULT_ENDPOINT,
        help="the router, or an endpoint of Zenoh such as tls/HOST:PORT; default: %(default)s",
    )
    add("--zenoh", metavar="FILE", help="Zenoh's own configuration file, for example for TLS")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--once", action="store_true", help="print everything as text, and exit")
    shown.add_argument("--alarms", action="store_true", help="print a line where an alarm begins or ends")
    add("--prometheus", metavar="HOST:PORT", type=address, help="serve metrics of the fleet (extra `prometheus`)")
    add("--foxglove", metavar="HOST:PORT", type=address, help="serve a map of the fleet (extra `foxglove`)")


def address(text: str) -> Address:
    """HOST:PORT."""
    host, colon, port = text.rpartition(":")
    if not (host and colon and port.isascii() and port.isdigit() and int(port) <= 65535):
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT, such as 127.0.0.1:9465")
    return Address(host, int(port))


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    try:
        with Client(arguments.connect, "*", config_file=arguments.zenoh) as client:
            terminal.run(
                client,
                just_once=arguments.once,
                just_alarms=arguments.alarms,
                prometheus_at=arguments.prometheus,
                foxglove_at=arguments.foxglove,
            )
    except ClientError as error:
        raise OutputError(str(error)) from error
