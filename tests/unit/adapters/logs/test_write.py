"""A simulated drive on disk: files that others can read, the demo's scenario, and bad scenarios refused."""

from __future__ import annotations

import itertools
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from pymavlink import mavutil

from fusiond.config import load as config
from fusiond.events import ClockPair, GnssPosition, GnssVelocity, ImuSample, Invalid, Pressure, WheelSpeed
from fusiond.simulation.chatter import TELEMETRY_HZ
from fusiond.simulation.drive import simulate
from fusiond.simulation.scenario import WHEELS, Scenario, parse
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive
from tests.helpers.paths import ROOT
from tests.helpers.simulated import REST

DEMO = ROOT / "configs" / "simulate-demo.toml"
NOISY = """
[[segment]]
duration_s = 5
[[segment]]
duration_s = 10
speed_mps = 14.0
grade_deg = 2.0
[[segment]]
duration_s = 15
speed_mps = 0.0
turn_deg = 100.0
[[segment]]
duration_s = 30
speed_mps = -3.0
[imu]
silent_s = [[30, 31]]
[imu.transport]
jitter_ms = 4.0
loss = 0.01
reorder = true
[gnss]
no_fix_s = [[5, 6]]
[wheels]
fault_s = [[8, 9]]
silent_s = [[10, 11.08]]
unsigned = false
[barometer]
rate_hz = 10
[[autopilot.reboot]]
at_s = 40
"""


@pytest.fixture(scope="module")
def noisy() -> Scenario:
    return parse(NOISY)


@pytest.fixture(scope="module")
def written(noisy: Scenario, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {path.name: path for path in write_drive(noisy, tmp_path_factory.mktemp("drive"))}


def test_what_else_is_on_the_wires_changes_no_event(tmp_path: Path) -> None:
    """The further messages and frames come at their rates, tell the truth, and leave what is measured as it was."""
    text = REST.format(2) + "[[segment]]\nduration_s = 8\nspeed_mps = 12.0\nturn_deg = 30.0\n"
    full = "[autopilot]\ntelemetry = true\n[wheels]\ntraffic_hz = 1000.5\n"
    events, paths = [], {}
    for name, scenario in (("bare", parse(text)), ("full", parse(text + full))):
        paths = {path.name: path for path in write_drive(scenario, tmp_path / name)}
        log = open_logs([paths["drive.tlog"], paths["drive.log"]], config.load(paths["fusiond.toml"]))
        events.append(list(log))
    assert events[0] == events[1]
    assert log.counts[str(paths["drive.tlog"])]["skipped"] == pytest.approx(10 * sum(TELEMETRY_HZ.values()), rel=0.01)
    assert "lost" not in log.counts[str(paths["drive.tlog"])]
    frames = list(can.LogReader(paths["drive.log"]))
    assert sum(frame.arbitration_id >= 0x200 for frame in frames) == pytest.approx(10 * 1000.5, rel=0.01)
    assert [frame.timestamp for frame in frames] == sorted(frame.timestamp for frame in frames)
    link = mavutil.mavlink_connection(str(paths["drive.tlog"]), dialect="common")
    messages = [message for message in iter(link.recv_msg, None) if message.get_type() in TELEMETRY_HZ]
    assert {message.get_type() for message in messages} == set(TELEMETRY_HZ)
    assert [m.groundspeed for m in messages if m.get_type() == "VFR_HUD"][-1] == pytest.approx(12.0, abs=0.1)
    assert [m.yaw for m in messages if m.get_type() == "ATTITUDE"][-1] == pytest.approx(np.radians(30), abs=0.01)
    link.close()


def test_same_seed_writes_the_same_bytes(noisy: Scenario, written: dict[str, Path], tmp_path: Path) -> None:
    again = {path.name: path for path in write_drive(noisy, tmp_path / "new" / "folder")}
    assert list(again) == ["drive.tlog", "drive.log", "wheels.dbc", "truth.csv", "fusiond.toml"]
    assert all(again[name].read_bytes() == path.read_bytes() for name, path in written.items())
    other = {path.name: path for path in write_drive(noisy, tmp_path / "other", seed=5)}
    assert all(other[name].read_bytes() != written[name].read_bytes() for name in ("drive.tlog", "drive.log"))


def test_readers_decode_the_simulated_events_exactly(noisy: Scenario, written: dict[str, Path]) -> None:
    settings = config.load(written["fusiond.toml"])
    read = list(open_logs([written["drive.tlog"], written["drive.log"]], settings))
    made = list(simulate(noisy).events())
    assert read == made
    assert {type(event.payload) for event in made} == {
        ImuSample, GnssPosition, GnssVelocity, WheelSpeed, Pressure, ClockPair, Invalid,
    }


def test_pymavlink_reads_the_tlog(noisy: Scenario, written: dict[str, Path]) -> None:
    drive = simulate(noisy)
    log = mavutil.mavlink_connection(str(written["drive.tlog"]), dialect="common")
    found: dict[str, list[mavutil.mavlink.MAVLink_message]] = {}
    while (message := log.recv_msg()) is not None:
        found.setdefault(message.get_type(), []).append(message)
    log.close()
    assert set(found) == {"HIGHRES_IMU", "GPS_RAW_INT", "SYSTEM_TIME", "HEARTBEAT", "SCALED_PRESSURE"}
    imu, gps = found["HIGHRES_IMU"], found["GPS_RAW_INT"]
    assert [round(m._timestamp * 1e6) for m in imu] == drive.imu.t_receive_us.tolist()
    assert [m.time_usec for m in imu] == drive.imu.time_us.tolist()
    assert [[m.xacc, m.yacc, m.zacc] for m in imu] == drive.imu.specific_force_b.tolist()
    assert [[m.xgyro, m.ygyro, m.zgyro] for m in imu] == drive.imu.angular_rate_b.tolist()
    assert [(m.lat, m.lon, m.vel, m.cog) for m in gps] == list(
        zip(*(getattr(drive.gnss.fixes, name).tolist() for name in ("lat", "lon", "vel", "cog")), strict=True)
    )
    assert len(found["HEARTBEAT"]) == len(drive.heartbeats.counter)


def test_python_can_and_cantools_read_the_candump(noisy: Scenario, written: dict[str, Path]) -> None:
    drive = simulate(noisy)
    database = cantools.database.load_file(written["wheels.dbc"])
    with can.LogReader(written["drive.log"]) as reader:
        frames = list(reader)
    assert {frame.arbitration_id for frame in frames} == {0x1D0, 0x025, 0x0B4}
    assert all(a.timestamp <= b.timestamp for a, b in itertools.pairwise(frames))
    wheel_frames = [frame for frame in frames if frame.arbitration_id == 0x1D0]
    decoded = [database.decode_message(frame.arbitration_id, frame.data) for frame in wheel_frames]
    speeds = [[d["SPEED_FL"], d["SPEED_FR"], d["SPEED_RL"], d["SPEED_RR"]] for d in decoded]
    assert np.array(speeds) == pytest.approx(drive.wheels.raw * 0.01)
    assert [d["COUNTER"] for d in decoded] == drive.wheels.counter.tolist()
    assert [d["FAULT"] for d in decoded] == drive.wheels.fault.astype(int).tolist()
    assert [round(frame.timestamp * 1e6) for frame in wheel_frames] == drive.wheels.t_receive_us.tolist()


def test_truth_file(noisy: Scenario, written: dict[str, Path]) -> None:
    truth = simulate(noisy).truth
    header, *rows = written["truth.csv"].read_text(encoding="ascii").splitlines()
    assert header == "unix_us,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg"
    table = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    assert len(table) == 1201  # 60 s at 20 Hz
    assert table[:, 0] == pytest.approx(truth.t_ns[::5] / 1000, abs=1)
    assert table[:, 1] == pytest.approx(np.degrees(truth.latitude[::5]), abs=1e-9)
    assert table[:, 4:7] == pytest.approx(truth.velocity_n[::5], abs=1e-5)
    assert table[:, 7:] == pytest.approx(np.degrees(truth.euler[::5]), abs=1e-5)


def test_matching_configuration_holds_the_installers_measurements(written: dict[str, Path], noisy: Scenario) -> None:
    settings = config.load(written["fusiond.toml"])
    assert settings.motion.point_m == pytest.approx((-1.2, 0, 0.6))
    assert settings.gnss["gps0"].lever_arm_m == pytest.approx((-0.4, 0, -1.0))
    assert list(settings.wheel) == list(WHEELS)
    assert settings.wheel["front_right"].position_m == pytest.approx((1.5, 0.775, 0.6))
    assert (settings.wheel["front_right"].steered, settings.wheel["rear_left"].steered) == (True, False)
    assert settings.wheel["rear_left"].unsigned is noisy.wheels.unsigned
