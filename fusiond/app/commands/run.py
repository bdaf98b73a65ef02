"""fusiond run: the daemon. It imports no more than the daemon needs, and in an order that lets it start sooner."""

from __future__ import annotations

import argparse
import gc
import sys
from types import ModuleType

from fusiond.app.commands import EXIT_CODES
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond_adapters.host import journal

ABOUT = """\
Take the live inputs of a configuration and publish the state over Zenoh, until SIGTERM or SIGINT. An input that is away
is waited for. SIGHUP reloads the configuration: connections, message rates and [record] change while running; with
anything else changed the reload is refused as a whole, and the log says why."""


def fill(parser: argparse.ArgumentParser) -> None:
    """The grammar."""
    parser.description, parser.epilog = ABOUT, f"example:\n  fusiond run --config car.toml\n\n{EXIT_CODES}"
    parser.add_argument("--config", metavar="C.toml", required=True, help="configuration of the vehicle")


def run(arguments: argparse.Namespace) -> None:
    """The action."""
    gc.disable()  # what is imported never becomes garbage: to look for it would take a tenth of the start
    asyncio = _asyncio()
    import numpy  # noqa: F401, PLC0415 - here, not from deep within: there Python maps and unmaps its stack at every call

    from fusiond.app.live.daemon import Daemon  # noqa: PLC0415 - after asyncio, which is to come without TLS
    from fusiond.app.live.serve import serve  # noqa: PLC0415

    gc.freeze()
    gc.enable()
    journal.set_up()

    def load() -> Config:
        return config.load(arguments.config)

    asyncio.run(serve(Daemon(load(), load)))


def _asyncio() -> ModuleType:
    """asyncio, which takes a third longer to import where it finds TLS, of which nothing here makes use."""
    without_tls = not {"asyncio", "ssl"} & sys.modules.keys()
    if without_tls:
        sys.modules["ssl"] = None  # type: ignore[assignment]
    import asyncio  # noqa: PLC0415

    if without_tls:
        del sys.modules["ssl"]  # for whoever else wants it
    return asyncio
