"""The errors of a TOML file: each names the file, the line and the key, and lists what is allowed."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.config.toml import ConfigError
from tests.helpers.complaints import BASE, CAR, GNSS, check, complaint


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
    known = "unknown key (did you mean 'horizon_s'?); allowed: "
    check(BASE + "[filter]\nhorizon = 1", 5, "filter.horizon", known, "gate_probability", "horizon_s")
    check(BASE + "[filtre]\nhorizon_s = 1", 4, "filtre", "unknown key (did you mean 'filter'?); allowed: ", "vehicle")
    check(BASE + "[wheels.left]\nx = 1", 4, "wheels", "unknown key (did you mean 'wheel'?); allowed: ")
    check(BASE + "[filter]\nxyzzy = 1", 5, "filter.xyzzy", "unknown key; allowed: ")
    check(BASE + GNSS + "lever_arm = [0, 0, 0]", 6, "gnss.gps0.lever_arm", "unknown key", "lever_arm_m")
    check("directory = 'x'\n" + BASE, 1, "directory", "unknown key")
    assert "directory" not in complaint(BASE + "[filtre]").split("allowed")[1]


def test_all_errors_are_told_at_once_in_the_order_of_the_file() -> None:
    text = BASE.replace('link = "autopilot"', 'link = 3') + (
        "rotation_deg = [1, 2]\n[filter]\nhorizon_s = -1\nimu_gap = 1\n"
        "[publish]\nencoding = 'jsn'\n[wheel.w]\nunit = 'kmh'\n"
    )
    lines = [line.removeprefix(f"{CAR}:").split(": ")[:2] for line in complaint(text).splitlines()]
    assert lines == [
        ["3", "imu.imu0.link"],
        ["4", "imu.imu0.rotation_deg"],
        ["6", "filter.horizon_s"],
        ["7", "filter.imu_gap"],
        ["9", "publish.encoding"],
        ["11", "wheel.w.unit"],
    ]


def test_contradictions_are_told_at_once() -> None:
    wheels = "".join(f"[wheel.{name}]\nbus = 'c'\nmessage = 'm'\nsignal = '{name}'\nscale = 0\n" for name in "ab")
    lines = complaint(BASE + wheels).splitlines()
    assert [line.split(": ")[1] for line in lines] == ["wheel.a.bus", "wheel.a.scale", "wheel.b.bus", "wheel.b.scale"]


def test_the_errors_of_a_hopeless_file_end() -> None:
    assert len(complaint(BASE + "".join(f"[x{i}]\n" for i in range(1000))).splitlines()) == 20


def test_missing_keys() -> None:
    check(BASE + "[gnss.gps0]\nmessage = 'GPS2_RAW'", 4, "gnss.gps0", "one of 'link' (MAVLink) and 'bus' (CAN) is needed")
    check(BASE + "[dual_antenna.yaw]\nmessage = 'GPS2_RAW'", 4, "dual_antenna.yaw", "the key 'link' is missing")
    check(BASE + "[wheel.w]\nbus = 'b'\nmessage = 'm'", 4, "wheel.w", "the key 'signal' is missing")


def test_the_fault_is_found_in_the_right_table_of_many() -> None:
    text = BASE + GNSS + "[gnss.gps1]\nlink = 'autopilot'\ninterval_s = -1"
    check(text, 8, "gnss.gps1.interval_s", "> 0")


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


@pytest.mark.parametrize(
    ("text", "line", "part"),
    [
        (".".join(["a"] * 50_000) + " = 1", 2, "a line of 100003 characters; at most 2000"),
        ("x = " + "1" * 5000, 2, "a line of 5004 characters; at most 2000"),
        ("[filter]\nhorizon_s = " + "1" * 500, 3, "filter.horizon_s: must fit into 64 bits"),
        ("[filter]\nhorizon_s = 0x" + "F" * 1900, 3, "filter.horizon_s: must fit into 64 bits"),
        ("x = " + "[" * 1900, None, "tables or arrays are nested too deeply"),
        ("x = [\n" + "[\n" * 9000, None, "tables or arrays are nested too deeply"),
        ("x = " + "{a = " * 390, None, "tables or arrays are nested too deeply"),
    ],
)
def test_what_would_take_without_end_is_refused(text: str, line: int | None, part: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.parse("\n" + text, Path("car.toml"))
    assert str(caught.value) == f"car.toml:{line}: {part}" if line else f"car.toml: {part}"


def test_a_file_that_is_too_large_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text("# a line\n" * 40_000)
    with pytest.raises(ConfigError, match="is larger than 256 KiB"):
        config.load(path)
    with pytest.raises(ConfigError, match="is larger than 256 KiB"):
        config.load(Path("/dev/zero"))
