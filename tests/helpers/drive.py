"""A short simulated drive with its logs, and everything that a replay of it publishes: for the tests of outputs."""

from __future__ import annotations

import atexit
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.messages.types import Message
from fusiond.simulation.scenario import parse
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive

SCENARIO = """
[[segment]]
duration_s = 8
turn_deg = 30.0
[start]
speed_mps = 9.0
[vehicle]
name = "tested"
[gnss]
outage_s = [[4.5, 9]]
"""
LOGS = ("drive.tlog", "drive.log")


@cache
def folder() -> Path:
    """The folder of the drive's files. Dead reckoning from second 6.5 on."""
    temporary = TemporaryDirectory(prefix="fusiond-drive-")
    atexit.register(temporary.cleanup)
    path = Path(temporary.name)
    write_drive(parse(SCENARIO), path)
    return path


@cache
def settings() -> Config:
    """The drive's configuration."""
    return config.load(folder() / "fusiond.toml")


@cache
def messages() -> tuple[Message, ...]:
    """Everything published at 50 Hz: states, settled states, innovations, events, health."""
    published: list[Message] = []
    logs = open_logs([str(folder() / log) for log in LOGS], settings())
    Replay(settings(), ReplayTask(50.0, on_message=[published.append])).run(logs)
    return tuple(published)
