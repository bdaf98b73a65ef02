"""The presets of fusiond/app/presets: each can be used, and reads a frame of its car as the speeds that it holds."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from fusiond import __main__ as command
from fusiond.app.presets import FOLDER
from fusiond.config import load as config
from fusiond.events import Invalid, WheelSpeed
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.logs.merge import open_logs

CARS = FOLDER
WHEELS = ["front_left", "front_right", "rear_left", "rear_right"]

FRAMES = {  # id, data, speeds of the wheels [km/h]; of ford [rad/s]
    "toyota": (0x0AA, "287F288028812882", [36.01, 36.00, 36.03, 36.02]),
    "honda": (0x1D0, "1C2038447090E136", [36.00, 36.01, 36.02, 36.03]),
    "hyundai": (0x386, "8044814482448344", [36.0, 36.03125, 36.0625, 36.09375]),
    "volkswagen": (0x0B2, "C212C312C012C112", [36.0, 36.0075, 36.015, 36.0225]),  # sent rear wheels first
    "tesla": (0x175, "84A370188EC30100", [36.00, 36.04, 36.08, 36.12]),
    "ford": (0x217, "0BB80BBC0BC00BC4", [30.00, 30.04, 30.08, 30.12]),
    "j1939_ebc2": (0x18FEBF0B, "00247D7E7F80FFFF", [36.0, 36.0625, 36.125, 36.1875]),
    "obd": (0x7E8, "03410D2400000000", [36.0]),
    "j1939_hrw": (0x08FE6E0B, "0024102420243024", [36.0, 36.0625, 36.125, 36.1875]),
}


def decoder(car: str) -> CanDecoder:
    return CanDecoder(config.load(CARS / f"{car}.toml"), "can0")


def test_every_preset_has_a_frame_here() -> None:
    assert {path.stem for path in CARS.glob("*.toml")} == set(FRAMES)


@pytest.mark.parametrize("car", FRAMES)
def test_frame_to_speeds(car: str) -> None:
    arbitration_id, data, speeds = FRAMES[car]
    events = decoder(car).decode(arbitration_id, arbitration_id > 0x7FF, bytes.fromhex(data), 0)
    assert [event.source for event in events] == (["speed"] if car == "obd" else WHEELS)
    metres = 0.33 if car == "ford" else 1 / 3.6
    payloads = [event.payload for event in events]
    assert all(isinstance(payload, WheelSpeed) for payload in payloads), payloads
    assert [payload.speed for payload in payloads] == pytest.approx([speed * metres for speed in speeds])  # type: ignore[union-attr]


@pytest.mark.parametrize("car", FRAMES)
def test_check_accepts_it_without_a_warning(car: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["check", "--config", str(CARS / f"{car}.toml")]) == command.SUCCESS
    assert "warning" not in capsys.readouterr().out


@pytest.mark.parametrize("car", FRAMES)
def test_all_bits_set_is_no_speed(car: str) -> None:
    arbitration_id = FRAMES[car][0]
    events = decoder(car).decode(arbitration_id, arbitration_id > 0x7FF, b"\xff" * 8, 0)
    assert len(events) == (0 if car == "obd" else 4) and all(isinstance(event.payload, Invalid) for event in events)


@pytest.mark.parametrize("car", ["honda", "hyundai"])
def test_a_flipped_bit_breaks_the_checksum(car: str) -> None:
    arbitration_id, data, _ = FRAMES[car]
    damaged = bytearray.fromhex(data)
    damaged[2] ^= 0x08
    payloads = [event.payload for event in decoder(car).decode(arbitration_id, False, bytes(damaged), 0)]
    assert payloads == [Invalid("checksum")] * 4


def test_j1939_from_any_sender_at_any_priority() -> None:
    _, data, _ = FRAMES["j1939_hrw"]
    reader = decoder("j1939_hrw")
    assert len(reader.decode(0x0CFE6E31, True, bytes.fromhex(data), 0)) == 4
    assert reader.decode(0x0CFE6F31, True, bytes.fromhex(data), 0) == []
    partly = bytes.fromhex("0024FFFF00FB00FA")  # not available, parameter specific, and the greatest speed there is
    kinds = [type(event.payload) for event in reader.decode(0x08FE6E0B, True, partly, 0)]
    assert kinds == [WheelSpeed, Invalid, Invalid, WheelSpeed]


def test_j1939_out_of_a_log(tmp_path: Path) -> None:
    """Whichever sender and priority; ids next to them, standard ids, lower case, remote frames, and another format."""
    settings = config.load(CARS / "j1939_ebc2.toml")
    data = FRAMES["j1939_ebc2"][1]
    lines = [
        f"18FEBF0B#{data}", f"0CFEBF31#{data}", f"18FEBE0B#{data}", f"19FEBF0B#{data}", f"2BF#{data}", f"18febf0b#{data}",
        "18FEBF0B#R8", f"38FEBF0B#{data}", f"18FEBF0B#{data[:-1]}",
    ]  # fmt: skip
    log = tmp_path / "drive.log"
    log.write_text("".join(f"(1700000000.{k:06d}) can0 {line}\n" for k, line in enumerate(lines)))
    logs = open_logs([log], settings)
    assert [event.t_receive_ns % 10**9 // 1000 for event in logs][::4] == [0, 1, 5]
    counts = logs.counts[str(log)]
    expected = {"frames": 8, "decoded": 3, "other ids": 3, "remote frames": 1, "error frames": 1, "bad lines": 1}
    assert expected.items() <= counts.items()
    with can.ASCWriter(tmp_path / "drive.asc") as writer:
        for number, extended in ((0x18FEBF0B, True), (0x18FEBE0B, True), (0x3F, False), (0x0CFEBF31, True)):
            writer.on_message_received(
                can.Message(1.7e9, number, extended, data=bytes.fromhex(data), channel=0)  # channel 0: the only one
            )
    events = list(open_logs([tmp_path / "drive.asc"], settings))
    assert len(events) == 8 and all(isinstance(event.payload, WheelSpeed) for event in events)
