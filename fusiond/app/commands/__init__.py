"""The commands: a module for each, which holds its grammar (`fill`) and its action (`run`).

Only the module of the command that is called is imported: the daemon is up sooner without what only the others need.
"""

from __future__ import annotations

COMMANDS = {
    "run": "fuse the live inputs, and publish the state",
    "replay": "fuse recorded logs into a track",
    "top": "show a running vehicle's state, sources, latencies and health in the terminal",
    "check": "say what a configuration is going to do, or what is wrong with it",
    "mount": "find how the IMU is turned in the vehicle, from logs",
    "simulate": "write the logs of a simulated drive, and the truth about it",
    "demo": "play a bundled drive to a running fusiond, and explain what comes out",
}

EXIT_CODES = "exit codes: 0 success, 1 unusable input or unwritable output, 2 wrong usage or configuration, 130 interrupted"
