"""Arguments that several commands have: the configuration, which may stand among the files, and how much is told."""

from __future__ import annotations

import argparse
import logging

from fusiond.errors import UsageError

SUFFIX = ".toml"  # of a configuration, by which it is known among other files


def add_config(
    parser: argparse.ArgumentParser, about: str = "configuration of the vehicle", *, metavar: str = "C.toml"
) -> None:
    """Define the configuration of a command without other files: `C.toml` or `--config C.toml`."""
    parser.add_argument("file", metavar=metavar, nargs="?", help=about)
    parser.add_argument("--config", metavar=metavar, help="the same")


def add_config_and_logs(
    parser: argparse.ArgumentParser, about: str = ".tlog, .log (candump -L), ..., also .gz; or NAME=LOG"
) -> None:
    """Define the configuration and the logs: `C.toml LOG...` or `--config C.toml LOG...`."""
    parser.add_argument(
        "logs", metavar="FILE", nargs="+", help=f"C{SUFFIX}, the configuration of the vehicle, and logs: {about}"
    )
    parser.add_argument("--config", metavar="C.toml", help="the configuration, in place of the first FILE")


def taken_config(arguments: argparse.Namespace) -> str:
    """The name of the configuration, which is taken out of the logs if it stands among them. Raises UsageError."""
    logs: list[str] | None = getattr(arguments, "logs", None)
    given = [name for name in logs if name.endswith(SUFFIX)] if logs is not None else [arguments.file] * bool(arguments.file)
    named = given + [arguments.config] * (arguments.config is not None)
    if len(named) != 1:
        found = f"found {' and '.join(named)}" if named else f"give its name, such as car{SUFFIX}"
        raise UsageError(f"one configuration is needed: {found}")
    if logs is not None:
        logs[:] = [name for name in logs if not name.endswith(SUFFIX)]
        if not logs:
            raise UsageError(f"{named[0]} is the configuration: give a log as well")
    return str(named[0])


def add_verbosity(parser: argparse.ArgumentParser, *, quiet: str, verbose: str) -> None:
    """Define -q and -v; `quiet` and `verbose` say what they do."""
    how_much = parser.add_mutually_exclusive_group()
    how_much.add_argument("-q", "--quiet", action="store_true", help=quiet)
    how_much.add_argument("-v", "--verbose", action="store_true", help=verbose)


def log_level(arguments: argparse.Namespace) -> int:
    """The least level of what is logged."""
    return logging.WARNING if arguments.quiet else logging.DEBUG if arguments.verbose else logging.INFO
