"""An unknown file: what it seems to be."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.guess import guess
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.autopilot_logs import described, ulog
from tests.helpers.logs import CANDUMP, configured, records


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (described("IMU"), "an ArduPilot DataFlash log: name it .bin"),
        (ulog({}), "a PX4 ULog: name it .ulg"),
        (b"".join(records(3)), "a MAVLink telemetry log: name it .tlog"),
        (CANDUMP.encode(), "a candump -L log: name it .log"),
        (gzip.compress(b"x"), "a gzip file: name it .gz"),
        (b"\x89MCAP0\r\n....", "an MCAP file: name it .mcap"),
        (b"$GPRMC,123519,A,4807.038,N", "NMEA 0183"),
        (b"t,lat,lon\n1,2,3\n", "a table of comma-separated values: name it .csv"),
        (b'[vehicle]\nname = "x"\n', "a configuration: give it with --config"),
    ],
)
def test_what_it_seems_to_be(tmp_path: Path, content: bytes, what: str) -> None:
    path = tmp_path / "drive.dat"
    path.write_bytes(content)
    assert guess(LogFile(path)).startswith("it seems to be ")
    with pytest.raises(LogError, match=r"drive\.dat: unknown kind of log: it seems to be ") as raised:
        open_logs([path], configured())
    assert what in str(raised.value)


def test_nothing_known(tmp_path: Path) -> None:
    path = tmp_path / "drive.dat"
    path.write_bytes(bytes(range(1, 200)))
    assert guess(LogFile(path)) == ""
