"""The daemon as a process: signals, thread switching and garbage collection."""

from __future__ import annotations

import asyncio
import gc
import signal
import sys

from fusiond.app.live.daemon import Daemon

SWITCH_S = 0.0005  # longest wait of a thread for another; Python's default of 5 ms would delay states


async def serve(daemon: Daemon) -> None:
    """Run a daemon as the process's only task: SIGTERM and SIGINT end it, SIGHUP reloads."""
    loop = asyncio.get_running_loop()
    for number, action in ((signal.SIGTERM, daemon.stop), (signal.SIGINT, daemon.stop), (signal.SIGHUP, daemon.reload)):
        loop.add_signal_handler(number, action)
    sys.setswitchinterval(SWITCH_S)
    tidying = asyncio.create_task(_tidy(daemon))
    try:
        await daemon.run()
    finally:
        tidying.cancel()
        gc.enable()


async def _tidy(daemon: Daemon) -> None:
    """Once it is up, exclude the modules from garbage collection, which would take 30 ms each time, and turn off automatic
    collection, which would delay states: the estimator's thread collects instead."""
    await daemon.up.wait()
    gc.collect()
    gc.freeze()
    gc.disable()
