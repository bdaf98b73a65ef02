"""What fusiond asks an autopilot for: every message that a sensor of the link reads, at the highest rate wanted of it."""

from __future__ import annotations

from fusiond.config.load import parse
from fusiond_adapters.mavlink.talk import MavlinkTalk

TEXT = """
[mavlink.fc]
[mavlink.second]
[imu.imu0]
link = "fc"
rate_hz = 200.0
[gnss.gps0]
link = "fc"
interval_s = 0.2
[gnss.gps1]
link = "second"
interval_s = 0.5
[dual_antenna.yaw0]
link = "fc"
interval_s = 0.1
[wheel.left]
link = "fc"
index = 0
rate_hz = 20.0
[wheel.right]
link = "fc"
index = 1
rate_hz = 10.0
[barometer.baro]
link = "second"
rate_hz = 4.0
"""


def wanted(link: str, text: str = TEXT) -> dict[str, float]:
    return {name: message.rate_hz for name, message in MavlinkTalk(parse(text), link).wanted.items()}


def test_each_message_is_wanted_at_the_highest_rate_of_its_sensors() -> None:
    assert wanted("fc") == {"HIGHRES_IMU": 200.0, "GPS_RAW_INT": 10.0, "WHEEL_DISTANCE": 20.0, "SYSTEM_TIME": 1.0}
    assert wanted("second") == {"GPS_RAW_INT": 2.0, "SCALED_PRESSURE": 4.0, "SYSTEM_TIME": 1.0}


def test_nothing_is_wanted_of_a_link_without_sensors_or_requests() -> None:
    assert wanted("radio", TEXT + "[mavlink.radio]\n") == {}
    assert wanted("fc", TEXT.replace("[mavlink.fc]", "[mavlink.fc]\nrequest = false")) == {}
