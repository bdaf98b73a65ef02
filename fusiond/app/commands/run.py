"""fusiond run: the daemon. Imports only what the daemon needs, in an order that lets it start sooner."""

from __future__ import annotations

import argparse
import gc
import sys
from types import ModuleType

from fusiond.app.commands import EXIT_CODES, interrupts_end_at_once
from fusiond.app.commands.arguments import add_config, add_verbosity, log_level, taken_config
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond_adapters.host import journal

ABOUT = """\
Fuse the live inputs of a configuration and publish the state over Zenoh, until SIGTERM or SIGINT. Missing inputs are
opened as soon as they appear. SIGHUP reloads the configuration: connections, message rates and [record] change while
running; if anything else has changed, the whole reload is refused, and the log says why."""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"example:\n  fusiond run car.toml\n\n{EXIT_CODES}"
    add_config(parser)
    add_verbosity(parser, quiet="log warnings and errors only", verbose="log the libraries and the status too")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    with interrupts_end_at_once():  # until the daemon has its own handlers: nothing is open yet
        _run(arguments)


def _run(arguments: argparse.Namespace) -> None:
    name = taken_config(arguments)
    gc.disable()  # imported modules never become garbage: collecting would take a tenth of the start
    asyncio = _asyncio()
    import numpy  # noqa: F401, PLC0415 - not from a deep call stack, where Python maps and unmaps its stack at every call

    from fusiond.app.live.daemon import Daemon  # noqa: PLC0415 - after asyncio, which is imported without TLS
    from fusiond.app.live.serve import serve  # noqa: PLC0415

    gc.freeze()
    gc.enable()
    journal.set_up(log_level(arguments))

    def load() -> Config:
        return config.load(name)

    asyncio.run(serve(Daemon(load(), load)))


def _asyncio() -> ModuleType:
    """Import asyncio without TLS, which is not used here and takes a third of the time."""
    without_tls = not {"asyncio", "ssl"} & sys.modules.keys()
    if without_tls:
        sys.modules["ssl"] = None  # type: ignore[assignment]
    import asyncio  # noqa: PLC0415

    if without_tls:
        del sys.modules["ssl"]  # later imports find it again
    return asyncio
