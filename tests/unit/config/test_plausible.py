"""Values that are probably mistakes are told, and those that are usual are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.app.presets import FOLDER
from fusiond.config import load as config
from fusiond.config.plausible import RANGES, implausible
from fusiond.config.schema import Filter, sensor_tables
from tests.helpers.paths import ROOT

TEXT = """
[motion]
point_m = [-1.5, 0.0, 0.5]
[mavlink.fc]
[can.body]
dbc = ["configs/rav4.dbc"]
[imu.imu0]
link = "fc"
rotation_deg = [0.0, 0.0, 0.0]
gyro_noise = 2e-3
[gnss.gps0]
link = "fc"
lever_arm_m = [0.5, 0.0, -1.25]
position_sigma_m = 1.5
[wheel.left]
bus = "body"
message = "WHEELS"
signal = "L"
unit = "rpm"
radius_m = 0.32
position_m = [-1.5, -0.75, 0.5]
"""


def found(text: str) -> dict[str, str]:
    return dict(implausible(config.parse(text, ROOT / "car.toml")))


def test_usual_values() -> None:
    assert found(TEXT) == {}


@pytest.mark.parametrize(
    "path", [*sorted((ROOT / "configs").glob("*r*.toml")), *sorted(FOLDER.glob("*.toml"))]
)
def test_the_configurations_that_are_given_are_plausible(path: Path) -> None:
    assert list(implausible(config.load(path))) == []


@pytest.mark.parametrize(
    ("old", "new", "key", "part"),
    [
        ("gyro_noise = 2e-3", "gyro_noise = 2.0", "imu.imu0.gyro_noise", "2 is not between 1e-07 and 0.2"),
        ("radius_m = 0.32", "radius_m = 320", "wheel.left.radius_m", "is it in metres?"),
        ("position_sigma_m = 1.5", "position_sigma_m = 1e-9", "gnss.gps0.position_sigma_m", "believes what it is told"),
        ("-1.25]", "1.25]", "gnss.gps0.lever_arm_m", "1.25 m below the IMU"),
        ("-0.75, 0.5]", "-0.75, -0.5]", "wheel.left.position_m", "0.5 m above the IMU"),
        ("[0.0, 0.0, 0.0]", "[3.1416, 0.0, -1.571]", "imu.imu0.rotation_deg", "looks like radians"),
        ("point_m = [-1.5", "point_m = [1.5", "motion.point_m", "is its sign right?"),
    ],
)
def test_probable_mistakes(old: str, new: str, key: str, part: str) -> None:
    assert old in TEXT
    ((where, why),) = found(TEXT.replace(old, new, 1)).items()
    assert where == key and part in why


@pytest.mark.parametrize("angles", ["[180.0, 0.0, 90.0]", "[1.0, -2.0, 0.5]", "[0.0, 0.0, 3.0]"])
def test_small_angles_in_degrees_are_not_taken_for_radians(angles: str) -> None:
    assert found(TEXT.replace("[0.0, 0.0, 0.0]", angles)) == {}


def test_every_range_is_of_a_key_that_there_is_and_holds_its_default() -> None:
    kinds = {"filter": Filter, **sensor_tables()}
    for name, (least, most, _) in RANGES.items():
        table, _, key = name.partition(".")
        kind = kinds[table]
        defaults = dict(zip(kind.__struct_fields__[-len(kind.__struct_defaults__) :], kind.__struct_defaults__, strict=True))
        default = defaults[key]
        assert default is None or least <= default <= most, name
