"""What `fusiond check` prints of a configuration: a description of each sensor, and probable mistakes."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from fusiond.config.explain import description, oddities
from fusiond.config.load import parse
from fusiond.config.outputs import Foxglove, Mcap, Prometheus
from fusiond.config.schema import Config, sensor_tables
from tests.helpers.drive import settings

TEXT = """
[mavlink.fc]
[can.body]
dbc = ["car.dbc"]
delay_ms = 4.0
[imu.imu0]
link = "fc"
delay_ms = 4.0
[gnss.gps0]
link = "fc"
lever_arm_m = [0.5, 0.0, -1.25]
velocity_delay_ms = 70.0
[dual_antenna.yaw0]
link = "fc"
offset_deg = 90.0
stamp = "arrival"
[wheel.left]
bus = "body"
message = "WHEELS"
signal = "L"
position_m = [-1.5, -0.75, 0.5]
counter_signal = "COUNTER"
[wheel.right]
link = "fc"
index = 1
position_m = [-1.5, 0.75, 0.5]
[barometer.baro]
link = "fc"
[motion]
point_m = [-1.5, 0.0, 0.5]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "car.dbc").touch()
    return tmp_path


def read(folder: Path, text: str = TEXT) -> Config:
    return parse(text, folder / "car.toml")


def test_each_sensor_is_described(folder: Path) -> None:
    lines = list(description(read(folder)))
    first = next(i for i, line in enumerate(lines) if line.startswith("IMU"))
    last = next(i for i, line in enumerate(lines) if line.startswith("constraints"))
    assert lines[first:last] == [
        "IMU          imu0: HIGHRES_IMU of fc, delay 4 ms",
        "             turned by 0 0 0 deg (roll, pitch, yaw) against forward-right-down",
        "             noise 0.05 m/s^2/sqrt(Hz), 0.002 rad/s/sqrt(Hz)",
        "GNSS         gps0: GPS_RAW_INT of fc, by its own stamp, no delay",
        "             feeds gps0.position: sigma 1.5 m, in height 3 m",
            "             while it is RTK fixed: sigma 0.02 m, in height 0.03 m",
        "             feeds gps0.velocity: sigma 0.2 m/s, delay 70 ms",
        "             antenna at 0.5 0 -1.25 m (forward, right, down) from the IMU",
        "wheel        left: WHEELS.L of body in km/h, no delay",
        "             at -1.5 -0.75 0.5 m (forward, right, down), not steered, amount only, sigma 0.1 m/s",
        "             COUNTER must change",
        "wheel        right: WHEEL_DISTANCE[1] of fc, no delay",
        "             at -1.5 0.75 0.5 m (forward, right, down), not steered, amount only, sigma 0.1 m/s",
        "barometer    baro: SCALED_PRESSURE of fc, no delay",
        "             sigma 1 m about a height offset that is learnt",
        "GNSS yaw     yaw0: GPS_RAW_INT of fc, by its arrival, no delay",
        "             sigma 0.5 deg, baseline 90 deg clockwise from forward",
    ]


def test_labels_fit_their_column() -> None:
    assert all(0 < len(kind.label) <= 12 for kind in sensor_tables().values())


def test_nothing_is_odd_about_a_good_configuration(folder: Path) -> None:
    assert list(oddities(read(folder))) == []


@pytest.mark.parametrize(
    ("old", "new", "oddity"),
    [
        ("velocity_delay_ms = 70.0", "velocity_delay_ms = 1500.0", "gnss.gps0 (velocity): its delay of 1500 ms is not"),
        ("offset_deg = 90.0", "delay_ms = -5.0", "dual_antenna.yaw0: with a delay of -5 ms it would measure the future"),
        ("delay_ms = 4.0\n[imu", "delay_ms = 2000.0\n[imu", "wheel.left: its delay of 2000 ms is not below"),
        ("[0.5, 0.0, -1.25]", "[50.0, 0.0, -125.0]", "gnss.gps0.lever_arm_m: 50 0 -125 m (forward, right, down) is far"),
        ("[-1.5, -0.75, 0.5]", "[0.0, 0.0, 0.0]", "wheel.left.position_m: 0 0 0 puts it where the IMU is"),
        ("[mavlink.fc]", "[mavlink.fc]\n[can.chassis]", "can.chassis: no sensor comes by this bus"),
    ],
)
def test_probable_mistakes(folder: Path, old: str, new: str, oddity: str) -> None:
    (found,) = oddities(read(folder, TEXT.replace(old, new)))
    assert found.startswith(oddity)


def test_the_delay_of_an_ardupilot(folder: Path) -> None:
    """Nobody who sends the state to an ArduPilot should miss what its filters do; one who says something of it knows."""
    told = TEXT + '[autopilot]\nlink = "fc"\n'
    imu = '[imu.imu0]\nlink = "fc"\n'
    silent = told.replace(f"{imu}delay_ms = 4.0", imu)
    (found,) = oddities(read(folder, silent))
    assert found.startswith("imu.imu0: ArduPilot's low-pass filters delay")
    for good in (told, f'{silent}kind = "px4"\n', silent.replace(imu, f"{imu}delay_sigma_ms = 50.0\n")):
        assert list(oddities(read(folder, good))) == []


def test_a_learnt_delay_is_described(folder: Path) -> None:
    learnt = TEXT.replace("delay_ms = 4.0\n[gnss", "delay_ms = 4.0\ndelay_sigma_ms = 50.0\n[gnss")
    assert "IMU          imu0: HIGHRES_IMU of fc, delay 4 ms +- 50 ms, learnt" in description(read(folder, learnt))


def test_a_stream_that_is_turned_off_is_not_odd(folder: Path) -> None:
    off = TEXT.replace("velocity_delay_ms = 70.0", "velocity_delay_ms = 1500.0\nuse_velocity = false")
    assert list(oddities(read(folder, off))) == []


def test_outputs_that_are_on_are_listed() -> None:
    tables = {"mcap": Mcap(folder="out"), "foxglove": Foxglove(enabled=True), "prometheus": Prometheus(enabled=True)}
    on = "\n".join(description(msgspec.structs.replace(settings(), **tables)))
    off = "\n".join(description(settings()))
    for line in ("ws://127.0.0.1:8765", "http://127.0.0.1:9464/metrics", "1024 MB at most"):
        assert line in on and line not in off
