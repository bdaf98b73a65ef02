"""The car's own sensors out of CAN frames: units, signs, guards, and a wheel's direction out of another frame."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cantools
import pytest

from fusiond.config import load as config
from fusiond.config.toml import ConfigError
from fusiond.events import Invalid, LateralAcceleration, Parked, Received, SteeringAngle, WheelSpeed, YawRate
from fusiond.units import SECOND
from fusiond_adapters.can.decoder import CanDecoder

DBC = """VERSION ""
BU_: ECU
BO_ 36 ESC: 8 ECU
 SG_ YAW_RATE : 0|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ ACCEL_Y : 16|16@1- (0.01,0) [0|0] "m/s^2" Vector__XXX
 SG_ GOOD : 32|1@1+ (1,0) [0|1] "" Vector__XXX
BO_ 37 STEER: 4 ECU
 SG_ ANGLE : 0|16@1- (0.5,0) [0|0] "deg" Vector__XXX
BO_ 956 GEAR_PACKET: 2 ECU
 SG_ GEAR : 0|6@1+ (1,0) [0|63] "" Vector__XXX
BO_ 170 WHEELS: 4 ECU
 SG_ RL : 0|16@1+ (0.01,0) [0|0] "m/s" Vector__XXX
 SG_ BACK : 16|1@1+ (1,0) [0|1] "" Vector__XXX
VAL_ 956 GEAR 0 "D" 16 "R" 32 "P" 8 "N" ;
"""
DATABASE = cantools.database.load_string(DBC, "dbc")
WHEEL = '[wheel.rl]\nbus = "body"\nmessage = "WHEELS"\nsignal = "RL"\nunit = "m/s"\n'
GEAR = WHEEL + 'direction_signal = "GEAR_PACKET.GEAR"\nreverse_value = 16\n'


def decoder(folder: Path, text: str) -> CanDecoder:
    (folder / "car.dbc").write_text(DBC)
    head = '[mavlink.fc]\n[can.body]\ndbc = ["car.dbc"]\n[imu.imu0]\nlink = "fc"\n'
    (folder / "car.toml").write_text(head + text)
    return CanDecoder(config.load(folder / "car.toml"), "body")


def sent(can: CanDecoder, message: str, t_ns: int = 0, **signals: float) -> list[Received]:
    found = DATABASE.get_message_by_name(message)
    assert found is not None
    known: dict[str, Any] = {signal.name: 0 for signal in found.signals} | signals
    return can.decode(found.frame_id, False, found.encode(known), t_ns)


def payloads(events: list[Received]) -> dict[str, object]:
    return {event.source: event.payload for event in events}


def test_a_frame_of_the_stability_control(tmp_path: Path) -> None:
    can = decoder(
        tmp_path,
        '[yaw_rate.esc]\nbus = "body"\nsignal = "ESC.YAW_RATE"\nzero = 0.5\nvalid_signal = "ESC.GOOD"\nvalid_value = 1\n'
        '[lateral_acceleration.across]\nbus = "body"\nsignal = "ESC.ACCEL_Y"\n',
    )
    found = payloads(sent(can, "ESC", YAW_RATE=12.5, ACCEL_Y=2.5, GOOD=1))  # to the left
    assert found["esc"] == YawRate(pytest.approx(-math.radians(12.0)))
    assert found["across"] == LateralAcceleration(pytest.approx(-2.5))
    assert payloads(sent(can, "ESC", YAW_RATE=12.5, GOOD=0))["esc"] == Invalid("valid_signal")
    assert payloads(can.decode(36, False, b"\0", 0)) == {"esc": Invalid("short frame"), "across": Invalid("short frame")}


def test_the_angle_of_the_road_wheels(tmp_path: Path) -> None:
    text = '[steering.wheel]\nbus = "body"\nsignal = "STEER.ANGLE"\nratio = 15.0\nwheelbase_m = 2.7\n'
    (event,) = sent(decoder(tmp_path, text), "STEER", ANGLE=-30.0)  # to the right
    assert event.payload == SteeringAngle(pytest.approx(math.radians(2.0)))
    assert (event.source, event.clock, event.t_sensor_ns) == ("wheel", "", None)


def test_park_is_one_of_the_values_of_the_gear_lever(tmp_path: Path) -> None:
    can = decoder(tmp_path, '[parked.gear]\nbus = "body"\nsignal = "GEAR_PACKET.GEAR"\nvalues = [32]\n')
    assert [sent(can, "GEAR_PACKET", GEAR=gear)[0].payload for gear in (32, 0, 16)] == [
        Parked(True), Parked(False), Parked(False),
    ]  # fmt: skip


def test_the_gear_tells_the_direction_of_a_wheel(tmp_path: Path) -> None:
    can = decoder(tmp_path, GEAR + "forward_values = [0]\n")
    assert sent(can, "WHEELS", RL=5.0)[0].payload == WheelSpeed(5.0)  # not known yet
    for gear, payload in (
        (0, WheelSpeed(5.0, signed=True)),
        (16, WheelSpeed(-5.0, signed=True)),
        (8, WheelSpeed(5.0)),  # neutral: it may roll either way
    ):
        assert sent(can, "GEAR_PACKET", GEAR=gear) == []
        assert sent(can, "WHEELS", RL=5.0)[0].payload == payload


def test_a_direction_grows_old(tmp_path: Path) -> None:
    can = decoder(tmp_path, GEAR)
    sent(can, "GEAR_PACKET", 0, GEAR=16)
    assert sent(can, "WHEELS", 2 * SECOND, RL=5.0)[0].payload == WheelSpeed(-5.0, signed=True)
    assert sent(can, "WHEELS", 2 * SECOND + 1, RL=5.0)[0].payload == WheelSpeed(5.0)


def test_a_direction_in_the_own_frame(tmp_path: Path) -> None:
    can = decoder(tmp_path, WHEEL + 'direction_signal = "BACK"\n')
    assert [sent(can, "WHEELS", RL=5.0, BACK=back)[0].payload for back in (0, 1)] == [WheelSpeed(5.0), WheelSpeed(-5.0)]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (GEAR.replace("GEAR_PACKET.", "GEAR_PACKE."), "no message 'GEAR_PACKE'"),
        (GEAR.replace(".GEAR", ".GEA"), "no signal of GEAR_PACKET 'GEA'"),
        ('[yaw_rate.esc]\nbus = "body"\nsignal = "ESC.YAW"\n', "no signal of ESC 'YAW'"),
    ],
)
def test_what_the_dbc_lacks_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        decoder(tmp_path, text)


@pytest.mark.parametrize(
    "text",
    [
        '[yaw_rate.a]\nbus = "body"\nsignal = "ESC.YAW_RATE"\n[yaw_rate.b]\nbus = "body"\nsignal = "ESC.ACCEL_Y"\n',
        '[yaw_rate.a]\nbus = "body"\nsignal = "YAW_RATE"\n',
        '[parked.gear]\nbus = "body"\nsignal = "GEAR_PACKET.GEAR"\nvalues = []\n',
        '[steering.wheel]\nbus = "body"\nsignal = "STEER.ANGLE"\n',
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError):
        decoder(tmp_path, text)
