"""ULogs in: the topics of old and new versions, dropouts, damage."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Invalid, Pressure, Received, WheelSpeed
from fusiond.units import SECOND
from fusiond_adapters.logs.file import LogError
from tests.helpers import logs
from tests.helpers.autopilot_logs import FIX_UNIX_S, ulog

pytest.importorskip("pyulog")

TEXT = '[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[gnss.gps0]\nlink = "fc"\n'
IMU = "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
OLD_GPS = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;float s_variance_m_s;float eph;"
    "float epv;float vel_m_s;float cog_rad;uint8_t fix_type;"
)
NEW_GPS = OLD_GPS.replace(
    "int32_t lat;int32_t lon;int32_t alt;", "double latitude_deg;double longitude_deg;double altitude_msl_m;"
)
MOTION = {"eph": 1.5, "epv": 2.5, "s_variance_m_s": 0.25, "vel_m_s": 10.0, "cog_rad": math.pi / 2, "fix_type": 3}
STAMPS = {"timestamp": 10_100_000, "time_utc_usec": FIX_UNIX_S * 10**6}


def read(folder: Path, content: bytes, text: str = TEXT) -> tuple[list[Received], dict[str, int]]:
    path = folder / "flight.ulg"
    path.write_bytes(content)
    return logs.events(path, config.parse(text))


@pytest.mark.parametrize(
    ("topic", "fields", "place"),
    [
        ("vehicle_gps_position", OLD_GPS, {"lat": 480_000_000, "lon": 110_000_000, "alt": 500_000}),
        ("sensor_gps", NEW_GPS, {"latitude_deg": 48.0, "longitude_deg": 11.0, "altitude_msl_m": 500.0}),
    ],
)
def test_inertial_samples_and_fixes(tmp_path: Path, topic: str, fields: str, place: dict[str, float]) -> None:
    sample = {"timestamp": 10_000_000, "gyro_rad[1]": 0.5, "accelerometer_m_s2[2]": -9.75}
    content = ulog({topic: (fields, [STAMPS | MOTION | place]), "sensor_combined": (IMU, [sample])}, dropout_ms=40)
    (inertial, position, velocity), counts = read(tmp_path, content)
    assert inertial.payload == ImuSample((0.0, 0.0, -9.75), (0.0, 0.5, 0.0))
    assert inertial.t_receive_ns == FIX_UNIX_S * SECOND - SECOND // 10
    assert position.payload == GnssPosition(math.radians(48), math.radians(11), 500.0, 1.5, 2.5, 3)
    assert (position.clock, position.t_sensor_ns) == ("fc/gps", FIX_UNIX_S * SECOND)
    assert isinstance(velocity.payload, GnssVelocity)
    assert (velocity.payload.north, velocity.payload.east) == pytest.approx((0.0, 10.0), abs=1e-6)
    assert counts == {"decoded": 2, "dropouts": 1}


def test_wheels_have_the_right_one_first(tmp_path: Path) -> None:
    fields = "uint64_t timestamp;float[2] wheel_speed;float[2] wheel_angle;"
    rows = [{"timestamp": 10**6 + 100_000 * n, "wheel_angle[0]": 4.0 * n, "wheel_angle[1]": 2.0 * n} for n in range(2)]
    wheels = "".join(f'[wheel.{s}]\nlink = "fc"\nindex = {n}\nradius_m = 0.25\n' for n, s in enumerate(("right", "left")))
    events, _ = read(tmp_path, ulog({"wheel_encoders": (fields, rows)}), TEXT + wheels)
    speeds = {event.source: event.payload.speed for event in events if isinstance(event.payload, WheelSpeed)}
    assert speeds == pytest.approx({"right": 10.0, "left": 5.0})


def test_pressure_of_old_logs_is_in_millibar(tmp_path: Path) -> None:
    for topic, name, value in (("vehicle_air_data", "baro_pressure_pa", 95_000.0), ("sensor_baro", "pressure", 950.0)):
        content = ulog({topic: (f"uint64_t timestamp;float {name};", [{"timestamp": 10**6, name: value}])})
        events, _ = read(tmp_path, content, TEXT + '[barometer.b]\nlink = "fc"\n')
        (payload,) = (event.payload for event in events)
        assert isinstance(payload, Pressure)
        assert payload.absolute == pytest.approx(95_000.0)


def test_a_fix_without_a_velocity_is_not_nan(tmp_path: Path) -> None:
    place = {"lat": 480_000_000, "lon": 110_000_000, "alt": 500_000}
    content = ulog({"vehicle_gps_position": (OLD_GPS, [STAMPS | MOTION | place | {"fix_type": 1, "cog_rad": math.nan}])})
    events, _ = read(tmp_path, content)
    assert [event.payload for event in events] == [Invalid("no fix")] * 2


def test_what_is_no_ulog(tmp_path: Path) -> None:
    whole = ulog({"sensor_combined": (IMU, [{"timestamp": n} for n in range(1, 50)])})
    for content in (b"x", b"nothing of the kind at all", whole[:7]):
        with pytest.raises(LogError, match="is not a ULog"):
            read(tmp_path, content)
    for cut in range(20, len(whole), 37):
        read(tmp_path, whole[:cut])  # no exception
