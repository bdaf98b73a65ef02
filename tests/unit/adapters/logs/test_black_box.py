"""The black box: its limits, its file names, and a disk that fails or is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import BinaryIO

from fusiond_adapters.logs.black_box import RETRY_NS, Recorder


def test_black_box_stays_below_its_limit_and_leaves_other_files_alone(tmp_path: Path) -> None:
    other = tmp_path / "mine.tlog"
    other.write_bytes(bytes(50_000))
    with Recorder(tmp_path, file_mb=0.01, total_mb=0.05) as box:
        for number in range(2000):
            box.add("fc.tlog", number * 10**7, bytes(100))
    files = sorted(tmp_path.glob("*Z-fc.tlog"))
    assert (box.written, box.lost) == (2000, 0)
    assert 3 <= len(files) <= 5 and all(file.stat().st_size <= 10_000 for file in files)
    assert files[-1].name == "19700101T000019.000000Z-fc.tlog"
    assert other.stat().st_size == 50_000


def test_black_box_survives_a_disk_that_fails(tmp_path: Path) -> None:
    folder = tmp_path / "box"
    with Recorder(folder, file_mb=1, total_mb=2) as box:
        folder.rmdir()
        for number in range(100):
            box.add("can.log", number, b"x")
    assert (box.written, box.lost) == (0, 100)
    assert box.error == "No such file or directory"


def test_black_box_goes_on_when_there_is_room_again(tmp_path: Path) -> None:
    class FullAtFirst(Recorder):
        def _open(self, kind: str, t_ns: int) -> BinaryIO:
            if t_ns < RETRY_NS // 2:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super()._open(kind, t_ns)

    with FullAtFirst(tmp_path, file_mb=1, total_mb=2) as box:
        for t_ns, record in ((0, b"no room"), (RETRY_NS - 1, b"too early"), (RETRY_NS, b"again")):
            box.add("can.log", t_ns, record)
    assert (box.written, box.lost, box.error) == (1, 2, None)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"again"]
