"""Which bus a channel of a CAN log is, and stamps that jump."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from fusiond.config.schema import Config
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.logs import WHEELS, candump, configured, events, stamps, written


def test_a_can_stamp_gone_astray_costs_one_frame(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.log")
    lines = path.read_text().splitlines()
    wheel = [place for place, line in enumerate(lines) if " 0AA#" in line and "#R" not in line][7]
    lines[wheel] = lines[wheel].replace("(1", "(2", 1)  # decades ahead
    path.write_text("\n".join(lines) + "\n")
    found, counts = events(path)
    assert (len(found), counts["bad stamps"]) == (4 * 39, 1)
    assert stamps(found) == sorted(stamps(found))


def test_channels_are_matched_by_name_or_log_channel(tmp_path: Path) -> None:
    log = candump(tmp_path / "drive.log", "can0", "can1")
    assert events(log, configured("can1"))[1] == {"frames": 20, "other channels": 10, "decoded": 10}
    assert events(log, configured("body", "can1"))[1] == {"frames": 20, "other channels": 10, "decoded": 10}


def test_two_buses_in_one_log(tmp_path: Path) -> None:
    rear = '[can.rear]\ndbc = ["rav4.dbc"]\nlog_channel = "can7"\n[wheel.w]\nbus = "rear"\nmessage = "WHEEL_SPEEDS"\n'
    settings = configured(more=rear + 'signal = "WHEEL_SPEED_FL"\n')
    found, _ = events(candump(tmp_path / "drive.log", "can0", "can7", "can8"), settings)
    assert Counter(event.source for event in found) == dict.fromkeys([*WHEELS, "w"], 10)


def test_the_only_channel_is_used_as_the_only_bus(tmp_path: Path) -> None:
    log = candump(tmp_path / "drive.log", "vcan3")
    logs = open_logs([log], configured("body"))
    assert len(list(logs)) == 40
    assert logs.warnings == [f"{log}: channel vcan3 is used as the bus body"]
    assert len(list(open_logs([f"body={log}"], configured("body", "can9")))) == 40


@pytest.mark.parametrize(
    ("settings", "channels", "complaint"),
    [
        (configured("body"), ("can0", "can1"), "wheel frames are on can0, can1, wanted on body: set log_channel"),
        (configured("body", "can9"), ("can0",), "wheel frames are on can0, wanted on can9"),
    ],
)
def test_channels_of_no_bus_are_named(
    tmp_path: Path, settings: Config, channels: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(LogError, match=complaint):
        events(candump(tmp_path / "drive.log", *channels), settings)


def test_a_format_without_channels_needs_the_bus_where_there_are_two(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.csv")
    rear = '[can.rear]\ndbc = ["rav4.dbc"]\n[wheel.w]\nbus = "rear"\nmessage = "WHEEL_SPEEDS"\n'
    settings = configured(more=rear + 'signal = "WHEEL_SPEED_FL"\n')
    with pytest.raises(LogError, match="no channels; name the bus: BUS="):
        events(path, settings)
    assert Counter(event.source for event in open_logs([f"rear={path}"], settings)) == {"w": 40}
