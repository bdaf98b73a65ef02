"""Several logs as one stream: order, warnings, and which log is whose."""

from __future__ import annotations

from itertools import chain, pairwise
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


# --- Sessions


OTHER_BUS = """[can.can1]
dbc = ["rav4.dbc"]
[wheel.trailer]
bus = "can1"
message = "WHEEL_SPEEDS"
signal = "WHEEL_SPEED_RL"
"""


def lines(channel: str, first_us: int, count: int, every_us: int = 10_000) -> str:
    return "".join(
        f"({(first_us + n * every_us) // 10**6}.{(first_us + n * every_us) % 10**6:06d}) {channel}"
        f" 0AA#1A6F1A6F1A6F{0x1A6F + n % 256:04X}\n"
        for n in range(count)
    )


def found_in(tmp_path: Path, tlog: list[list[bytes]], canlog: str) -> tuple[LogSet, list[tuple[str, float]]]:
    """The set of the two logs, and sources and receipts [s] of its events, the right wheels and left front left out."""
    (tmp_path / "drive.tlog").write_bytes(b"".join(chain.from_iterable(tlog)))
    (tmp_path / "drive.log").write_text(canlog)
    logs = open_logs([tmp_path / "drive.tlog", tmp_path / "drive.log"], configured())
    events = [event for event in logs if event.source in ("imu0", "rear_left")]
    return logs, [(event.source, (event.t_receive_ns // 1000 - START_US) / 1e6) for event in events]


@pytest.mark.parametrize("by_us", [300_000, 20 * 10**6, 3600 * 10**6, 86_400 * 10**6])
def test_all_logs_enter_a_new_session_together(tmp_path: Path, by_us: int) -> None:
    """The CAN log steps back 0.2 s before the .tlog does, so is ahead of it in the file; and the other way round."""
    whole, later = 1_000_000, START_US + 1_000_000 - by_us
    for shift in (-200_000, 200_000):
        bus = lines("can0", START_US, (whole + shift) // 10_000) + lines("can0", later + shift, 100)
        logs, found = found_in(tmp_path, [records(100), records(100, later)], bus)
        times = [t for _, t in found]
        step = next(n for n, (before, after) in enumerate(pairwise(times)) if after < before) + 1
        assert times[:step] == sorted(times[:step]) and times[step:] == sorted(times[step:])
        assert times[step] == (min(later, later + shift) - START_US) / 1e6
        assert sum(source == "imu0" for source, _ in found[:step]) == 80
        assert sum(source == "rear_left" for source, _ in found[:step]) == (whole + shift) // 10_000
        assert [counts["steps back"] for counts in logs.counts.values()] == [1, 1]


def test_a_log_that_does_not_step_back_goes_on_in_the_new_session(tmp_path: Path) -> None:
    """Another host has stamped it: nothing of it comes before the step but what lies before it, and nothing is lost."""
    long = 200 * 10**6
    later = START_US + 50 * 10**6
    _, found = found_in(
        tmp_path,
        [records(100, START_US, 10**6), records(100, later, 10**6)],
        lines("can0", START_US, long // 100_000, 100_000),
    )
    step = next(n for n, ((_, before), (_, after)) in enumerate(pairwise(found)) if after < before) + 1
    assert found[step] == ("imu0", 50.0)
    wheels = [t for source, t in found[step:] if source == "rear_left"]
    assert wheels[0] == 98.0 and len(wheels) == 2000 - 980
    assert [t for _, t in found[step:]] == sorted(t for _, t in found[step:])


def test_a_log_that_ends_with_the_session_is_read_to_its_end_before_the_next(tmp_path: Path) -> None:
    later = START_US - 3600 * 10**6
    _, found = found_in(tmp_path, [records(100), records(100, later)], lines("can0", START_US, 105))
    assert [source for source, _ in found[-80:]] == ["imu0"] * 80


def test_channels_written_in_blocks_are_one_session(tmp_path: Path) -> None:
    """Half a second of one bus, then the same half of another: each by itself is in order."""
    path = tmp_path / "drive.log"
    blocks = [lines(bus, START_US + n * 500_000, 50) for n in range(2) for bus in ("can0", "can1")]
    path.write_text("".join(blocks))
    logs = open_logs([path], configured(more=OTHER_BUS))
    assert len(list(logs)) == 4 * 100 + 100
    assert "steps back" not in logs.counts[str(path)]


@pytest.mark.parametrize("place", [50, 99])
def test_a_lone_stamp_behind_begins_no_session(tmp_path: Path, place: int) -> None:
    made = [lines("can0", START_US + n * 10_000 - (500_000 if n == place else 0), 1) for n in range(100)]
    logs, found = found_in(tmp_path, [records(100)], "".join(made))
    times = [t for _, t in found]
    assert times == sorted(times) and len(times) == 180
    before = (place - 1) / 100
    assert [t for source, t in found if source == "rear_left"][place - 1 : place + 1] == [before, before]
    counts = logs.counts[str(tmp_path / "drive.log")]
    assert counts["stamps run back"] == 4 and "steps back" not in counts
