"""Housekeeping of a MAVLink link: requested messages and their rates, heartbeats, TIMESYNC, reboots."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import common

from fusiond.config.load import parse
from fusiond.config.schema import Config
from fusiond.units import SECOND
from fusiond_adapters.mavlink.housekeeping import Housekeeping
from tests.helpers.live import SYSTEM, Autopilot, configuration, parsed

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


@pytest.fixture
def settings(tmp_path: Path) -> Config:
    return configuration(tmp_path, "udpin:127.0.0.1:14550")


def wanted(link: str, text: str = TEXT) -> dict[str, float]:
    return {name: message.rate_hz for name, message in Housekeeping(parse(text), link).wanted.items()}


def test_each_message_is_wanted_at_the_highest_rate_of_its_sensors() -> None:
    assert wanted("fc") == {"HIGHRES_IMU": 200.0, "GPS_RAW_INT": 10.0, "WHEEL_DISTANCE": 20.0, "SYSTEM_TIME": 1.0}
    assert wanted("second") == {"GPS_RAW_INT": 2.0, "SCALED_PRESSURE": 4.0, "SYSTEM_TIME": 1.0}


def test_nothing_is_wanted_of_a_link_without_sensors_or_requests() -> None:
    assert wanted("radio", TEXT + "[mavlink.radio]\n") == {}
    assert wanted("fc", TEXT.replace("[mavlink.fc]", "[mavlink.fc]\nrequest = false")) == {}


def requests(sent: list[bytes]) -> list[int]:
    return sorted(int(m.param1) for m in parsed(b"".join(sent)) if m.get_type() == "COMMAND_LONG")


def test_nothing_is_requested_from_a_ground_station(settings: Config) -> None:
    housekeeping = Housekeeping(settings, "fc")
    station = common.MAVLink(None, srcSystem=255, srcComponent=190)
    message = common.MAVLink_heartbeat_message(common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
    housekeeping.receive(bytes(message.pack(station)), 0)
    assert housekeeping.target is None
    assert requests(housekeeping.due(SECOND, alive=True)) == []


def test_nothing_is_requested_from_another_component(settings: Config) -> None:
    link = msgspec.structs.replace(settings.mavlink["fc"], component=2)
    housekeeping = Housekeeping(msgspec.structs.replace(settings, mavlink={"fc": link}), "fc")
    housekeeping.receive(Autopilot().heartbeat(), 0)
    assert housekeeping.target is None


def test_requests_are_repeated_at_growing_intervals_until_the_rate_is_reached(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    assert housekeeping.target == (SYSTEM, 1)
    sent_at = [second for second in range(60) if 105 in requests(housekeeping.due(second * SECOND, alive=True))]
    assert sent_at == [0, 3, 9, 21, 45]
    for _ in range(250):  # of the 300 wanted in three seconds
        housekeeping.receive(autopilot.imu(), 62 * SECOND)
    assert 105 not in requests(housekeeping.due(63 * SECOND, alive=True))
    assert housekeeping.wanted["HIGHRES_IMU"].measured_hz == pytest.approx(250 / 3, rel=0.5)


def test_a_rate_that_falls_is_requested_at_once(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    housekeeping.due(0, alive=True)
    for _ in range(300):
        housekeeping.receive(autopilot.imu(), SECOND)
    housekeeping.due(3 * SECOND, alive=True)
    assert housekeeping.wanted["HIGHRES_IMU"].good
    assert 105 in requests(housekeeping.due(6 * SECOND, alive=True))


def test_a_refusal_is_remembered(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    housekeeping.due(0, alive=True)
    command, result = common.MAV_CMD_SET_MESSAGE_INTERVAL, common.MAV_RESULT_UNSUPPORTED
    housekeeping.receive(autopilot.pack(common.MAVLink_command_ack_message(command, result)), 1)
    assert housekeeping.wanted["HIGHRES_IMU"].refused == "unsupported"


def test_heartbeats_stop_with_the_estimator(settings: Config) -> None:
    housekeeping = Housekeeping(settings, "fc")
    counts = [len(housekeeping.due(second * SECOND // 2, alive=second < 10)) for second in range(20)]
    assert counts == [1, 0] * 5 + [0] * 10


def timesync_requests(sent: list[bytes]) -> list[int]:
    return [m.ts1 for m in parsed(b"".join(sent)) if m.get_type() == "TIMESYNC" and m.tc1 == 0]


def test_timesync_is_frequent_at_first_and_after_a_reboot(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    assert timesync_requests(housekeeping.due(0, alive=True)) == []  # no autopilot yet
    housekeeping.receive(autopilot.heartbeat(), 0)
    step = SECOND // 20
    sent_at = [k * step for k in range(200) if timesync_requests(housekeeping.due(k * step, alive=True))]
    assert sent_at[:20] == [k * 2 * step for k in range(20)]
    assert {b - a for a, b in pairwise(sent_at[20:])} == {SECOND}
    (stamp,) = timesync_requests(housekeeping.due(11 * SECOND + 123_456, alive=True))
    assert abs(stamp - (11 * SECOND + 123_456)) < 1000 and stamp % 1000 == 117
    for boot_ms in (10_000, 100):
        housekeeping.receive(autopilot.system_time(boot_ms), 12 * SECOND)
    for later_ns in (1, 3 * step):
        assert timesync_requests(housekeeping.due(12 * SECOND + later_ns, alive=True))


def test_changes_are_reported_once(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    for second in range(13):
        for _ in range(0 if second < 6 else 100):
            housekeeping.receive(autopilot.imu(), second * SECOND)
        housekeeping.due(second * SECOND, alive=True)
    changes = [line for line in housekeeping.changes if "IMU" in line or "autopilot" in line]
    assert changes == [
        f"the autopilot is system {SYSTEM}, component 1",
        "HIGHRES_IMU comes at 0 Hz, wanted at 100 Hz",
        "HIGHRES_IMU comes at 100 Hz, wanted at 100 Hz",
    ]


def test_a_reordered_frame_is_no_reboot(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    for boot_ms in (10_000, 9_500, 10_500):
        housekeeping.receive(autopilot.system_time(boot_ms), 0)
    assert housekeeping.reboots == 0
    housekeeping.receive(autopilot.system_time(100), 0)
    assert housekeeping.reboots == 1
