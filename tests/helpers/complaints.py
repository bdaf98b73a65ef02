"""Configurations of a few lines, and the errors that the loader reports for them."""

from __future__ import annotations

import re
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


def check(text: str, line_number: int, key: str, *parts: str) -> None:
    """One of the complaints names the file, the line, the key, and the parts in this order."""
    lines = [line for line in complaint(text).splitlines() if line.startswith(f"{CAR}:{line_number}: {key}: ")]
    assert any(re.search(".*".join(map(re.escape, parts)), line) for line in lines), lines
