"""The messages of a .tlog, by sender."""

from __future__ import annotations

import struct
from pathlib import Path

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest

from fusiond_adapters.logs.census import census

START_US = 1_700_000_000_000_000


def written(path: Path) -> Path:
    records = []
    for second in range(11):
        for system, message in (
            (1, dialect.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0)),
            (10, dialect.MAVLink_raw_imu_message(0, *(0,) * 9)),
        ):
            for at in range(1 if system == 10 else 4):
                stamp = struct.pack(">Q", START_US + second * 1_000_000 + at * 250_000)
                records.append(stamp + message.pack(dialect.MAVLink(None, system, 1)))
    path.write_bytes(b"".join(sorted(records)))
    return path


def test_each_message_of_each_sender_has_its_rate(tmp_path: Path) -> None:
    found = [one[:4] for one in census(written(tmp_path / "a.tlog"))]
    assert found == [(1, 1, "ATTITUDE", 44), (10, 1, "RAW_IMU", 11)]
    rates = [one.rate_hz for one in census(tmp_path / "a.tlog")]
    assert rates == pytest.approx([4.0, 1.0])


def test_what_is_no_log_has_none(tmp_path: Path) -> None:
    (tmp_path / "b.tlog").write_bytes(b"nothing")
    assert census(tmp_path / "b.tlog") == census(tmp_path / "absent.tlog") == []
