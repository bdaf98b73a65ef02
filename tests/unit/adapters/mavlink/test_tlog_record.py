"""The record of a .tlog, byte for byte."""

from __future__ import annotations

from fusiond_adapters.mavlink.tlog_record import tlog_record


def test_a_record_is_microseconds_big_endian_and_the_frame() -> None:
    assert tlog_record(b"\xfd\x01", 0x0102030405060708 * 1000 + 999) == bytes(range(1, 9)) + b"\xfd\x01"
