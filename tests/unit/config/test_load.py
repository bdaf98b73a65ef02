"""What is wrong with a configuration is told by file, line and key, with what is allowed; what is right is taken."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.config.schema import Config, sensor_tables
from fusiond.config.toml import ConfigError

CAR = Path("/etc/fusiond/car.toml")
BASE = """[mavlink.autopilot]
[imu.imu0]
link = "autopilot"
"""
GNSS = '[gnss.gps0]\nlink = "autopilot"\n'
DBC = "car.dbc"
WHEEL = """[can.body]
dbc = ["car.dbc"]
[wheel.rear_left]
bus = "body"
message = "WHEELS"
signal = "RL"
"""


def complaint(text: str, path: Path = CAR) -> str:
    with pytest.raises(ConfigError) as raised:
        config.parse(text, path)
    return str(raised.value)


def check(text: str, line: int, key: str, *parts: str) -> None:
    """The complaint names the file, the line, the key, and the parts in this order."""
    message = complaint(text)
    assert message.startswith(f"{CAR}:{line}: {key}: ")
    rest = message
    for part in parts:
        assert part in rest
        rest = rest.split(part, 1)[1]


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


def test_whole_numbers_serve_for_numbers() -> None:
    assert config.parse(BASE + "[filter]\nhorizon_s = 2\n").filter.horizon_s == 2.0


@pytest.mark.parametrize("number", ["inf", "-inf", "nan", "+nan"])
@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[filter]\nhorizon_s = {}", "filter.horizon_s"),
        ("[motion]\nlateral_sigma_mps = {}", "motion.lateral_sigma_mps"),
        ("[motion]\npoint_m = [0.0, {}, 0.0]", "motion.point_m[1]"),
        ("[gnss.gps0]\ndelay_ms = {}", "gnss.gps0.delay_ms"),
        ("[publish]\nrate_hz = {}", "publish.rate_hz"),
    ],
)
def test_numbers_that_are_not_finite(text: str, key: str, number: str) -> None:
    check(BASE + text.format(number), 5, key, "must be a finite number")


@pytest.mark.parametrize(
    ("text", "key", "part"),
    [
        ("[filter]\nhorizon_s = 0", "filter.horizon_s", "> 0"),
        ("[filter]\nhorizon_s = 1e300", "filter.horizon_s", "<= 1000000"),
        ("[filter]\ngate_probability = 1.0", "filter.gate_probability", "< 1"),
        ("[filter]\nsnapshot_interval_s = -0.1", "filter.snapshot_interval_s", ">= 0"),
        ("[filter]\nheading_deg = 361", "filter.heading_deg", "<= 360"),
        ("[motion]\npoint_m = [0, 1]", "motion.point_m", "length 3"),
        ("[publish]\nrate_hz = 2000", "publish.rate_hz", "<= 1000"),
        ("[mavlink.b]\nsystem = 256", "mavlink.b.system", "<= 255"),
        ("[gnss.gps0]\ndelay_ms = 1e9", "gnss.gps0.delay_ms", "<= 1000000"),
        ('[filter]\nhorizon_s = "1"', "filter.horizon_s", "Expected `float`, got `str`"),
        ("[filter]\nhorizon_s = true", "filter.horizon_s", "Expected `float`, got `bool`"),
        ("[motion]\nnon_holonomic = 1", "motion.non_holonomic", "Expected `bool`, got `int`"),
        ("[mavlink.b]\nbaud = 1.5", "mavlink.b.baud", "Expected `int`, got `float`"),
        ("[can.body]\ndbc = 'car.dbc'", "can.body.dbc", "Expected `array`, got `str`"),
    ],
)
def test_values_out_of_range_or_of_the_wrong_type(text: str, key: str, part: str) -> None:
    check(BASE + text.replace("[gnss.gps0]", '[gnss.gps0]\nlink = "autopilot"'), 5 + ("gnss" in text), key, part)


@pytest.mark.parametrize(
    ("text", "key", "bad", "allowed"),
    [
        ("[publish]\nencoding = 'xml'", "publish.encoding", "xml", ["json", "msgpack"]),
        ("[zenoh]\nmode = 'server'", "zenoh.mode", "server", ["peer", "client", "router"]),
        ("[gnss.gps0]\nmessage = 'GPS3'", "gnss.gps0.message", "GPS3", ["GPS_RAW_INT", "GPS2_RAW"]),
        ("[gnss.gps0]\nstamp = 'none'", "gnss.gps0.stamp", "none", ["sensor", "arrival"]),
        ("[wheel.w]\nunit = 'knots'", "wheel.w.unit", "knots", ["m/s", "km/h", "mph", "rad/s", "rpm"]),
    ],
)
def test_a_choice_lists_what_may_be_chosen(text: str, key: str, bad: str, allowed: list[str]) -> None:
    text = text.replace("[wheel.w]", "[wheel.w]\nbus = 'c'\nmessage = 'm'\nsignal = 's'")
    text = text.replace("[gnss.gps0]", "[gnss.gps0]\nlink = 'autopilot'")
    line = (BASE + text).count("\n") + 1
    check(BASE + text, line, key, bad, "allowed: " + ", ".join(allowed))


def test_unknown_keys_list_the_known_ones() -> None:
    check(BASE + "[filter]\nhorizon = 1", 5, "filter.horizon", "unknown key; allowed: ", "gate_probability", "horizon_s")
    check(BASE + "[filtre]\nhorizon_s = 1", 4, "filtre", "unknown key; allowed: ", "filter", "vehicle")
    check(BASE + GNSS + "lever_arm = [0, 0, 0]", 6, "gnss.gps0.lever_arm", "unknown key", "lever_arm_m")
    check("directory = 'x'\n" + BASE, 1, "directory", "unknown key")
    assert "directory" not in complaint(BASE + "[filtre]").split("allowed")[1]


def test_missing_keys() -> None:
    check(BASE + "[gnss.gps0]\nmessage = 'GPS2_RAW'", 4, "gnss.gps0", "the key 'link' is missing")
    check(BASE + "[wheel.w]\nbus = 'b'\nmessage = 'm'", 4, "wheel.w", "the key 'signal' is missing")


def test_the_fault_is_found_in_the_right_table_of_many() -> None:
    text = BASE + GNSS + "[gnss.gps1]\nlink = 'autopilot'\ninterval_s = -1"
    check(text, 8, "gnss.gps1.interval_s", "> 0")


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


SENSORS = {  # a table of each kind of sensor, its last line the input that it comes by
    "imu.imu0": "link = 'autopilot'",
    "gnss.gps0": "link = 'autopilot'",
    "wheel.left": "message = 'm'\nsignal = 's'\nbus = 'chassis'",
    "wheel.right": "index = 2\nlink = 'autopilot'",
    "barometer.b": "link = 'autopilot'",
    "dual_antenna.yaw": "link = 'autopilot'",
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
        ('namespace = "rover"', "namespace"),
        ('map_frame = "/map"', "map_frame"),
        ("domain = 233", "domain"),
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


def test_text_that_is_no_toml() -> None:
    assert complaint("[filter\n").startswith(f"{CAR}: not valid TOML: ")
    assert "line 2" in complaint("[filter]\nhorizon_s = \n")
    assert "line 3" in complaint("[filter]\nhorizon_s = 1\nhorizon_s = 2\n")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for name, content in (("absent.toml", None), ("binary.toml", b"\xff\xfe\x00")):
        file = tmp_path / name
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(ConfigError, match=name):
            config.load(file)


def test_configurations_are_frozen() -> None:
    loaded = config.parse(BASE)
    with pytest.raises(AttributeError):
        loaded.filter.horizon_s = 2.0  # type: ignore[misc]
    assert isinstance(loaded, Config)
