"""The commands, one module for each: its arguments (`fill`) and its action (`run`).

Only the module of the given command is imported, so that the daemon starts sooner.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread

COMMANDS = {
    "run": "fuse the live inputs, and publish the state",
    "replay": "fuse recorded logs into a track",
    "smooth": "smooth recorded logs: each state from all that was measured, before and after it",
    "report": "fuse recorded logs, and write one HTML file that shows the drive and what became of its data",
    "batch": "replay many drives, and tell whether a configuration is better on them",
    "doctor": "find what the data of recorded logs say against a configuration",
    "compare": "compare two tracks of one drive: of two configurations, two versions, or with the autopilot's own",
    "tune": "tell what logs say of their noise, delays and installation, and write a better configuration",
    "top": "show a running vehicle's state, sources, latencies and health in the terminal",
    "fleet": "show many running vehicles at once, and their alarms",
    "inspect": "tell what is in logs, and write a configuration to start from",
    "init": "write a configuration to start from, without a log",
    "imu_noise": "measure the noise of the inertial sensor in logs",
    "gnss_lag": "measure how much GNSS speed lags behind wheel speed in logs",
    "check": "explain what a configuration does, or what is wrong with it",
    "convert": "write public drives of others as logs",
    "mount": "estimate the mounting angles of the IMU from logs",
    "simulate": "write the logs of a simulated drive and its truth",
    "demo": "play a bundled drive to a running fusiond, and explain the result",
    "completion": "print a script that completes fusiond's command line with the tab key",
}

EXIT_CODES = (
    "exit codes: 0 success, 1 unusable input or unwritable output, 2 wrong usage or configuration, 3 a replay without a"
    " state, 4 a replay whose data contradict the configuration, 130 interrupted"
)


@contextmanager
def interrupts_end_at_once() -> Iterator[None]:
    """Inside, SIGINT ends the process as SIGTERM does, unless it is ignored or handled. Python's own handler raises an
    exception between any two instructions; a library may swallow it in an import and stay half made: msgspec crashed."""
    handler = signal.getsignal(signal.SIGINT)
    if handler is not signal.default_int_handler or current_thread() is not main_thread():
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
