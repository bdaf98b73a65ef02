"""Scenarios: the demo's drives as its comments say, bad ones are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusiond.config.toml import ConfigError
from fusiond.simulation.drive import simulate
from fusiond.simulation.scenario import load, parse
from fusiond.units import SECOND
from fusiond_adapters.logs.write import write_drive
from tests.helpers.paths import ROOT
from tests.helpers.simulated import REST

DEMO = ROOT / "configs" / "simulate-demo.toml"


def test_demo_scenario_drives_what_its_comments_say(tmp_path: Path) -> None:
    demo = load(DEMO)
    drive = simulate(demo)
    assert demo.duration_s == 150
    assert np.abs(drive.truth.speed).max() == pytest.approx(20)
    standing = drive.truth.t_ns[np.abs(drive.truth.speed) == 0]
    assert ((standing - demo.start_ns) / SECOND < 8.01).sum() == 801
    t = (drive.gnss.time_us - demo.start_ns // 1000) / 1e6
    assert not ((t >= 54) & (t < 69)).any()
    assert sum(path.stat().st_size for path in write_drive(demo, tmp_path)) < 3_000_000


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("seed = 1\n", "s.toml:1: the file: the key 'segment' is missing"),
        ("segment = []\n", "s.toml:1: segment: Expected `array` of length >= 1"),
        ("[[segment]]\nspeed_mps = 3\n", "s.toml:1: segment[0]: the key 'duration_s' is missing"),
        (
            "[[segment]]\nduration_s = 1\n[[segment]]\nduration_s = 2\nspeed = 3\n",
            "s.toml:5: segment[1].speed: unknown key (did you mean 'speed_mps'?); allowed: duration_s, grade_deg",
        ),
        (REST.format(1) + "[imu]\nrate_hz = 5000\n", "s.toml:4: imu.rate_hz: Expected `float` <= 2000"),
        (
            REST.format(1) + '[gnss]\nstamp = "gps"\n',
            "s.toml:4: gnss.stamp: Invalid enum value 'gps'",
        ),
        (
            REST.format(1) + "[gnss]\n[[gnss.jump]]\nstart_s = 1\nstop_s = 2\noffset = [1, 2, 3]\n",
            "s.toml:7: gnss.jump[0].offset: unknown key (did you mean 'offset_m'?); allowed: offset_m, start_s, stop_s",
        ),
        (
            REST.format(1) + '[[wheels.slip]]\nwheel = "spare"\nstart_s = 1\nstop_s = 2\nfactor = 1\n',
            "s.toml:4: wheels.slip[0].wheel: Invalid enum value 'spare'",
        ),
        (
            REST.format(1) + '[[wheels.stuck]]\nwheel = "rear_left"\nstart_s = 4\nstop_s = 2\n',
            "s.toml:6: wheels.stuck[0].stop_s: must be later than start_s (4.0)",
        ),
        (REST.format(1) + "[imu.transport]\nloss = 1.5\n", "s.toml:4: imu.transport.loss: Expected `float` < 1"),
        (
            REST.format(1) + "[gnss]\noutage_s = [[1, 2], [5, 4]]\n",
            "s.toml:4: gnss.outage_s[1]: [start, stop] must rise from 0 or later; found [5.0, 4.0]",
        ),
        (
            REST.format(1) + "turn_deg = 5\n",
            "s.toml:3: segment[0].turn_deg: must be 0 while the vehicle stands",
        ),
        (
            "[start]\nspeed_mps = 2\n" + REST.format(1) + "speed_mps = -2\n",
            "s.toml:5: segment[0].speed_mps: cannot go from 2.0 to -2.0 m/s; stop (0) in a segment between",
        ),
        (
            "[start]\nspeed_mps = 1\n" + REST.format(2) + "turn_deg = 90\n",
            "s.toml:5: segment[0].turn_deg: too sharp: 90.0 deg within 2.0 m of road",
        ),
        (
            REST.format(9) + "speed_mps = 50\n[wheels]\nunsigned = false\n",
            "s.toml:4: wheels.resolution_kmh: 15 bits end at 45.5 m/s, below the drive's 50.0 m/s",
        ),
        (REST.format(0.4), "s.toml:2: segment[0].duration_s: the whole drive must last 1 s or longer"),
        ("segment = 3 4", "s.toml: not valid TOML"),
    ],
)
def test_bad_scenario_is_refused_by_line_and_key(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text, Path("s.toml"))
    assert complaint in str(caught.value)


def test_missing_scenario_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "none.toml")
