"""CAN frames in, wheel speeds out: units, guards, and configurations that do not fit the DBC file."""

from __future__ import annotations

import math
from pathlib import Path

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond import config
from fusiond.measurements import Invalid, Received, WheelSpeed
from fusiond_adapters.can import CanDecoder

CONFIGS = Path(__file__).parents[2] / "configs"

DBC = """VERSION ""
BU_: ECU
BO_ 256 AXLE: 8 ECU
 SG_ LEFT : 0|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
 SG_ RIGHT : 16|16@1- (0.1,0) [0|0] "rpm" Vector__XXX
 SG_ REVERSE : 32|2@1+ (1,0) [0|0] "" Vector__XXX
 SG_ QUALITY : 34|2@1+ (1,0) [0|0] "" Vector__XXX
 SG_ COUNTER : 36|4@1+ (1,0) [0|0] "" Vector__XXX
BO_ 2566832126 EXACT: 8 ECU
 SG_ SPEED : 0|32@1- (1,0) [0|0] "m/s" Vector__XXX
BO_ 257 SHARED: 8 ECU
 SG_ PAGE M : 0|8@1+ (1,0) [0|0] "" Vector__XXX
 SG_ REAR m1 : 8|16@1+ (0.01,0) [0|0] "m/s" Vector__XXX
 SG_ OTHER m2 : 8|16@1+ (1,0) [0|0] "" Vector__XXX
VAL_ 256 REVERSE 0 "FORWARD" 1 "BACKWARD" ;
VAL_ 256 QUALITY 0 "GOOD" 3 "FAULT" ;
SIG_VALTYPE_ 2566832126 SPEED : 1;
"""
BASE = '[can.body]\ndbc = ["body.dbc"]\n[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n'


def wheel(name: str = "left", message: str = "AXLE", signal: str = "LEFT", more: str = "") -> str:
    return f'[wheel.{name}]\nbus = "body"\nmessage = "{message}"\nsignal = "{signal}"\n{more}\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "body.dbc").write_text(DBC)
    return tmp_path


def decoder(folder: Path, *wheels: str) -> CanDecoder:
    return CanDecoder(config.parse(BASE + "".join(wheels), folder / "c.toml"), "body")


def axle(**values: float) -> bytes:
    zeros = {"LEFT": 0, "RIGHT": 0, "REVERSE": 0, "QUALITY": 0, "COUNTER": 0}
    message = cantools.database.load_string(DBC, "dbc").get_message_by_name("AXLE")
    return bytes(message.encode(zeros | values))


def payloads(events: list[Received]) -> list[object]:
    return [event.payload for event in events]


def test_four_wheels_in_one_frame() -> None:
    text = "".join(
        f'[wheel.{name}]\nbus = "body"\nmessage = "WHEEL_SPEEDS"\nsignal = "WHEEL_SPEED_{signal}"\n'
        for name, signal in (("front_right", "FR"), ("front_left", "FL"), ("rear_right", "RR"), ("rear_left", "RL"))
    )
    settings_ = config.parse(BASE.replace("body.dbc", "rav4.dbc") + text, CONFIGS / "c.toml")
    raw = [6767 + step for step in (3600, 3601, 3602, 3603)]
    data = b"".join((value | 0x8000).to_bytes(2, "big") for value in raw)  # the top bit is not part of the speed
    events = CanDecoder(settings_, "body").decode(0x0AA, False, data, 5)
    assert [event.source for event in events] == ["front_right", "front_left", "rear_right", "rear_left"]
    speeds = [event.payload.speed for event in events if isinstance(event.payload, WheelSpeed)]
    assert speeds == pytest.approx([10.0, 36.01 / 3.6, 36.02 / 3.6, 36.03 / 3.6])
    stamps = {(event.sequence, event.clock, event.t_sensor_ns, event.t_receive_ns) for event in events}
    assert stamps == {(0, "", None, 5)}


@pytest.mark.parametrize(
    ("more", "speed"),
    [
        ("", 36.0 / 3.6),
        ('unit = "m/s"', 36.0),
        ('unit = "mph"', 36.0 * 0.44704),
        ('unit = "rad/s"\nradius_m = 0.5', 18.0),
        ('unit = "rpm"\nradius_m = 0.5', 36.0 * math.pi / 60),
        ("scale = -1.01", -10.1),
    ],
)
def test_units_and_scale(folder: Path, more: str, speed: float) -> None:
    (event,) = decoder(folder, wheel(more=more)).decode(256, False, axle(LEFT=36.0), 0)
    assert isinstance(event.payload, WheelSpeed)
    assert event.payload.speed == pytest.approx(speed)


def test_direction_signal_turns_the_sign(folder: Path) -> None:
    reader = decoder(folder, wheel(more='direction_signal = "REVERSE"\nreverse_value = 1'))
    assert payloads(reader.decode(256, False, axle(LEFT=36.0, REVERSE=0), 0)) == [WheelSpeed(10.0)]
    assert payloads(reader.decode(256, False, axle(LEFT=36.0, REVERSE=1), 0)) == [WheelSpeed(-10.0)]


def test_valid_signal_with_named_values(folder: Path) -> None:
    reader = decoder(folder, wheel(more='valid_signal = "QUALITY"\nvalid_value = 0'))
    assert payloads(reader.decode(256, False, axle(LEFT=36.0, QUALITY=0), 0)) == [WheelSpeed(10.0)]
    assert payloads(reader.decode(256, False, axle(LEFT=36.0, QUALITY=3), 0)) == [Invalid("valid_signal")]


def test_a_repeated_counter_marks_a_stale_frame(folder: Path) -> None:
    guarded = wheel(more='counter_signal = "COUNTER"')
    reader = decoder(folder, guarded, wheel("right", signal="RIGHT", more='unit = "m/s"'))
    stale = [reader.decode(256, False, axle(LEFT=36.0, COUNTER=count), 0)[0].payload for count in (15, 0, 0, 1)]
    assert stale == [WheelSpeed(10.0), WheelSpeed(10.0), Invalid("stale counter"), WheelSpeed(10.0)]


def test_a_short_frame_loses_only_what_it_lacks(folder: Path) -> None:
    reader = decoder(folder, wheel(), wheel("right", signal="RIGHT", more='unit = "m/s"'))
    assert payloads(reader.decode(256, False, axle(LEFT=36.0, RIGHT=5.0)[:3], 0)) == [
        WheelSpeed(10.0), Invalid("short frame"),
    ]  # fmt: skip
    assert payloads(reader.decode(256, False, b"", 0)) == [Invalid("short frame")] * 2
    assert payloads(reader.decode(256, False, axle(LEFT=36.0) + bytes(8), 0))[0] == WheelSpeed(10.0)


def test_ids_of_both_lengths_are_told_apart(folder: Path) -> None:
    reader = decoder(folder, wheel(), wheel("exact", "EXACT", "SPEED", 'unit = "m/s"'))
    assert reader.decode(256, True, axle(LEFT=36.0), 0) == []
    assert reader.decode(0x18FEBFFE, False, bytes(8), 0) == []
    assert reader.counts["other ids"] == 2
    assert payloads(reader.decode(0x18FEBFFE, True, b"\x00\x00\x20\x41" + bytes(4), 0)) == [WheelSpeed(10.0)]
    assert payloads(reader.decode(0x18FEBFFE, True, b"\x00\x00\xc0\x7f" + bytes(4), 0)) == [Invalid("not finite")]


def test_multiplexed_signal(folder: Path) -> None:
    reader = decoder(folder, wheel("rear", "SHARED", "REAR", 'unit = "m/s"'))
    assert payloads(reader.decode(257, False, b"\x01\xe8\x03" + bytes(5), 0)) == [WheelSpeed(10.0)]
    assert reader.decode(257, False, b"\x02\xe8\x03" + bytes(5), 0) == []
    assert payloads(reader.decode(257, False, b"\x07\xe8\x03" + bytes(5), 0)) == [Invalid("undecodable")]


def test_a_bus_without_wheels_needs_no_dbc(tmp_path: Path) -> None:
    settings_ = config.parse('[can.body]\n[mavlink.fc]\n[imu.imu0]\nlink = "fc"', tmp_path / "c.toml")
    assert CanDecoder(settings_, "body").decode(256, False, bytes(8), 0) == []


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (wheel(message="AXEL"), r"wheel\.left\.message: there is no message 'AXEL' in the DBC; there is: AXLE, EXACT"),
        (wheel(signal="LEFTT"), r"wheel\.left\.signal: there is no signal of AXLE 'LEFTT' in the DBC; there is: LEFT"),
        (wheel(more='valid_signal = "QUALTY"'), r"wheel\.left\.valid_signal: .*there is: QUALITY"),
        (wheel(more='direction_signal = "X"'), r"wheel\.left\.direction_signal: .*'X'"),
        (wheel(more='counter_signal = "COUNT"'), r"wheel\.left\.counter_signal: .*there is: COUNTER"),
    ],
)
def test_what_the_dbc_lacks_is_named(folder: Path, text: str, complaint: str) -> None:
    with pytest.raises(config.ConfigError, match=complaint):
        decoder(folder, text)


@pytest.mark.parametrize("content", [b"", b"no DBC at all", b"\xff\x00\xfe", DBC[:300].encode()])
def test_a_broken_dbc_is_named(folder: Path, content: bytes) -> None:
    (folder / "body.dbc").write_bytes(content)
    with pytest.raises(config.ConfigError, match=r"can\.body\.dbc: .*body\.dbc: not a valid DBC file"):
        decoder(folder, wheel())


def test_several_dbc_files(folder: Path) -> None:
    (folder / "other.dbc").write_text('VERSION ""\nBU_: E\nBO_ 300 OTHER: 8 E\n SG_ V : 0|8@1+ (1,0) [0|0] "" E\n')
    text = BASE.replace('"body.dbc"', '"body.dbc", "other.dbc"') + wheel() + wheel("w", "OTHER", "V", 'unit = "m/s"')
    reader = CanDecoder(config.parse(text, folder / "c.toml"), "body")
    assert payloads(reader.decode(300, False, b"\x07" + bytes(7), 0)) == [WheelSpeed(7.0)]
    assert payloads(reader.decode(256, False, axle(LEFT=36.0), 0)) == [WheelSpeed(10.0)]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> CanDecoder:
    folder = tmp_path_factory.mktemp("dbc")
    (folder / "body.dbc").write_text(DBC)
    all_guards = 'direction_signal = "REVERSE"\nvalid_signal = "QUALITY"\ncounter_signal = "COUNTER"'
    rear = wheel("rear", "SHARED", "REAR", 'unit = "m/s"')
    return decoder(folder, wheel(more=all_guards), wheel("exact", "EXACT", "SPEED"), rear)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([(256, False), (257, False), (0x18FEBFFE, True)]), st.binary(max_size=64))
def test_no_content_raises(shared: CanDecoder, frame: tuple[int, bool], data: bytes) -> None:
    for event in shared.decode(*frame, data, 0):
        assert isinstance(event.payload, Invalid) or math.isfinite(event.payload.speed)  # type: ignore[union-attr]
