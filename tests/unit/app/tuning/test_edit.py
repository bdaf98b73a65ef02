"""Keys set in a configuration's text."""

from __future__ import annotations

import tomllib

import pytest

from fusiond.app.tuning.edit import with_keys

TEXT = """\
# a car
[imu.imu0]  # on the floor
link = "fcu"
accel_noise = 0.05 # data sheet

[gnss.gps0]
lever_arm_m = [0.0, 1.0, -1.0]  # the roof
[gnss.gps1]
lever_arm_m = [0.0, 0.0, 0.0]
"""


def test_only_the_key_changes() -> None:
    changed = with_keys(TEXT, {("imu.imu0", "accel_noise"): 0.02, ("gnss.gps0", "lever_arm_m"): [0.0, 1.2, -1.0]})
    assert changed == TEXT.replace("0.05 # data", "0.02 # data").replace("1.0, -1.0]  # the", "1.2, -1.0]  # the")


def test_keys_and_tables_that_are_not_there() -> None:
    changed = with_keys(TEXT, {("gnss.gps0", "delay_ms"): 12.0, ("motion", "interval_s"): 0.2})
    table = tomllib.loads(changed)
    assert table["gnss"]["gps0"] == {"lever_arm_m": [0.0, 1.0, -1.0], "delay_ms": 12.0}
    assert table["motion"] == {"interval_s": 0.2} and "delay_ms" not in table["gnss"]["gps1"]
    assert [line for line in TEXT.splitlines() if line not in changed.splitlines()] == []


def test_headers_may_be_written_otherwise() -> None:
    table = tomllib.loads(with_keys('[ gnss . "gps0" ]\nx = 1\n', {("gnss.gps0", "x"): 2.0}))
    assert table == {"gnss": {"gps0": {"x": 2.0}}}


def test_what_cannot_be_changed_line_by_line_is_no_configuration() -> None:
    with pytest.raises(ValueError, match="Cannot"):
        with_keys("gnss = {gps0 = {delay_ms = 1}}\n", {("gnss.gps0", "delay_ms"): 2.0})
