"""A slow skid-steered robot with a noisy inertial sensor, on the captured husky trace: its wheel scale is learnt where fixes
show it, and left alone where nothing does."""

from __future__ import annotations

import msgspec
import pytest

from fusiond.app.replay.intervals import parse_withheld
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config import load as configuration
from fusiond.filter.calibration import calibrations
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.paths import ROOT

DRIVE = ROOT.parent / "shared" / "data" / "husky"
TRUE_SCALE = 0.026  # a track of gyro and wheels fitted to all fixes
pytestmark = pytest.mark.skipif(not DRIVE.is_dir(), reason="the captured drive husky is not beside the project")


def scale_at_the_end(withheld: str | None) -> tuple[float, float]:
    """Wheel scale and its sigma. The heading is given: without one the state begins where the robot first turns."""
    config = configuration.load(DRIVE / "drive.toml")
    settings = msgspec.structs.replace(config.filter, heading_deg=341.0)
    config = msgspec.structs.replace(config, filter=settings)
    task = ReplayTask(config.publish.rate_hz, withheld=[parse_withheld(withheld, config)] if withheld else [])
    run = Replay(config, task)
    run.run(open_logs([str(DRIVE / "drive.tlog"), str(DRIVE / "drive.log")], config))
    return calibrations(run.fusion.params, run.fusion.history.head)["wheel_scale"]


def test_the_scale_is_learnt_from_fixes() -> None:
    scale, sigma = scale_at_the_end(None)
    assert abs(scale - TRUE_SCALE) <= 3 * sigma
    assert sigma < 0.009


def test_without_fixes_the_scale_stays_where_it_was() -> None:
    scale, sigma = scale_at_the_end("gps0:30-400")
    assert abs(scale) <= 0.002
    assert sigma >= 0.0098
