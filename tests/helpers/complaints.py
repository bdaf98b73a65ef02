"""Configurations of a few lines, and the errors that the loader reports for them."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.config.toml import ConfigError

CAR = Path("/etc/fusiond/car.toml")
BASE = """[mavlink.autopilot]
[imu.imu0]
link = "autopilot"
"""
GNSS = '[gnss.gps0]\nlink = "autopilot"\n'


def complaint(text: str, path: Path = CAR) -> str:
    with pytest.raises(ConfigError) as raised:
        config.parse(text, path)
    return str(raised.value)


def check(text: str, line: int, key: str, *parts: str) -> None:
    """The complaint names the file, the line, the key, and the parts in this order."""
    message = complaint(text)
    assert message.startswith(f"{CAR}:{line}: {key}: ")
    rest = message
    for part in parts:
        assert part in rest
        rest = rest.split(part, 1)[1]
