"""DataFlash logs in: instances, units, old names, clocks, damage at every place."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Pressure, Received, WheelSpeed
from fusiond.units import SECOND
from fusiond_adapters.logs.file import LogError
from tests.helpers import logs
from tests.helpers.autopilot_logs import FIX_UNIX_S, described, fix, record

BASE = '[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n'
GNSS = '[gnss.gps0]\nlink = "fc"\n'
BOOT_NS = (FIX_UNIX_S - 10) * SECOND


def read(folder: Path, content: bytes, text: str = BASE) -> tuple[list[Received], dict[str, int]]:
    path = folder / "drive.bin"
    path.write_bytes(content)
    return logs.events(path, config.parse(text))


def imu(t_us: int, instance: int = 0, **more: float) -> bytes:
    return record("IMU", TimeUS=t_us, I=instance, AccZ=-9.75, **more)


def test_inertial_samples_of_the_configured_instance(tmp_path: Path) -> None:
    content = described("IMU", "GPS") + imu(11_000_000, GyrX=0.5) + imu(11_000_000, 1, GyrX=0.25) + fix(11_005_000)
    for text, rate in ((BASE, 0.5), (BASE + "instance = 1\n", 0.25), (BASE + 'message = "SCALED_IMU2"\n', 0.25)):
        (event,), _ = read(tmp_path, content, text)
        assert (event.source, event.clock, event.t_sensor_ns) == ("imu0", "fc/1/boot", 11 * SECOND)
        assert event.t_receive_ns == BOOT_NS + 11 * SECOND  # the first fix counts as not late
        assert isinstance(event.payload, ImuSample)
        assert event.payload.specific_force_b == pytest.approx((0.0, 0.0, -9.75))
        assert event.payload.angular_rate_b == pytest.approx((rate, 0.0, 0.0))


def test_old_logs_have_the_instance_in_the_name(tmp_path: Path) -> None:
    content = described("IMU2") + record("IMU2", TimeMS=5, AccZ=-9.75, GyrY=0.125)
    (event,), counts = read(tmp_path, content, BASE + "instance = 1\n")
    assert (event.t_sensor_ns, event.t_receive_ns) == (5_000_000, 5_000_000)  # without a fix, from boot
    assert counts == {"records": 2, "decoded": 1}


def test_fixes_with_their_accuracies_and_their_own_clock(tmp_path: Path) -> None:
    content = described("GPS", "GPA") + fix(10_000_000, Status=1, GWk=0) + fix(11_000_000)
    content += record("GPA", TimeUS=11_200_000, HAcc=1.5, VAcc=2.5, SAcc=0.25)
    content += fix(11_250_000, age_ms=50, Status=6, Alt=501.25)
    events, _ = read(tmp_path, content, BASE + GNSS)
    positions = [event for event in events if event.source == "gps0.position"]
    assert [type(event.payload).__name__ for event in positions] == ["Invalid", "GnssPosition", "GnssPosition"]
    last = positions[-1]
    assert (last.clock, last.t_sensor_ns) == ("fc/gps", FIX_UNIX_S * SECOND + 1_200_000_000)
    assert last.t_receive_ns == FIX_UNIX_S * SECOND + 1_250_000_000
    assert isinstance(last.payload, GnssPosition)
    assert (last.payload.latitude, last.payload.longitude) == pytest.approx((math.radians(48), math.radians(11)))
    assert (last.payload.height, last.payload.fix_type) == (pytest.approx(501.25), 6)
    assert (last.payload.sigma_horizontal, last.payload.sigma_vertical) == pytest.approx((1.5, 2.5))
    assert isinstance(positions[1].payload, GnssPosition)
    assert positions[1].payload.sigma_horizontal is None
    velocity = events[-1].payload
    assert isinstance(velocity, GnssVelocity)
    assert (velocity.north, velocity.east, velocity.sigma) == pytest.approx((0.0, 10.0, 0.25), abs=1e-9)


def test_yaw_of_two_antennas(tmp_path: Path) -> None:
    content = described("GPS") + fix(11_000_000, Yaw=0) + fix(12_000_000, Yaw=123.25) + fix(13_000_000, Yaw=360)
    events, _ = read(tmp_path, content, BASE + '[dual_antenna.yaw0]\nlink = "fc"\n')
    yaws = [getattr(event.payload, "yaw", None) for event in events]
    assert yaws == [None, pytest.approx(math.radians(123.25)), pytest.approx(math.radians(360))]


def test_wheels_and_barometer(tmp_path: Path) -> None:
    wheels = "".join(f'[wheel.{name}]\nlink = "fc"\nindex = {number}\n' for number, name in enumerate(("left", "right")))
    content = described("WENC", "BARO") + record("WENC", TimeUS=1_000_000, Dist0=1.0, Dist1=2.0)
    content += record("BARO", TimeUS=1_050_000, Press=95_000.0, Temp=20.5)
    content += record("WENC", TimeUS=1_100_000, Dist0=1.5, Dist1=3.0)
    events, _ = read(tmp_path, content, BASE + wheels + '[barometer.b]\nlink = "fc"\n')
    assert [event.source for event in events] == ["b", "left", "right"]
    assert isinstance(events[0].payload, Pressure)
    assert (events[0].payload.absolute, events[0].payload.temperature) == pytest.approx((95_000.0, 293.65))
    speeds = [event.payload.speed for event in events if isinstance(event.payload, WheelSpeed)]
    assert speeds == pytest.approx([5.0, 10.0])


def test_wheels_of_a_log_for_replay(tmp_path: Path) -> None:
    content = described("RWOH")
    for number in range(3):
        for side in (-0.5, 0.5):
            content += record("RWOH", DA=1.0 + side, DT=0.1, TS=1000 + 100 * number, PY=side, R=0.25)
    events, _ = read(tmp_path, content, BASE + '[wheel.left]\nlink = "fc"\nindex = 0\n')
    assert [event.payload.speed for event in events if isinstance(event.payload, WheelSpeed)] == pytest.approx([1.25] * 2)


def test_damage_loses_only_what_it_hits(tmp_path: Path) -> None:
    head, samples = described("IMU"), [imu(1_000_000 + 10_000 * number) for number in range(20)]
    whole = head + b"".join(samples)
    for cut in range(len(head) + 1, len(whole), 7):
        events, counts = read(tmp_path, whole[:cut])
        assert len(events) == (cut - len(head)) // len(samples[0])
        assert counts["records"] == len(events) + 1
    events, counts = read(tmp_path, head + samples[0] + b"garbage\xa3" + samples[1])
    assert (len(events), counts["bad bytes"]) == (2, 8)


def test_what_is_no_dataflash_log(tmp_path: Path) -> None:
    for content in (b"nothing of the kind", b"\xa3\x95", bytes(1000)):
        with pytest.raises(LogError, match=r"no record in it; is it a DataFlash log"):
            read(tmp_path, content)


def test_a_log_needs_a_link(tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    path.write_bytes(described("IMU"))
    with pytest.raises(LogError, match=r"no \[mavlink.NAME\]"):
        logs.events(path, config.parse('[can.c]\ndbc = ["c.dbc"]\n' + IMU_BY_CAN, _dbc(tmp_path)))


IMU_BY_CAN = '[imu.imu0]\nbus = "c"\naccel_signals = ["m.a", "m.b", "m.c"]\ngyro_signals = ["m.d", "m.e", "m.f"]\n'


def _dbc(folder: Path) -> Path:
    (folder / "c.dbc").touch()
    return folder / "car.toml"
