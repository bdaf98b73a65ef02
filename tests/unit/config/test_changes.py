"""Which changes of a configuration a running daemon accepts, and which need a restart."""

from __future__ import annotations

import pytest

from fusiond.config.changes import changes
from fusiond.config.load import parse

TEXT = """[mavlink.fc]
[imu.imu0]
link = "fc"
rate_hz = 100.0
[gnss.gps0]
link = "fc"
interval_s = 0.25
[wheel.left]
link = "fc"
index = 0
rate_hz = 10.0
[barometer.baro]
link = "fc"
rate_hz = 10.0
"""


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("rate_hz = 100.0", "rate_hz = 50.0", "imu.imu0.rate_hz"),
        ("interval_s = 0.25", "interval_s = 0.5", "gnss.gps0.interval_s"),
        ("index = 0\nrate_hz = 10.0", "index = 0\nrate_hz = 5.0", "wheel.left.rate_hz"),
        ('baro]\nlink = "fc"\nrate_hz = 10.0', 'baro]\nlink = "fc"\nrate_hz = 5.0', "barometer.baro.rate_hz"),
    ],
)
def test_requested_rates_change_live(old: str, new: str, key: str) -> None:
    assert changes(parse(TEXT), parse(TEXT.replace(old, new))) == ((key,), ())


def test_other_keys_of_a_sensor_need_a_restart() -> None:
    new = TEXT.replace("rate_hz = 100.0", "rate_hz = 50.0\ndelay_ms = 3.0")
    assert changes(parse(TEXT), parse(new)) == ((), ("imu.imu0.delay_ms",))


def test_a_connection_changes_live_and_anything_else_refuses_the_whole_reload() -> None:
    assert changes(parse(TEXT), parse(TEXT)) == ((), ())
    moved = TEXT.replace("[mavlink.fc]\n", '[mavlink.fc]\nconnection = "udpin:127.0.0.1:1"\n')
    assert changes(parse(TEXT), parse(moved)) == (("mavlink.fc.connection",), ())
    assert changes(parse(TEXT), parse(f"{moved}[filter]\nhorizon_s = 2.0\n")) == ((), ("filter.horizon_s",))
    two = f'{TEXT}[wheel.right]\nlink = "fc"\nindex = 1\n'
    assert changes(parse(two), parse(TEXT)) == ((), ("wheel.right",))
