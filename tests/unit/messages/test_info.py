"""What is running, as a message: versions, keys, sources and the configuration in force."""

from __future__ import annotations

from fusiond.estimator.fusion import Fusion
from fusiond.messages.info import config_message, info_message
from tests.helpers.streams import config


def test_information_names_keys_and_kinds_of_sources() -> None:
    settings = config(["left"])
    info = info_message(settings, Fusion(settings))
    name = settings.vehicle.name
    assert info.keys["state"] == f"fusiond/{name}/state"
    assert info.keys["innovations"] == f"fusiond/{name}/innovations/*"
    assert info.sources == {
        "imu0": "imu", "gps0.position": "gnss_position", "gps0.velocity": "gnss_velocity", "left": "wheel_speed"
    }  # fmt: skip


def test_the_configuration_is_plain_values_with_defaults_and_without_its_folder() -> None:
    table = config_message(config(["left"])).config
    assert table["wheel"]["left"]["bus"] == "bus"
    assert table["filter"]["horizon_s"] > 0
    assert "directory" not in table
