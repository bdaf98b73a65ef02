"""Accuracy on the captured RAV4 trace: as it is, with arrival stamps, without GNSS, without rewinding; and the delay that is
learnt from it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from fusiond.app.replay.comparison import TruthReport, Window
from fusiond.app.replay.intervals import parse_withheld
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config import load as configuration
from fusiond.config.schema import Config
from fusiond.filter.calibration import calibrations
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.paths import ROOT

DRIVE = ROOT.parent / "shared" / "data" / "comma2k19-rav4"
CONFIG = ROOT / "configs" / "rav4.toml"
WINDOW = Window(10.0, 30.0)
pytestmark = pytest.mark.skipif(not DRIVE.is_dir(), reason="the captured drive comma2k19-rav4 is not beside the project")


def car(**gnss: object) -> Config:
    """The car's configuration, with other values for its receiver."""
    config = configuration.load(CONFIG)
    receiver = msgspec.structs.replace(config.gnss["gps0"], **gnss)
    return msgspec.structs.replace(config, gnss={"gps0": receiver})


FROZEN = {"delay_sigma_ms": 0.0, "velocity_delay_sigma_ms": 0.0}  # nothing is learnt of the receiver's delays


def errors(
    config: Config, tlog: str = "drive.tlog", window: Window = WINDOW, withhold: str | None = None, csv: Path | None = None
) -> TruthReport:
    summary = replay(
        Options(
            config=config,
            config_name="rav4.toml",
            logs=logs(tlog),
            truth=DRIVE / "truth.csv",
            withheld=[parse_withheld(withhold, config)] if withhold else [],
            window=window,
            csv=csv,
        )
    )
    assert summary.truth is not None
    return summary.truth


def logs(tlog: str) -> list[str]:
    return [str(DRIVE / tlog), str(DRIVE / "drive.candump.log")]


def learnt(config: Config, tlog: str) -> dict[str, tuple[float, float]]:
    """Value and sigma of every calibration at the end of the drive."""
    run = Replay(config, ReplayTask(config.publish.rate_hz))
    run.run(open_logs(logs(tlog), config))
    return calibrations(run.fusion.params, run.fusion.history.head)


def test_fixes_at_their_own_time() -> None:
    found = errors(car())
    assert found.position.rmse_m <= 0.45
    assert found.position.rmse_offset_removed_m <= 0.18
    assert found.velocity_rmse_mps <= 0.06
    assert found.heading.rmse_deg <= 0.10
    assert found.position.inside_95 >= 0.95


@pytest.mark.parametrize(("seconds", "limit_m"), [("12-22", 1.0), ("18-28", 0.5)])
def test_ten_seconds_without_gnss(seconds: str, limit_m: float) -> None:
    end = float(seconds.partition("-")[2])
    found = errors(car(), window=Window(end - 1, end), withhold=f"gps0:{seconds}")
    assert found.position.end_m <= limit_m
    assert found.position.inside_95 >= 0.95


def test_nothing_in_the_configuration_is_fitted_to_the_drive() -> None:
    """The delays start at zero, and their initial sigmas hardly matter."""
    receiver = car().gnss["gps0"]
    assert receiver.delay_ms == receiver.velocity_delay_ms == 0.0
    for factor in (2 / 3, 1.5):
        sigmas = {name: factor * getattr(receiver, name) for name in FROZEN}
        found = errors(car(**sigmas))
        assert found.position.rmse_m <= 0.45
        assert found.velocity_rmse_mps <= 0.06


def test_fixes_stamped_at_their_arrival_with_the_delay_given() -> None:
    own, arrival = errors(car()), errors(car(delay_ms=78.0), "drive-gps-boot-time.tlog")
    assert arrival.position.rmse_m <= 1.1 * own.position.rmse_m
    assert arrival.velocity_rmse_mps <= 1.1 * own.velocity_rmse_mps
    assert arrival.heading.rmse_deg <= 1.1 * own.heading.rmse_deg


def test_the_delay_of_fixes_stamped_at_their_arrival_is_learnt() -> None:
    """78 ms, from an initial value of 0."""
    found = learnt(car(delay_sigma_ms=100.0), "drive-gps-boot-time.tlog")
    delay, sigma = found["delay_ms"]
    assert abs(delay - 78) <= 15
    assert sigma <= 60


def test_fusing_each_fix_at_its_arrival_is_clearly_worse() -> None:
    """Without rewinding: every fix is fused at the instant of its arrival."""
    found = errors(car(stamp="arrival", **FROZEN))
    assert found.position.rmse_m > 2 * errors(car()).position.rmse_m


def test_same_inputs_same_bytes(tmp_path: Path) -> None:
    for name in ("first.csv", "second.csv"):
        errors(car(), csv=tmp_path / name)
    first, second = (tmp_path / name for name in ("first.csv", "second.csv"))
    assert first.read_bytes() == second.read_bytes()
    assert len(first.read_text().splitlines()) > 1400
