"""Captured logs in: what is known of their content is found in them."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from fusiond.config import load as config
from fusiond.events import WheelSpeed
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.paths import ROOT

DATA = ROOT.parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the captured traces are not beside the project")

WHEELS = {"front_right": "FR", "front_left": "FL", "rear_right": "RR", "rear_left": "RL"}
LINK = '[mavlink.fc]\ndialect = "ardupilotmega"\n[gnss.gps0]\nlink = "fc"\n[imu.imu0]\nlink = "fc"\n'


def test_the_captured_car() -> None:
    drive = DATA / "comma2k19-rav4"
    wheels = "".join(
        f'[wheel.{name}]\nbus = "can0"\nmessage = "WHEEL_SPEEDS"\nsignal = "WHEEL_SPEED_{signal}"\n'
        for name, signal in WHEELS.items()
    )
    settings = config.parse(f'{LINK}[can.can0]\ndbc = ["rav4.dbc"]\n{wheels}', ROOT / "configs" / "test.toml")
    logs = open_logs([drive / "drive.tlog", drive / "drive.candump.log"], settings)
    found = list(logs)
    counts = Counter(event.source for event in found)
    assert counts == {
        "imu0": 3128, "gps0.position": 287, "gps0.velocity": 287, "fc.time": 30, **dict.fromkeys(WHEELS, 2487),
    }  # fmt: skip
    assert logs.counts[str(drive / "drive.tlog")] == {"records": 3475, "decoded": 3475}
    assert all(earlier.t_receive_ns <= later.t_receive_ns for earlier, later in pairwise(found))
    speeds = [event.payload.speed for event in found if isinstance(event.payload, WheelSpeed)]
    assert 7 < min(speeds) < max(speeds) < 21
    ages_ms = [
        (event.t_receive_ns - event.t_sensor_ns) / 1e6
        for event in found
        if event.source == "gps0.position" and event.t_sensor_ns is not None
    ]
    assert 50 < min(ages_ms) < 78.5 < max(ages_ms) < 120


def test_the_captured_copter() -> None:
    path = DATA / "flight-logs" / "copter-20211208-151342.tlog"
    logs = open_logs([path], config.parse(f'{LINK}message = "RAW_IMU"'))
    found, counts = list(logs), logs.counts[str(path)]
    assert counts["records"] == 11743  # as many as pymavlink's own reader finds
    assert counts["lost"] == 2
    assert Counter(event.source for event in found) == {
        "imu0": 468, "gps0.position": 467, "gps0.velocity": 467, "fc.time": 467,
    }  # fmt: skip


def test_the_captured_mf4() -> None:
    pytest.importorskip("asammdf")
    folder = DATA / "canedge-car"
    wheel = '[wheel.w]\nbus = "car"\nmessage = "gnss_speed"\nsignal = "Speed"\nunit = "m/s"\n'
    text = f'[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[can.car]\ndbc = ["canmod-gps.dbc"]\n{wheel}'
    settings = config.parse(f'{text}valid_signal = "SpeedValid"\nvalid_value = 1', folder / "test.toml")
    path = folder / "00000005-60FEB5A8.MF4"
    logs = open_logs([path], settings)
    assert len(list(logs)) == logs.counts[str(path)]["decoded"] > 10
