"""The sections of the sensors: found by type, with their streams, delays and inputs; groups of wheels; learnt delays."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.config.load import parse
from fusiond.config.schema import Barometer, Config, Gnss, Imu, Wheel, calibrated, sensor_tables, wheel_groups
from fusiond.config.sensor import INERTIAL
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Pressure, WheelSpeed

TEXT = """
[mavlink.fc]
[mavlink.second]
[can.body]
dbc = ["car.dbc"]
delay_ms = 1.5
[imu.imu0]
link = "fc"
delay_ms = 4.0
[gnss.gps0]
link = "second"
delay_ms = 100.0
velocity_delay_ms = 50.0
position_correlation_s = 2.0
velocity_correlation_s = 3.0
position_sigma_m = 1.25
group = "roof"
shared_sigma_m = 0.5
use_velocity = false
noise_most = 4.0
[wheel.left]
bus = "body"
message = "WHEELS"
signal = "L"
delay_ms = 0.25
[wheel.encoder]
link = "fc"
index = 1
delay_ms = 7.0
[barometer.baro]
link = "fc"
correlation_s = 6.0
"""


@pytest.fixture
def config(tmp_path: Path) -> Config:
    (tmp_path / "car.dbc").touch()
    return parse(TEXT, tmp_path / "car.toml")


def test_the_tables_of_sensors_are_found_by_type() -> None:
    known = {"imu": Imu, "gnss": Gnss, "wheel": Wheel, "barometer": Barometer}
    assert known.items() <= sensor_tables().items()
    assert not {"mavlink", "can", "motion"} & sensor_tables().keys()


def test_sensors_come_by_kind_and_then_as_in_the_file(config: Config) -> None:
    named = [(table, name) for table, name, _ in config.sensors()]
    assert named == [("imu", "imu0"), ("gnss", "gps0"), ("wheel", "left"), ("wheel", "encoder"), ("barometer", "baro")]
    assert all(getattr(config, table)[name] is section for table, name, section in config.sensors())


def test_the_sensors_of_one_input(config: Config) -> None:
    assert [sensor.name for sensor in config.sensors(link="fc")] == ["imu0", "encoder", "baro"]
    assert [sensor.name for sensor in config.sensors(link="second")] == ["gps0"]
    assert [sensor.name for sensor in config.sensors(bus="body")] == ["left"]
    assert list(config.sensors(bus="fc")) == []


def test_streams_have_model_payload_and_table(config: Config) -> None:
    found = {
        name: (source.table, source.name, source.stream.model, source.stream.payload)
        for name, source in config.streams().items()
    }
    assert found == {
        "imu0": ("imu", "imu0", INERTIAL, ImuSample),
        "gps0.position": ("gnss", "gps0", "gnss_position", GnssPosition),
        "gps0.velocity": ("gnss", "gps0", "gnss_velocity", GnssVelocity),
        "left": ("wheel", "left", "wheel_speed", WheelSpeed),
        "encoder": ("wheel", "encoder", "wheel_speed", WheelSpeed),
        "baro": ("barometer", "baro", "barometric_height", Pressure),
    }
    assert config.sources() == tuple(sorted(found))
    assert config.streams()["left"].section is config.wheel["left"]


def test_delays_are_in_nanoseconds_and_include_the_delay_of_the_bus(config: Config) -> None:
    assert {name: source.delay_ns for name, source in config.streams().items()} == {
        "imu0": 4_000_000,
        "gps0.position": 100_000_000,
        "gps0.velocity": 150_000_000,
        "left": 1_750_000,
        "encoder": 7_000_000,
        "baro": 0,
    }


def test_the_errors_of_streams(config: Config) -> None:
    streams = {name: source.stream for name, source in config.streams().items()}
    position, velocity = streams["gps0.position"], streams["gps0.velocity"]
    assert (position.correlation_s, position.sigma, position.group, position.shared_sigma) == (0.0, 1.25, "roof", 0.5)
    assert (velocity.correlation_s, velocity.sigma, velocity.group, velocity.shared_sigma) == (3.0, 0.2, None, 0.0)
    assert (position.enabled, velocity.enabled) == (True, False)
    assert (position.companion, velocity.companion) == (".velocity", None)
    assert (position.noise_min, position.noise_max, streams["left"].noise_max) == (1.0, 4.0, 3.0)
    assert streams["baro"].correlation_s == 6.0


@pytest.mark.parametrize(("outliers", "share"), [("gate", 0.0), ("mixture", 0.125)])
def test_outliers_are_weighted_only_as_a_mixture(outliers: str, share: float) -> None:
    text = '[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[gnss.gps0]\nlink = "fc"\noutlier_share = 0.125\n'
    streams = parse(f'{text}outliers = "{outliers}"\n').streams()
    assert {name: source.stream.outlier_share for name, source in streams.items()} == {
        "imu0": 0.0,
        "gps0.position": share,
        "gps0.velocity": share,
    }


def test_configurations_are_frozen(config: Config) -> None:
    with pytest.raises(AttributeError):
        config.filter.horizon_s = 2.0  # type: ignore[misc]


def test_file_names_are_relative_to_the_configuration(config: Config, tmp_path: Path) -> None:
    assert config.path("car.dbc") == tmp_path / "car.dbc"
    assert config.path("/etc/car.dbc") == Path("/etc/car.dbc")


@pytest.mark.parametrize(
    ("by", "groups"),
    [
        ("vehicle", {"front_left": 0, "front_right": 0, "rear_left": 0, "rear_right": 0}),
        ("axle", {"front_left": 1, "front_right": 1, "rear_left": 0, "rear_right": 0}),
        ("wheel", {"front_left": 0, "front_right": 1, "rear_left": 2, "rear_right": 3}),
    ],
)
def test_wheels_share_a_scale_by_vehicle_axle_or_wheel(by: str, groups: dict[str, int]) -> None:
    tables = "".join(
        f'[wheel.{name}]\nlink = "fc"\nindex = {index}\nposition_m = [{forward}, 0.0, 0.0]\n'
        for index, (name, forward) in enumerate(
            [("rear_right", -1.5), ("front_right", 1.25), ("rear_left", -1.5), ("front_left", 1.25)]
        )
    )
    text = f'[filter]\nwheel_scale_by = "{by}"\n[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n{tables}'
    assert wheel_groups(parse(text)) == groups


@pytest.mark.parametrize("key", ["lever_arm_sigma_m", "delay_sigma_ms", "velocity_delay_sigma_ms"])
def test_a_receiver_is_calibrated_if_anything_of_it_is_estimated(key: str) -> None:
    text = '[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[gnss.gps0]\nlink = "fc"\n'
    assert not calibrated(parse(text).gnss["gps0"])
    assert calibrated(parse(f"{text}{key} = 0.1\n").gnss["gps0"])
