"""Paths of logs."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    return tmp_path / "drive.tlog"
