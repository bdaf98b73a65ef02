"""The daemon as a process: its signals, and when Python may switch threads and collect garbage."""

from __future__ import annotations

import asyncio
import gc
import signal
import sys

from fusiond.app.live.daemon import Daemon

SWITCH_S = 0.0005  # threads that want to run wait no longer than this for each other; Python's own 5 ms would be felt


async def serve(daemon: Daemon) -> None:
    """Run a daemon as the process's only task, under its signals: SIGTERM and SIGINT end it, SIGHUP reloads."""
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
    """Once it is up: keep the garbage collector from going through all modules again and again, for 30 ms each time, and
    from working between an instant and its state: the estimator sees to it."""
    await daemon.up.wait()
    gc.collect()
    gc.freeze()
    gc.disable()
