"""The command line: runs one command, and turns errors into exit codes."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from fusiond import __version__
from fusiond.app.colours import painted
from fusiond.app.commands import COMMANDS, EXIT_CODES, interrupts_end_at_once
from fusiond.errors import UnusableError, UsageError

SUCCESS, UNUSABLE, USAGE, INTERRUPTED = 0, 1, 2, 130  # exit codes


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The grammar of the command line: complete for `command`, names only for the others."""
    top = argparse.ArgumentParser(
        prog="fusiond",
        description="Fuse a vehicle's IMU, GNSS (MAVLink) and wheel speeds (CAN) into one state with its covariance.",
        epilog=f"Try `fusiond demo` first. {EXIT_CODES}",
    )
    top.add_argument("--version", action="version", version=f"fusiond {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, about in COMMANDS.items():
        one = commands.add_parser(
            name, help=about, description=f"{about.capitalize()}.", formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if name == command:
            module = import_module(f"fusiond.app.commands.{name}")
            module.fill(one)
            one.set_defaults(run=module.run, grammar=parser)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code, which the command may have chosen. A wrong command line ends with
    SystemExit(2), as argparse does."""
    words = sys.argv[1:] if argv is None else argv
    try:
        with interrupts_end_at_once():  # it imports the command
            arguments = parser(words[0] if words else None).parse_args(words)
        status: int | None = arguments.run(arguments)
        sys.stdout.flush()
    except UsageError as error:
        return _failed(str(error), USAGE)
    except UnusableError as error:
        return _failed(str(error), error.code)
    except BrokenPipeError:  # the reader of our output has gone; keep the interpreter from flushing into it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNUSABLE
    except OSError as error:
        return _failed(f"{error.filename or 'input or output'}: {error.strerror or error}", UNUSABLE)
    except KeyboardInterrupt:
        return _failed("interrupted", INTERRUPTED)
    return status or SUCCESS


def _failed(message: str, code: int) -> int:
    print(painted(f"fusiond: {message}", "red", sys.stderr), file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
