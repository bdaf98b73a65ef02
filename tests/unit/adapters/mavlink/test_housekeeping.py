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
from fusiond_adapters.mavlink.timesync import Timesync
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


class Asked:
    """Housekeeping beside an ArduPilot that answers each request for an interval."""

    def __init__(self, settings: Config, least_ms: int, refused: frozenset[int] = frozenset()) -> None:
        self.housekeeping = Housekeeping(settings, "fc")
        self.intervals: dict[int, list[int]] = {}  # by message, as requested
        self._least_ms, self._refused = least_ms, refused
        self._sender = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
        kind, maker = common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_ARDUPILOTMEGA
        self.receive(common.MAVLink_heartbeat_message(kind, maker, 0, 0, common.MAV_STATE_ACTIVE, 3), 0)

    def receive(self, message: common.MAVLink_message, t_ns: int) -> None:
        self.housekeeping.receive(bytes(message.pack(self._sender)), t_ns)

    def run(self, seconds: int, *, answers_to: tuple[int, int] = (SYSTEM, 191)) -> None:
        for t_ns in range(0, seconds * SECOND, SECOND // 50):
            for message in parsed(b"".join(self.housekeeping.due(t_ns, alive=False))):
                if message.get_type() == "COMMAND_LONG":
                    number, interval_us = int(message.param1), int(message.param2)
                    self.intervals.setdefault(number, []).append(interval_us)
                    denied = interval_us // 1000 < self._least_ms or number in self._refused
                    result = common.MAV_RESULT_DENIED if denied else common.MAV_RESULT_ACCEPTED
                    self.receive(common.MAVLink_command_ack_message(message.command, result, 0, 0, *answers_to), t_ns)


def test_after_a_denial_less_is_requested(settings: Config) -> None:
    """A loop of 50 Hz denies less than 25 ms. The user is told what to set."""
    asked = Asked(settings, 25)
    asked.run(2)
    assert asked.intervals == {105: [ms * 1000 for ms in range(10, 26)], 24: [200_000], 2: [1_000_000]}
    assert asked.housekeeping.changes[1:] == [
        "HIGHRES_IMU is denied at 100 Hz, given at 40 Hz; ArduPilot sends at most 0.8 SCHED_LOOP_RATE: set SCHED_LOOP_RATE"
        " to 125 or more"
    ]
    wanted = asked.housekeeping.wanted["HIGHRES_IMU"]
    assert (wanted.denials, wanted.refused, wanted.requested_hz) == (15, None, 40.0)


def test_what_is_denied_at_any_rate_is_not_requested_for_ever(tmp_path: Path) -> None:
    more = '[wheel.third]\nlink = "fc"\nindex = 0\n'
    asked = Asked(configuration(tmp_path, "udpin:127.0.0.1:14550", more), 2, frozenset({9000}))
    asked.run(100)
    assert asked.intervals[9000] == [100_000]
    assert [change for change in asked.housekeeping.changes if "WHEEL" in change] == [
        "WHEEL_DISTANCE comes at 0 Hz, wanted at 10 Hz, refused: denied; ArduPilot sends it with its stream EXTRA3: set"
        " SRn_EXTRA3 of the port to 10"
    ]


def test_an_answer_for_another_is_none(settings: Config) -> None:
    """A ground station's request was denied, not ours."""
    asked = Asked(settings, 25)
    asked.run(2, answers_to=(255, 190))
    assert asked.intervals[105] == [10_000]
    assert asked.housekeeping.wanted["HIGHRES_IMU"].denials == 0


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
    step, now, sent_at = SECOND // 1000, 0, []
    while now < 12 * SECOND:
        sent_at += [now] * len(timesync_requests(housekeeping.due(now, alive=True)))
        now += max(1, housekeeping.wait_ns(now))
    intervals = [(b - a) / SECOND for a, b in pairwise(sent_at)]
    assert intervals[:20] == [pytest.approx(0.1, abs=0.013)] * 20
    assert intervals[20:] == [pytest.approx(1.0, abs=0.013)] * 9
    assert sum(intervals[:20]) == pytest.approx(2.0, abs=0.02)
    phases = sorted(at % (20 * step) for at in sent_at[:20])  # each waits differently for a loop of 50 Hz
    assert max(b - a for a, b in pairwise([*phases, phases[0] + 20 * step])) < 2 * step
    (stamp,) = timesync_requests(housekeeping.due(13 * SECOND + 123_456, alive=True))
    assert abs(stamp - (13 * SECOND + 123_456)) < 1000 and stamp % 1000 == 117
    for boot_ms in (10_000, 100):
        housekeeping.receive(autopilot.system_time(boot_ms), 14 * SECOND)
    for later_ns in (1, 150 * step):
        assert timesync_requests(housekeeping.due(14 * SECOND + later_ns, alive=True))


@pytest.mark.parametrize(
    ("to", "answered"),
    [((0, 0), True), ((SYSTEM, 191), True), ((SYSTEM, 0), True), ((SYSTEM, 1), False), ((9, 191), False), ((9, 0), False)],
)
def test_a_timesync_for_another_is_left_alone(settings: Config, to: tuple[int, int], answered: bool) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    station = common.MAVLink(None, srcSystem=255, srcComponent=190)
    housekeeping.receive(Timesync(0, 12_345, *to).pack(station), 5)
    replies = [frame for frame in housekeeping.due(6, alive=False) if parsed(frame)[0].get_type() == "TIMESYNC"][:-1]
    assert [(timesync.tc1, timesync.ts1) for timesync in parsed(b"".join(replies))] == ([(5, 12_345)] if answered else [])
    assert [frame[26:28] for frame in replies] == [bytes((255, 190))] * answered  # the answer's address


def test_requests_for_the_time_are_addressed_to_the_autopilot(settings: Config) -> None:
    housekeeping, autopilot = Housekeeping(settings, "fc"), Autopilot()
    housekeeping.receive(autopilot.heartbeat(), 0)
    (request,) = (frame for frame in housekeeping.due(1, alive=False) if parsed(frame)[0].get_type() == "TIMESYNC")
    assert request[26:28] == bytes((SYSTEM, 1))
    own = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=191)
    housekeeping.receive(Timesync(0, 5, 0, 0).pack(own), 1)  # as a router gives it back
    assert not [frame for frame in housekeeping.due(2, alive=False) if parsed(frame)[0].get_type() == "TIMESYNC"]


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
