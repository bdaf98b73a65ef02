"""CAN frames in, wheel speeds out: units, guards, and configurations that do not fit the DBC file."""

from __future__ import annotations

import math
from pathlib import Path

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.config import load as config
from fusiond.config.schema import Wheel, sensor_tables
from fusiond.config.toml import ConfigError
from fusiond.events import Invalid, Received, WheelSpeed
from fusiond_adapters.can.checksums import is_right
from fusiond_adapters.can.decoder import CanDecoder, parameter_group
from fusiond_adapters.can.sensors import SENSORS
from tests.helpers.paths import ROOT

CONFIGS = ROOT / "configs"

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


def test_ids_of_both_lengths_are_distinguished(folder: Path) -> None:
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
    assert reader.decode(257, False, b"\x07\xe8\x03" + bytes(5), 0) == []  # a page that the DBC does not have
    assert reader.counts["undecodable"] == 0


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
    with pytest.raises(ConfigError, match=complaint):
        decoder(folder, text)


@pytest.mark.parametrize("content", [b"", b"no DBC at all", b"\xff\x00\xfe", DBC[:300].encode()])
def test_a_broken_dbc_is_named(folder: Path, content: bytes) -> None:
    (folder / "body.dbc").write_bytes(content)
    with pytest.raises(ConfigError, match=r"can\.body\.dbc: .*body\.dbc: not a valid DBC file"):
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


# --- Values, checksums and ids of particular makers


def test_values_that_mean_not_available(folder: Path) -> None:
    reader = decoder(folder, wheel(more="not_available_from = 65534"))
    assert payloads(reader.decode(256, False, axle(LEFT=655.33), 0)) == [WheelSpeed(pytest.approx(655.33 / 3.6))]
    assert payloads(reader.decode(256, False, axle(LEFT=655.34), 0)) == [Invalid("not available")]
    assert payloads(reader.decode(256, False, axle(LEFT=655.35), 0)) == [Invalid("not available")]


def test_a_base_signal_is_added(folder: Path) -> None:
    more = 'base_signal = "RIGHT"\nunit = "m/s"'
    assert payloads(decoder(folder, wheel(more=more)).decode(256, False, axle(LEFT=36.0, RIGHT=-1.5), 0)) == [
        WheelSpeed(34.5)
    ]


@pytest.mark.parametrize(
    ("kind", "arbitration_id", "data"),
    [
        ("toyota", 0x2E4, "00000000C8B4"),  # 6 + 02 + E4 + C8 = 1B4
        ("honda", 0x1D0, "1C2038447090E136"),  # the digits of id and data are 82: 8 - 82 = 6 of 16
        ("honda", 0x18DAB0F1, "010000000000000F"),  # with those of the id they are 60: 8 + 3 - 60 = F of 16
        ("hyundai", 0x386, "8044814482448344"),  # 12 bits set, 12 ^ 9 = 5: 1 in byte 5, 1 in byte 7
        ("tesla", 0x175, "01020304050607" "92"),  # 01 + 75 + 1C = 92
    ],
)
def test_checksums(kind: str, arbitration_id: int, data: str) -> None:
    content = bytes.fromhex(data)
    assert is_right(kind, arbitration_id, content)
    for place in range(8 * len(content)):
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << place % 8
        if kind == "hyundai" and place in (14, 15, 30, 31):
            continue  # its counter is not covered
        assert not is_right(kind, arbitration_id, bytes(damaged)), place
    assert not is_right(kind, arbitration_id, b"")


def test_a_wrong_checksum_is_counted_against_the_wheels_that_ask_for_it(folder: Path) -> None:
    unasked = wheel("right", signal="RIGHT", more='unit = "m/s"')
    reader = decoder(folder, wheel(more='checksum = "honda"'), unasked)
    assert payloads(reader.decode(256, False, axle(LEFT=36.0, RIGHT=5.0), 0)) == [Invalid("checksum"), WheelSpeed(5.0)]


def test_j1939_by_the_key_or_by_the_dbc(folder: Path) -> None:
    exact = wheel("exact", "EXACT", "SPEED", 'unit = "m/s"')
    ten = b"\x00\x00\x20\x41" + bytes(4)
    by_id = decoder(folder, exact)
    assert (by_id.keys, by_id.groups) == ({0x98FEBFFE}, frozenset())
    text = BASE.replace("[mavlink", "j1939 = true\n[mavlink") + exact
    by_group = CanDecoder(config.parse(text, folder / "c.toml"), "body")
    assert (by_group.keys, by_group.groups) == (frozenset(), {65215})
    for arbitration_id, found in ((0x18FEBFFE, True), (0x0CFEBF0B, True), (0x18FEC0FE, False), (0x19FEBFFE, False)):
        assert bool(by_group.decode(arbitration_id, True, ten, 0)) == found, hex(arbitration_id)
    assert by_group.decode(0x7FF, False, ten, 0) == []
    assert parameter_group(0x18EF1234) == 0xEF00  # with a destination, which is no part of it


def test_a_unit_that_contradicts_the_dbc_is_reported(folder: Path) -> None:
    assert decoder(folder, wheel()).warnings == []
    (warning,) = decoder(folder, wheel(more='unit = "mph"')).warnings
    assert warning == "wheel.left.unit: is mph, but the DBC says that LEFT is in km/h"


# --- Signals are cut out of the data by shifts: the same numbers as cantools gives


@st.composite
def layouts(draw: st.DrawFn) -> tuple[str, int]:
    """The DBC text of a message of one signal, and the message's size."""
    size = draw(st.integers(1, 8))
    length = draw(st.integers(1, 8 * size))
    begin = draw(st.integers(0, 8 * size - length))
    big, signed = draw(st.booleans()), draw(st.booleans())
    start = begin // 8 * 8 + 7 - begin % 8 if big else begin
    scale, offset = draw(st.sampled_from([1, 3, -2, 0.01, 0.1, -0.5])), draw(st.sampled_from([0, -40, 0.5, -67.67]))
    signal = f'{start}|{length}@{int(not big)}{"-" if signed else "+"} ({scale},{offset}) [0|0] "m/s" E'
    return f'VERSION ""\nBU_: E\nBO_ 1 M: {size} E\n SG_ S : {signal}\n', size


@settings(max_examples=100, deadline=None)
@given(layouts(), st.binary(max_size=10))
def test_a_signal_is_what_cantools_decodes(
    tmp_path_factory: pytest.TempPathFactory, layout: tuple[str, int], data: bytes
) -> None:
    text, size = layout
    folder = tmp_path_factory.mktemp("layout")
    (folder / "body.dbc").write_text(text)
    (event,) = decoder(folder, wheel(message="M", signal="S", more='unit = "m/s"')).decode(1, False, data, 0)
    message = cantools.database.load_string(text, "dbc").messages[0]
    expected = message.decode_simple(data, decode_choices=False, allow_truncated=True)
    assert event.payload == (WheelSpeed(float(expected["S"])) if "S" in expected else Invalid("short frame"))
    assert "S" in expected or len(data) < size


def test_signals_that_share_bits_are_decoded_all_the_same(folder: Path) -> None:
    (folder / "body.dbc").write_text(DBC.replace(" SG_ COUNTER", ' SG_ BOTH : 0|32@1+ (1,0) [0|0] "" E\n SG_ COUNTER'))
    (event,) = decoder(folder, wheel()).decode(256, False, bytes([100, 0, 0, 0, 0, 0, 0, 0]), 0)
    assert event.payload == WheelSpeed(100 * 0.01 * (1 / 3.6))


def test_every_kind_of_sensor_that_can_come_by_a_bus_has_a_reader() -> None:
    assert {Wheel, *SENSORS} == {kind for kind in sensor_tables().values() if "bus" in kind.__struct_fields__}
