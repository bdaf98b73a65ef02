"""fusiond beside a stand-in for a stock ArduPilot Rover: its rates, its clock, its filters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusiond.config import load as config
from fusiond.messages import EventMessage, HealthMessage, StateMessage
from fusiond.simulation.drive import simulate
from fusiond.simulation.matching import configuration, dbc
from fusiond.simulation.scenario import parse
from fusiond.units import MILLISECOND, SECOND
from tests.conftest import needs_compiled
from tests.helpers.rover import Rehearsal, StockRover

DRIVE = """
[[segment]]
duration_s = 3
[[segment]]
duration_s = 6
speed_mps = 8.0
[[segment]]
duration_s = 8
turn_deg = 90.0
[[segment]]
duration_s = 3
[[segment]]
duration_s = 8
turn_deg = -110.0
[[segment]]
duration_s = 2
[imu]
rate_hz = 200
transport = { latency_ms = 0.0 }
[gnss]
stamp = "boot-arrival"
transport = { latency_ms = 0.0 }
"""
DRIVING_S, ALIGNED_S, END_S = 3, 13, 29
GYRO_DELAY_MS = 56  # of its filter: sqrt(2) / (2 pi 4 Hz)
GIVEN_DELAY_MS = 11.3  # as configs/ardupilot-rover.toml has it


@needs_compiled
@pytest.mark.parametrize("system_time_off_s", [0.6, -0.6])
def test_a_stock_rover(tmp_path: Path, system_time_off_s: float) -> None:
    """Loop of 50 Hz, denials, filters with 56 ms of delay, slow round trips, a wrong SYSTEM_TIME: within 10 s of driving the
    state is nominal and the heading right, there is no reset, and the delay is learnt."""
    scenario = parse(DRIVE)
    drive, start_ns = simulate(scenario), scenario.start_ns
    imu = f"[imu.imu0]\ndelay_ms = {GIVEN_DELAY_MS}\ndelay_sigma_ms = 50.0"
    text = configuration(scenario, "wheels.dbc").replace("[imu.imu0]", imu)
    (tmp_path / "wheels.dbc").write_text(dbc(scenario))
    (tmp_path / "rover.toml").write_text(text)
    rover = StockRover(drive, system_time_off_s=system_time_off_s)
    rehearsal = Rehearsal(config.load(tmp_path / "rover.toml"), rover)
    rehearsal.run(start_ns, start_ns + END_S * SECOND, drive.wheels.events())

    published, wanted = rehearsal.published, rehearsal.housekeeping.wanted["HIGHRES_IMU"]
    assert (wanted.measured_hz, wanted.requests, rover.refusals) == (pytest.approx(40, rel=0.05), 16, 15)
    health = [message for message in published if isinstance(message, HealthMessage)][-1]
    learnt, clock = health.calibration["gyro_delay_ms"], health.sources["imu0"].clock
    assert GIVEN_DELAY_MS + learnt.value == pytest.approx(GYRO_DELAY_MS, abs=10)
    assert clock is not None
    assert (clock.method, clock.resets, clock.strays) == ("timesync", 0, 0)
    boot_ns = start_ns - round(scenario.autopilot.boot_s * SECOND)
    assert clock.offset_ms == pytest.approx(boot_ns / MILLISECOND, abs=3)
    assert not [m for m in published if isinstance(m, EventMessage) and m.kind in ("reset", "clock")]
    truth = drive.truth
    states = [m for m in published if isinstance(m, StateMessage) and m.t_ns >= start_ns + ALIGNED_S * SECOND]
    assert len(states) > 150
    yaw = np.degrees(np.interp([m.t_ns for m in states], truth.t_ns, np.unwrap(truth.euler[:, 2])))
    for message, true_deg in zip(states, yaw.tolist(), strict=True):
        assert message.mode.value == "nominal" and message.resets == 0 and message.state is not None
        assert abs((message.state.yaw_deg - true_deg + 180) % 360 - 180) < 3 * message.state.sigma_yaw_deg
