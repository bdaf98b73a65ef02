"""Logs in: every format back to the same events, and no content that raises anything but LogError."""

from __future__ import annotations

import gzip
import random
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import can
import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest

from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.events import Received, WheelSpeed
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.merge import LogSet, open_logs
from fusiond_adapters.logs.tlog import read_tlog
from fusiond_adapters.mavlink.decoder import MavlinkDecoder
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


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    return tmp_path / "drive.tlog"


def stamps(found: list[Received]) -> list[int]:
    return [event.t_receive_ns for event in found]


def test_tlog_gives_the_wanted_records_in_order(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(20)))
    found, counts = events(tlog)
    assert stamps(found) == [(START_US + n * 10_000) * 1000 for n in range(20) if n % 5 != 4]
    assert [event.sequence for event in found] == list(range(16))
    assert counts == {"records": 20, "decoded": 16, "skipped": 4}


def test_zipped_tlog_is_the_same(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(20)))
    zipped = tlog.with_suffix(".tlog.gz")
    zipped.write_bytes(gzip.compress(tlog.read_bytes()))
    assert events(zipped)[0] == events(tlog)[0]


def test_a_zipped_log_cut_off_keeps_what_came_before(tlog: Path) -> None:
    zipped = tlog.with_suffix(".tlog.gz")
    whole = gzip.compress(random.Random(1).randbytes(40_000) + b"".join(records(100)), compresslevel=1)
    zipped.write_bytes(whole[:-200])
    found, counts = events(zipped)
    assert 0 < len(found) <= 80
    assert counts["damaged gzip"] == 1


def test_tlog_cut_at_every_byte_keeps_every_whole_record(tlog: Path) -> None:
    made = records(4)
    content = b"".join(made)
    ends = [sum(map(len, made[: n + 1])) for n in range(4)]
    for size in range(ends[0], len(content)):
        tlog.write_bytes(content[:size])
        found, counts = events(tlog)
        whole = sum(end <= size for end in ends)
        assert len(found) == whole
        assert counts == {"records": whole, "decoded": whole} | ({} if size in ends else {"truncated tail": 1})


def test_tlog_with_garbage_between_records_loses_none(tlog: Path) -> None:
    noise = random.Random(2)
    parts = [(record, noise.randbytes(noise.randrange(1, 60))) for record in records(200)]
    tlog.write_bytes(b"".join(part for pair in parts for part in pair))
    found, counts = events(tlog)
    assert len(found) == 160
    assert counts["bad bytes"] == sum(len(garbage) for _, garbage in parts)


@pytest.mark.parametrize("at", range(8, 20))
def test_a_damaged_header_costs_one_record(tlog: Path, at: int) -> None:
    made = records(12)
    broken = bytearray(made[5])
    broken[at] ^= 0x81
    tlog.write_bytes(b"".join([*made[:5], bytes(broken), *made[6:]]))
    found, _ = events(tlog)
    assert stamps(found) == [(START_US + n * 10_000) * 1000 for n in range(12) if n % 5 != 4 and n != 5]


@pytest.mark.parametrize("bit", [21, 30, 40, 50, 62])
def test_a_stamp_gone_astray_costs_one_record(tlog: Path, bit: int) -> None:
    made = records(12)
    made[5] = struct.pack(">Q", (START_US + 50_000) ^ 1 << bit) + made[5][8:]
    tlog.write_bytes(b"".join(made))
    found, counts = events(tlog)
    assert stamps(found) == [(START_US + n * 10_000) * 1000 for n in range(12) if n % 5 != 4 and n != 5]
    assert counts["bad stamps"] == 1


def test_a_clock_that_is_set_is_followed(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(5, 10**9) + records(5, START_US) + records(5, START_US - 3_600 * 10**6)))
    found, counts = events(tlog)
    assert len(found) == 12
    assert counts["clock set back"] == 1
    assert "bad stamps" not in counts


def test_pauses_are_no_damage(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(10, step_us=7_200 * 10**6)))
    found, counts = events(tlog)
    assert len(found) == 8
    assert set(counts) == {"records", "decoded", "skipped"}


def test_flipped_bits_never_raise(tlog: Path) -> None:
    content, dice = b"".join(records(12)), random.Random(3)
    for _ in range(150):
        broken = bytearray(content)
        for _ in range(dice.randrange(1, 20)):
            broken[dice.randrange(len(broken))] ^= 1 << dice.randrange(8)
        tlog.write_bytes(broken)
        try:
            found, _ = events(tlog)
        except LogError:
            continue
        assert len(found) <= 10


CANDUMP = "".join(f"({START_US / 1e6 + n / 100:.6f}) can0 0AA#1A6F1A6F1A6F{0x1A6F + n:04X}\n" for n in range(10))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.tlog", b""),
        ("a.tlog", CANDUMP.encode()),
        ("a.tlog", bytes(5000)),
        ("a.tlog", b"\xfd" * 5000),
        ("a.tlog", random.Random(4).randbytes(300_000)),
        ("a.log", b""),
        ("a.log", b"\n\n\n"),
        ("a.log", b"".join(records(30))),
        ("a.log", random.Random(5).randbytes(300_000)),
        ("a.log", b"x" * 300_000),
        *((f"a.{kind}", CANDUMP.encode()) for kind in ("asc", "blf", "trc", "csv", "db", "mf4")),
        *((f"a.{kind}", random.Random(6).randbytes(5000)) for kind in ("asc", "blf", "trc", "csv", "db")),
        *((f"a.{kind}.gz", CANDUMP.encode()) for kind in ("tlog", "log", "asc", "blf")),
        *((f"a.{kind}.gz", gzip.compress(b"")) for kind in ("tlog", "log", "asc", "blf", "trc", "csv")),
    ],
)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_is_no_log_of_its_kind_is_said(tmp_path: Path, name: str, content: bytes) -> None:
    if name.endswith(".mf4"):
        pytest.importorskip("asammdf")
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError, match=name):
        events(path)


def test_files_that_cannot_be_opened_are_said(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"nowhere\.tlog: cannot be read: No such file"):
        open_logs([tmp_path / "nowhere.tlog"], configured())
    (tmp_path / "folder.tlog").mkdir()
    with pytest.raises(LogError, match=r"folder\.tlog: is not a file"):
        open_logs([tmp_path / "folder.tlog"], configured())
    for name in ("a.bin", "a", "a.db.gz", "a.gz"):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(LogError, match=r"unknown kind of log; known: .*\.tlog"):
            open_logs([tmp_path / name], configured())
    with pytest.raises(LogError, match="no log given"):
        open_logs([], configured())


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


@pytest.mark.parametrize("suffix", [".log", ".log.gz", ".asc", ".asc.gz", ".blf", ".trc", ".csv", ".csv.gz", ".db"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_every_can_format_gives_the_same_wheels(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"drive{suffix}")
    found, counts = events(path)
    assert [event.source for event in found] == list(WHEELS) * 40
    speeds = [event.payload.speed for event in found if isinstance(event.payload, WheelSpeed)]
    expected = [(3600 + 10 * number + wheel) * 0.01 / 3.6 for number in range(40) for wheel in range(4)]
    assert speeds == pytest.approx(expected)
    since_ms = [(event.t_receive_ns - found[0].t_receive_ns) / 1e6 for event in found[::4]]
    assert since_ms == pytest.approx([12.5 * number for number in range(40)], abs=0.01)
    assert abs(found[0].t_receive_ns / 1e9 - START_US / 1e6) < 1.0  # .asc: python-can writes the start to a second
    assert counts["other ids"] >= 80
    assert counts["decoded"] == 40


def test_candump_stamps_are_exact(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    micro, nano = "(1700000000.123456) can0 0AA#1A6F1A6F1A6F1A6F", "(1700000000.123456789) can0 0aa#1a6f1a6f1a6f1a6f T"
    path.write_text(f"{micro}\n{nano}\r\n")
    found, _ = events(path)
    assert stamps(found[::4]) == [1_700_000_000_123_456_000, 1_700_000_000_123_456_789]


def test_a_can_stamp_gone_astray_costs_one_frame(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.log")
    lines = path.read_text().splitlines()
    wheel = [place for place, line in enumerate(lines) if " 0AA#" in line and "#R" not in line][7]
    lines[wheel] = lines[wheel].replace("(1", "(2", 1)  # decades ahead
    path.write_text("\n".join(lines) + "\n")
    found, counts = events(path)
    assert (len(found), counts["bad stamps"]) == (4 * 39, 1)
    assert stamps(found) == sorted(stamps(found))


def test_candump_in_all_its_forms_and_with_bad_lines(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    lines = CANDUMP.splitlines()
    odd = [
        "(1700000000.000001) can0 0AA##31A6F1A6F1A6F1A6F",  # CAN FD
        "(1700000000.000002) can0 0AA#R8",
        "(1700000000.000003) can0 0AA#R",
        "(1700000000.000004) can0 20000080#0000000000000000",  # error frame
        "(1700000000.000005) can0 000000AA#1A6F1A6F1A6F1A6F",  # 29-bit id
        "",
        "(1700000000.000006) can0 0AA#1A6F1A6F1A6F1A6",  # half a byte
        "(1700000000.0000",
        "0AA#1A6F1A6F1A6F1A6F",
        "(1700000000.000007) can0 0AA#1A6F1A6F1A6F1A6G",
        "\x00\x01\x02",
        "(1700000000.000008) can0 0AA#1A6F",  # short
    ]
    path.write_text("\n".join([*lines, *odd, *lines]))
    found, counts = events(path)
    assert len(found) == 4 * (10 + 2 + 10)
    assert Counter(type(event.payload).__name__ for event in found) == {"WheelSpeed": 4 * 21 + 1, "Invalid": 3}
    assert {name: counts[name] for name in ("frames", "remote frames", "error frames", "other ids", "bad lines")} == {
        "frames": 26, "remote frames": 2, "error frames": 1, "other ids": 1, "bad lines": 5,
    }  # fmt: skip


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".csv"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_bad_line_costs_at_most_the_next(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"drive{suffix}")
    lines = path.read_text().splitlines()
    middle = len(lines) // 2
    lines[middle] = lines[middle].replace("1", "G").replace("0", "G")
    path.write_text("\n".join(lines))
    found, _ = events(path)
    assert len(found) >= 4 * 39


@pytest.mark.parametrize(("suffix", "count"), [(".blf", 300), (".asc", 150), (".trc", 150), (".csv", 150), (".db", 60)])
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_damaged_can_logs_never_raise(tmp_path: Path, suffix: str, count: int) -> None:
    content, bad, dice = written(tmp_path / f"good{suffix}").read_bytes(), tmp_path / f"bad{suffix}", random.Random(7)
    outcomes: Counter[str] = Counter()
    for _ in range(count):
        broken = bytearray(content[: dice.randrange(1, len(content) + 1)])
        for _ in range(dice.randrange(5)):
            broken[dice.randrange(len(broken))] = dice.randrange(256)
        bad.write_bytes(broken)
        try:
            outcomes["read"] += len(events(bad)[0]) <= 4 * 41
        except LogError:
            outcomes["refused"] += 1
    assert outcomes.total() == count


def candump(path: Path, *channels: str) -> Path:
    lines = [line.replace("can0", channel) for line in CANDUMP.splitlines() for channel in channels]
    path.write_text("\n".join(lines))
    return path


def test_channels_are_matched_by_name_or_log_channel(tmp_path: Path) -> None:
    log = candump(tmp_path / "drive.log", "can0", "can1")
    assert events(log, configured("can1"))[1] == {"frames": 20, "other channels": 10, "decoded": 10}
    assert events(log, configured("body", "can1"))[1] == {"frames": 20, "other channels": 10, "decoded": 10}


def test_two_buses_in_one_log(tmp_path: Path) -> None:
    rear = '[can.rear]\ndbc = ["rav4.dbc"]\nlog_channel = "can7"\n[wheel.w]\nbus = "rear"\nmessage = "WHEEL_SPEEDS"\n'
    settings = configured(more=rear + 'signal = "WHEEL_SPEED_FL"\n')
    found, _ = events(candump(tmp_path / "drive.log", "can0", "can7", "can8"), settings)
    assert Counter(event.source for event in found) == dict.fromkeys([*WHEELS, "w"], 10)


def test_the_only_channel_is_taken_for_the_only_bus(tmp_path: Path) -> None:
    log = candump(tmp_path / "drive.log", "vcan3")
    logs = open_logs([log], configured("body"))
    assert len(list(logs)) == 40
    assert logs.warnings == [f"{log}: channel vcan3 is taken for the bus body"]
    assert len(list(open_logs([f"body={log}"], configured("body", "can9")))) == 40


@pytest.mark.parametrize(
    ("settings", "channels", "complaint"),
    [
        (configured("body"), ("can0", "can1"), "wheel frames are on can0, can1, wanted on body: set log_channel"),
        (configured("body", "can9"), ("can0",), "wheel frames are on can0, wanted on can9"),
    ],
)
def test_channels_of_nobody_are_said(
    tmp_path: Path, settings: Config, channels: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(LogError, match=complaint):
        events(candump(tmp_path / "drive.log", *channels), settings)


def test_a_format_without_channels_needs_the_bus_where_there_are_two(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.csv")
    rear = '[can.rear]\ndbc = ["rav4.dbc"]\n[wheel.w]\nbus = "rear"\nmessage = "WHEEL_SPEEDS"\n'
    settings = configured(more=rear + 'signal = "WHEEL_SPEED_FL"\n')
    with pytest.raises(LogError, match="no channels; say whose it is: BUS="):
        events(path, settings)
    assert Counter(event.source for event in open_logs([f"rear={path}"], settings)) == {"w": 40}


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


def test_memory_does_not_grow_with_the_log(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(5)) * 4000)
    log = LogFile(tlog)
    assert log.bytes_total > 1_000_000
    reading = read_tlog(log, MavlinkDecoder(configured(), "fc"))
    next(reading)
    assert 0 < log.bytes_read < log.bytes_total / 3
