"""Small logs of both kinds, and the events that are read from them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import can
import pymavlink.dialects.v20.ardupilotmega as dialect

from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.events import Received
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.paths import ROOT

START_US = 1_700_000_000_000_000
WHEELS = {"front_right": "FR", "front_left": "FL", "rear_right": "RR", "rear_left": "RL"}
WHEEL_ID = 0x0AA


def configured(bus: str = "can0", channel: str = "", more: str = "", imu: str = "HIGHRES_IMU") -> Config:
    wheels = "".join(
        f'[wheel.{name}]\nbus = "{bus}"\nmessage = "WHEEL_SPEEDS"\nsignal = "WHEEL_SPEED_{signal}"\n'
        for name, signal in WHEELS.items()
    )
    log_channel = f'log_channel = "{channel}"\n' if channel else ""
    link = '[mavlink.fc]\ndialect = "ardupilotmega"\n[gnss.gps0]\nlink = "fc"\n[imu.imu0]\nlink = "fc"\n'
    buses = f'[can.{bus}]\ndbc = ["rav4.dbc"]\n{log_channel}{wheels}{more}'
    return config.parse(f'{link}message = "{imu}"\n{buses}', ROOT / "configs" / "test.toml")


def records(count: int = 20, first_us: int = START_US, step_us: int = 10_000) -> list[bytes]:
    """Records of a .tlog: IMU samples, a message nobody wants after every fourth."""
    mav = dialect.MAVLink(None, 1, 1)
    made = []
    for number in range(count):
        if number % 5 == 4:
            message = dialect.MAVLink_attitude_message(number, 0, 0, 0, 0, 0, 0)
        else:
            fields = dict.fromkeys(dialect.MAVLink_highres_imu_message.fieldnames, 0)
            fields |= {"time_usec": 1000 + number, "zacc": -9.75, "fields_updated": 63}
            message = dialect.MAVLink_highres_imu_message(**fields)
        made.append(struct.pack(">Q", first_us + number * step_us) + message.pack(mav))
        mav.seq = (mav.seq + 1) % 256
    return made


def events(path: Path, settings: Config | None = None) -> tuple[list[Received], dict[str, int]]:
    logs = open_logs([path], settings or configured())
    found = list(logs)
    return found, logs.counts[str(path)]


def stamps(found: list[Received]) -> list[int]:
    return [event.t_receive_ns for event in found]


CANDUMP = "".join(f"({START_US / 1e6 + n / 100:.6f}) can0 0AA#1A6F1A6F1A6F{0x1A6F + n:04X}\n" for n in range(10))


def messages() -> Iterator[can.Message]:
    """Wheel frames on channel 0 with everything between them that may be in a log."""
    for number in range(40):
        t = START_US / 1e6 + number / 80
        words = b"".join((6767 + 3600 + 10 * number + wheel).to_bytes(2, "big") for wheel in range(4))
        yield can.Message(t, WHEEL_ID, is_extended_id=False, data=words, channel=0)
        yield can.Message(t + 0.001, 0x123, is_extended_id=False, data=b"\1\2\3", channel=0)
        yield can.Message(t + 0.002, WHEEL_ID, is_extended_id=True, data=words, channel=0)
        if number == 20:
            yield can.Message(t + 0.003, is_error_frame=True, channel=0)
            yield can.Message(t + 0.004, WHEEL_ID, is_extended_id=False, is_remote_frame=True, dlc=8, channel=0)
            yield can.Message(t + 0.005, 0x124, is_extended_id=False, is_fd=True, data=bytes(24), channel=0)


def written(path: Path) -> Path:
    with can.Logger(str(path)) as writer:
        for message in messages():
            writer(message)
    return path


def candump(path: Path, *channels: str) -> Path:
    lines = [line.replace("can0", channel) for line in CANDUMP.splitlines() for channel in channels]
    path.write_text("\n".join(lines))
    return path
