"""A configuration is loaded, and contradictions between its tables are reported by file, line and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.config.schema import sensor_tables
from fusiond.config.toml import ConfigError
from tests.helpers.complaints import BASE, CAR, GNSS, check, complaint

DBC = "car.dbc"
WHEEL = """[can.body]
dbc = ["car.dbc"]
[wheel.rear_left]
bus = "body"
message = "WHEELS"
signal = "RL"
"""


def test_defaults() -> None:
    loaded = config.parse(BASE, CAR)
    assert loaded.sources() == ("imu0",)
    assert (loaded.filter.horizon_s, loaded.motion.non_holonomic, loaded.directory) == (1.0, True, "/etc/fusiond")
    assert loaded.path("x.dbc") == Path("/etc/fusiond/x.dbc")


def test_a_whole_configuration(tmp_path: Path) -> None:
    (tmp_path / DBC).write_text("")
    (tmp_path / "car.toml").write_text(BASE + GNSS + WHEEL + '[vehicle]\nname = "rover_1"\n')
    loaded = config.load(tmp_path / "car.toml")
    assert loaded.sources() == ("gps0.position", "gps0.velocity", "imu0", "rear_left")
    assert loaded.vehicle.name == "rover_1"


@pytest.mark.parametrize(
    ("text", "line", "key", "parts"),
    [
        (GNSS.replace("autopilot", "other"), 5, "gnss.gps0.link", ["there is no [mavlink.other]", "autopilot"]),
        ("[wheel.w]\nbus = 'c'\nmessage = 'm'\nsignal = 's'", 5, "wheel.w.bus", ["no [can.c]", "configured: none"]),
        ("[imu.imu1]\nlink = 'autopilot'", 4, "imu.imu1", ["exactly one", "found 2"]),
        ("[gnss.imu0]\nlink = 'autopilot'", 4, "gnss.imu0", ["[imu.imu0] has this name"]),
        (WHEEL + "scale = 0", 10, "wheel.rear_left.scale", ["must not be 0"]),
        (WHEEL + "unit = 'rpm'", 10, "wheel.rear_left.unit", ["rpm needs radius_m"]),
        (WHEEL, 5, "can.body.dbc", ["no such file: /etc/fusiond/car.dbc"]),
        (WHEEL.replace('dbc = ["car.dbc"]', ""), 4, "can.body", ["need a DBC file"]),
        ("[filter]\nimu_gap_s = 1.0", 5, "filter.imu_gap_s", ["must be below horizon_s (1.0 s)"]),
        ("[vehicle]\nname = 'a/b'", 5, "vehicle.name", ["letters, digits and underscores"]),
        ("[gnss.'a b']\nlink = 'autopilot'", 4, "gnss.a b", ["letters, digits and underscores"]),
        ('[gnss."a.b"]\nlink = "autopilot"', 4, "gnss.a.b", ["letters, digits and underscores"]),
    ],
)
def test_contradictions(text: str, line: int, key: str, parts: list[str]) -> None:
    check(BASE + text, line, key, *parts)


SIGNALS = "bus = 'c'\naccel_signals = ['m.x', 'm.y', 'm.z']\ngyro_signals = ['m.p', 'm.q', 'm.r']\n"
PLACE = "bus = 'c'\nlatitude_signal = 'm.a'\nlongitude_signal = 'm.b'\nheight_signal = 'm.h'\n"
BOTH = "one of 'link' (MAVLink) and 'bus' (CAN) is needed, and not both"


@pytest.mark.parametrize(
    ("sensor", "line", "key", "complaint"),
    [
        (SIGNALS.replace("gyro_signals", "# "), 3, "imu.imu0", "the key 'gyro_signals' is missing: it comes by bus"),
        (SIGNALS + "link = 'autopilot'", 3, "imu.imu0", BOTH),
        (SIGNALS.replace("m.p", "p"), 6, "imu.imu0.gyro_signals[0]", "must be a signal of the DBC, written MESSAGE.SIGNAL"),
        (SIGNALS.replace("bus = 'c'", "link = 'autopilot'"), 5, "imu.imu0.accel_signals", "no meaning for a sensor that"),
    ],
)
def test_contradictions_of_an_imu(tmp_path: Path, sensor: str, line: int, key: str, complaint: str) -> None:
    (tmp_path / DBC).touch()
    with pytest.raises(ConfigError) as raised:
        config.parse(f"[mavlink.autopilot]\n[can.c]\n[imu.imu0]\n{sensor}\n", tmp_path / "car.toml")
    assert f"car.toml:{line}: {key}: " in str(raised.value)
    assert complaint in str(raised.value)


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ("speed_signal = 'm.s'", "a velocity is speed_signal and course_signal, or north_signal and east_signal"),
        ("north_signal = 'm.n'\neast_signal = 'm.e'\ncourse_signal = 'm.s'", "a velocity is speed_signal"),
        ("link = 'autopilot'", BOTH),
    ],
)
def test_contradictions_of_a_receiver(more: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as raised:
        config.parse(f"{BASE}[can.c]\n[gnss.gps0]\n{PLACE}{more}\n")
    assert complaint in str(raised.value)


def test_a_receiver_on_a_bus_gives_a_velocity_where_its_signals_do(tmp_path: Path) -> None:
    (tmp_path / DBC).touch()
    text = f"{BASE}[can.c]\ndbc = ['{DBC}']\n[gnss.gps0]\n{PLACE}"
    for more, enabled in (("", False), ("speed_signal = 's.s'\ncourse_signal = 's.c'", True)):
        loaded = config.parse(f"{text}{more}\n", tmp_path / "car.toml")
        assert loaded.streams()["gps0.velocity"].stream.enabled is enabled
        assert set(loaded.gnss["gps0"].messages()) == ({"m", "s"} if enabled else {"m"})


SENSORS = {  # a table of each kind of sensor, its last line the input that it comes by
    "imu.imu0": "link = 'autopilot'",
    "gnss.gps0": "link = 'autopilot'",
    "gnss.gps1": "latitude_signal = 'm.a'\nlongitude_signal = 'm.b'\nheight_signal = 'm.c'\nbus = 'chassis'",
    "wheel.left": "message = 'm'\nsignal = 's'\nbus = 'chassis'",
    "wheel.right": "index = 2\nlink = 'autopilot'",
    "barometer.b": "link = 'autopilot'",
    "dual_antenna.yaw": "link = 'autopilot'",
    "yaw_rate.esc": "signal = 'm.a'\nbus = 'chassis'",
    "steering.wheel": "signal = 'm.a'\nwheelbase_m = 2.7\nbus = 'chassis'",
    "lateral_acceleration.esc": "signal = 'm.a'\nbus = 'chassis'",
    "parked.gear": "signal = 'm.a'\nbus = 'chassis'",
}


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_typing_error_in_an_input_names_what_was_meant(sensor: str) -> None:
    others = "[mavlink.radio]\n[mavlink.autopilot]\n[can.chassis]\n"
    imu = "" if sensor == "imu.imu0" else f"[imu.imu0]\n{SENSORS['imu.imu0']}\n"
    text = f"{others}{imu}[{sensor}]\n{SENSORS[sensor]}"
    key, _, name = text.splitlines()[-1].partition(" = ")
    table, name = {"link": "mavlink", "bus": "can"}[key], name.strip("'")
    wrong = text.removesuffix("'") + "s'"
    check(wrong, wrong.count("\n") + 1, f"{sensor}.{key}",
          f"there is no [{table}.{name}s] (did you mean '{name}'?)", "configured: ", name)  # fmt: skip


def test_every_kind_of_sensor_is_tried_with_a_typing_error() -> None:
    assert {sensor.partition(".")[0] for sensor in SENSORS} == set(sensor_tables())


def test_a_name_that_is_like_none_is_only_refused() -> None:
    assert "did you mean" not in complaint(BASE + GNSS.replace("autopilot", "xyz"))


def test_a_typing_error_in_the_link_of_an_output() -> None:
    for table in ("autopilot", "ground_station"):
        text = f"[{table}]\nlink = 'autopilto'"
        check(BASE + text, 5, f"{table}.link", "no [mavlink.autopilto]", "did you mean 'autopilot'?")


@pytest.mark.parametrize(
    ("first", "second", "origin"),
    [
        ("[gnss.a]\nlink = 'fc'", "[gnss.b]\nlink = 'fc'\nstamp = 'arrival'", "GPS_RAW_INT of fc"),
        ("[dual_antenna.a]\nlink = 'fc'", "[dual_antenna.b]\nlink = 'fc'\noffset_deg = 90", "GPS_RAW_INT of fc"),
        ("[wheel.a]\nlink = 'fc'\nindex = 1", "[wheel.b]\nlink = 'fc'\nindex = 1", "WHEEL_DISTANCE[1] of fc"),
        (
            "[wheel.a]\nbus = 'body'\nmessage = 'm'\nsignal = 's'",
            "[wheel.b]\nbus = 'body'\nmessage = 'm'\nsignal = 's'\nunit = 'mph'",
            "m.s of body",
        ),
    ],
)
def test_two_sensors_of_a_kind_cannot_read_the_same(tmp_path: Path, first: str, second: str, origin: str) -> None:
    (tmp_path / DBC).touch()
    text = f"[mavlink.fc]\n[mavlink.other]\n[can.body]\ndbc = ['{DBC}']\n[imu.imu0]\nlink = 'fc'\n{first}\n"
    file = tmp_path / "car.toml"
    table = second.partition(".")[0].strip("[")
    message = complaint(text + second, file)
    assert f": {table}.b: reads the same as [{table}.a]: {origin}" in message
    for mine, other in (("'fc'", "'other'"), ("index = 1", "index = 2"), ("signal = 's'", "signal = 't'")):
        if mine in second:
            assert config.parse(text + second.replace(mine, other), file)


def test_sensors_of_two_kinds_can_read_one_message() -> None:
    both = config.parse(BASE + GNSS + "[dual_antenna.yaw0]\nlink = 'autopilot'\n")
    assert both.sources() == ("gps0.position", "gps0.velocity", "imu0", "yaw0")


@pytest.mark.parametrize("reader", ["gnss.gps1", "dual_antenna.yaw0"])
def test_what_is_sent_to_the_autopilot_must_not_come_back_as_a_measurement(reader: str) -> None:
    text = f"[{reader}]\nlink = 'autopilot'\nmessage = 'GPS2_RAW'\n[autopilot]\nlink = 'autopilot'\nmessage = 'gps_input'\n"
    check(BASE + text, 7, "autopilot.gps_id", "send it back as GPS2_RAW", f"[{reader}] reads")
    assert config.parse(BASE + text.replace("GPS2_RAW", "GPS_RAW_INT")).autopilot.gps_id == 1


@pytest.mark.parametrize("sensor", ["gnss.gps0", "barometer.b", "dual_antenna.yaw0"])
def test_bounds_of_the_learnt_noise_are_in_order(sensor: str) -> None:
    text = f"[{sensor}]\nlink = 'autopilot'\nnoise_most = 2\nnoise_least = 2.5"
    check(BASE + text, 7, f"{sensor}.noise_least", "must not exceed noise_most (2)")


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ("", "tcp/127.0.0.1:7447 is where \\[zenoh\\] listens"),
        ('odom_frame = "map"', "must differ"),
        ("origin = [91.0, 0.0, 0.0]", "latitude must be in"),
    ],
)
def test_contradictions_on_ros2(lines: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        config.parse(f"{BASE}\n[ros2]\nenabled = true\n{lines}\n", CAR)


@pytest.mark.parametrize(
    ("more", "key"),
    [
        ('[autopilot]\nlink = "none"', "autopilot.link"),
        ('[autopilot]\nlink = "autopilot"\nkind = "px4"\nmessage = "gps_input"', "autopilot.message"),
        ('[autopilot]\nlink = "autopilot"\nrate_hz = 150.0', "autopilot.rate_hz"),
        ('[autopilot]\nlink = "autopilot"\nmessage = "gps_input"\ngps_id = 0', "autopilot.gps_id"),
        ('[autopilot]\nlink = "autopilot"\nset_origin = true\nmessage = "gps_input"', "autopilot.set_origin"),
        ('[ground_station]\nlink = "none"', "ground_station.link"),
        ('[ground_station]\nlink = "autopilot"\nconnection = "udpout:127.0.0.1:1"', "ground_station.connection"),
    ],
)
def test_contradictions_on_mavlink_outputs(more: str, key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        config.parse(f"{BASE}\n[publish]\nrate_hz = 100.0\n[gnss.gps0]\nlink = \"autopilot\"\n{more}\n", CAR)


def test_no_imu() -> None:
    check("[mavlink.autopilot]\n", 1, "imu", "exactly one [imu.NAME] is needed, found 0")
    assert complaint("").startswith(f"{CAR}:1: imu: ")


