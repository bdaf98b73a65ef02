"""Several logs as one stream: order, warnings, and which log is whose."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import LogSet, open_logs
from tests.helpers.logs import START_US, WHEELS, candump, configured, records, stamps


def test_arguments_that_name_links_and_buses(tmp_path: Path, tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(20)))
    assert len(list(open_logs([f"fc={tlog}"], configured()))) == 16
    with pytest.raises(LogError, match=r"configured links: fc"):
        open_logs([f"can0={tlog}"], configured())
    with pytest.raises(LogError, match=r"configured buses: can0"):
        open_logs([f"fc={candump(tmp_path / 'drive.log', 'can0')}"], configured())
    with pytest.raises(LogError, match=r"no link or bus 'martian'; configured: fc, can0"):
        open_logs([f"martian={tlog}"], configured())


def both(tmp_path: Path, first_us: int = START_US) -> LogSet:
    (tmp_path / "drive.tlog").write_bytes(b"".join(records(20, first_us)))
    return open_logs([tmp_path / "drive.tlog", candump(tmp_path / "drive.log", "can0")], configured())


def test_merge_by_receive_stamp_with_ties_in_the_order_given(tmp_path: Path) -> None:
    logs = both(tmp_path)
    found = list(logs)
    assert len(found) == 16 + 40
    assert stamps(found) == sorted(stamps(found))
    assert [event.source for event in found[:6]] == ["imu0", *WHEELS, "imu0"]
    assert logs.warnings == []
    assert logs.bytes_read == logs.bytes_total > 0
    with pytest.raises(RuntimeError, match="once"):
        iter(logs)


def test_logs_of_different_days_are_warned_of(tmp_path: Path) -> None:
    logs = both(tmp_path, START_US - 86_400 * 10**6)
    assert len(list(logs)) == 56
    assert len(logs.warnings) == 1
    assert "do not overlap in time" in logs.warnings[0]
    assert "2023-11-13 22:13:20 UTC" in logs.warnings[0]


def test_a_log_without_anything_wanted_is_warned_of(tlog: Path) -> None:
    tlog.write_bytes(records(5)[4])
    logs = open_logs([tlog], configured())
    assert list(logs) == []
    assert logs.warnings == [f"{tlog}: nothing in it that the configuration asks for"]


def test_stamps_that_run_back_keep_their_log_in_order_and_hold_up_no_other(tmp_path: Path, tlog: Path) -> None:
    made = records(20)
    tlog.write_bytes(b"".join([*made[:4], made[10], *made[5:8], *made[11:]]))
    log = candump(tmp_path / "drive.log", "can0")
    found = list(open_logs([tlog, log], configured()))
    assert [event.sequence for event in found if event.source == "imu0"] == list(range(15))
    assert len(found) == 15 + 40
    wheels = stamps([event for event in found if event.source == "rear_left"])
    assert wheels == sorted(wheels)


def test_consecutive_logs_share_their_sequence_numbers(tmp_path: Path) -> None:
    first, second = tmp_path / "1.tlog", tmp_path / "2.tlog"
    first.write_bytes(b"".join(records(20)))
    second.write_bytes(b"".join(records(20, START_US + 10**6)))
    found = list(open_logs([first, second], configured()))
    assert sorted(event.sequence for event in found) == list(range(32))
