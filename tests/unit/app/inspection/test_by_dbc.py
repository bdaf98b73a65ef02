"""Sensors that a DBC file describes are found by names and units."""

from __future__ import annotations

import cantools
import pytest

from fusiond.app.inspection import by_dbc

DBC = """VERSION ""
BU_: ECU
BO_ 16 IMU_ACC: 6 ECU
 SG_ acc_x : 0|16@1- (0.001,0) [0|0] "g" Vector__XXX
 SG_ acc_y : 16|16@1- (0.001,0) [0|0] "g" Vector__XXX
 SG_ acc_z : 32|16@1- (0.001,0) [0|0] "g" Vector__XXX
BO_ 17 IMU_GYRO: 7 ECU
 SG_ RateX : 0|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ RateY : 16|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ RateZ : 32|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ GyroValid : 48|1@1+ (1,0) [0|1] "" Vector__XXX
BO_ 32 GPS: 8 ECU
 SG_ Latitude : 0|32@1- (1E-007,0) [0|0] "deg" Vector__XXX
 SG_ Longitude : 32|32@1- (1E-007,0) [0|0] "deg" Vector__XXX
BO_ 33 GPS_MORE: 8 ECU
 SG_ Altitude : 0|16@1- (0.1,0) [0|0] "m" Vector__XXX
 SG_ AltitudeAccuracy : 16|8@1+ (0.1,0) [0|0] "m" Vector__XXX
 SG_ FixType : 24|3@1+ (1,0) [0|7] "" Vector__XXX
 SG_ Speed : 32|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
 SG_ Course : 48|16@1+ (0.01,0) [0|0] "deg" Vector__XXX
BO_ 48 WHEELS: 8 ECU
 SG_ WSS_FL : 0|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
 SG_ WheelSpeedRearRight : 16|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
 SG_ YawRate : 32|16@1- (0.01,0) [0|0] "deg/s" Vector__XXX
VAL_ 33 FixType 0 "No fix" 1 "2D" 2 "3D fix" 3 "DGPS" 4 "RTK float" 5 "RTK fixed" ;
"""


@pytest.fixture
def messages() -> list[cantools.database.can.Message]:
    database = cantools.database.load_string(DBC, "dbc")
    assert isinstance(database, cantools.database.can.Database)
    return list(database.messages)


def test_an_inertial_sensor(messages: list[cantools.database.can.Message]) -> None:
    assert by_dbc.imu(messages) == {
        "accel_signals": ["IMU_ACC.acc_x", "IMU_ACC.acc_y", "IMU_ACC.acc_z"],
        "gyro_signals": ["IMU_GYRO.RateX", "IMU_GYRO.RateY", "IMU_GYRO.RateZ"],
        "accel_unit": "g",
        "gyro_unit": "deg/s",
        "valid_signals": ["IMU_GYRO.GyroValid"],
    }
    assert by_dbc.imu(messages[:1]) is None


def test_a_receiver(messages: list[cantools.database.can.Message]) -> None:
    assert by_dbc.gnss(messages) == {
        "latitude_signal": "GPS.Latitude",
        "longitude_signal": "GPS.Longitude",
        "height_signal": "GPS_MORE.Altitude",
        "speed_signal": "GPS_MORE.Speed",
        "course_signal": "GPS_MORE.Course",
        "speed_unit": "km/h",
        "height_sigma_signal": "GPS_MORE.AltitudeAccuracy",
        "fix_type_signal": "GPS_MORE.FixType",
        "fix_types": [0, 2, 3, 4, 5, 6],
    }
    assert by_dbc.gnss(messages[:3]) is None


def test_wheels(messages: list[cantools.database.can.Message]) -> None:
    found = dict(by_dbc.wheels(messages))
    assert {name: keys["signal"] for name, keys in found.items()} == {
        "front_left": "WSS_FL", "rear_right": "WheelSpeedRearRight",
    }  # fmt: skip
    assert found["front_left"]["quantum_mps"] == pytest.approx(0.01 / 3.6, rel=1e-3)
