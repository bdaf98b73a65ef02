"""The reader of .tlog: every record of a damaged file that can be had, and memory that does not grow."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest

from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.tlog import read_tlog
from fusiond_adapters.mavlink.decoder import MavlinkDecoder
from tests.helpers.logs import START_US, configured, events, records, stamps


def test_tlog_gives_the_wanted_records_in_order(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(20)))
    found, counts = events(tlog)
    assert stamps(found) == [(START_US + n * 10_000) * 1000 for n in range(20) if n % 5 != 4]
    assert [event.sequence for event in found] == list(range(16))
    assert counts == {"records": 20, "decoded": 16, "skipped": 4}


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


def test_memory_does_not_grow_with_the_log(tlog: Path) -> None:
    tlog.write_bytes(b"".join(records(5)) * 4000)
    log = LogFile(tlog)
    assert log.bytes_total > 1_000_000
    reading = read_tlog(log, MavlinkDecoder(configured(), "fc"))
    next(reading)
    assert 0 < log.bytes_read < log.bytes_total / 3
