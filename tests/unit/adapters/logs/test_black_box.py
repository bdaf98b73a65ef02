"""The black box: its limits, its file names, and a disk that fails or is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from threading import Event

import pytest

from fusiond_adapters.host.bounded_folder import BoundedFolder
from fusiond_adapters.logs import black_box
from fusiond_adapters.logs.black_box import RETRY_NS, Recorder
from tests.helpers.disk import limited_files


def test_black_box_stays_below_its_limit_and_leaves_other_files_alone(tmp_path: Path) -> None:
    other = tmp_path / "mine.tlog"
    other.write_bytes(bytes(50_000))
    with Recorder(tmp_path, file_mb=0.01, total_mb=0.05) as box:
        for number in range(2000):
            box.add("fc.tlog", number * 10**7, bytes(100))
    files = sorted(tmp_path.glob("*Z-fc.tlog"))
    assert (box.written, box.lost) == (2000, 0)
    assert 3 <= len(files) <= 5 and all(file.stat().st_size <= 10_000 for file in files)
    assert files[-1].name == "0001-19700101T000019.000000Z-fc.tlog"
    assert box.removed == 20 - len(files)  # it has only its own: the latest are kept
    assert other.stat().st_size == 50_000


def test_black_box_survives_a_disk_that_fails(tmp_path: Path) -> None:
    folder = tmp_path / "box"
    with Recorder(folder, file_mb=1, total_mb=2) as box:
        folder.rmdir()
        for number in range(100):
            box.add("can.log", number, b"x")
    assert (box.written, box.lost) == (0, 100)
    assert box.error == "No such file or directory"


def test_black_box_goes_on_when_there_is_room_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    new_file = BoundedFolder.new_file

    def full_at_first(folder: BoundedFolder, t_ns: int, kind: str, open_files: set[Path]) -> Path:
        if t_ns < RETRY_NS // 2:
            raise no_space()
        return new_file(folder, t_ns, kind, open_files)

    monkeypatch.setattr(BoundedFolder, "new_file", full_at_first)
    with Recorder(tmp_path, file_mb=1, total_mb=2) as box:
        for t_ns, record in ((0, b"no room"), (RETRY_NS - 1, b"too early"), (RETRY_NS, b"again")):
            box.add("can.log", t_ns, record)
    assert (box.written, box.lost, box.error) == (1, 2, None)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"again"]


def no_space() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("records", [5, 3000])
def test_what_is_counted_as_written_is_on_the_disk(tmp_path: Path, records: int) -> None:
    """A disk that takes half a record and then nothing: the file ends with a whole record, the rest is counted as lost."""
    record = b"0123456789" * 10
    with limited_files(250), Recorder(tmp_path, file_mb=1, total_mb=2) as box:
        for number in range(records):
            box.add("can.log", number, record)
    found = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    assert found == record * box.written
    assert box.written + box.lost == records and box.written == 2  # what fits is kept
    assert box.error == "File too large"


def test_a_full_disk_leaves_no_empty_files(tmp_path: Path) -> None:
    with limited_files(1), Recorder(tmp_path, file_mb=1, total_mb=2) as box:
        for number in range(10):
            box.add("can.log", number * RETRY_NS, bytes(100))
    assert (box.written, box.lost, list(tmp_path.iterdir())) == (0, 10, [])


def test_what_a_sync_fails_to_bring_to_the_disk_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk may accept bytes into its cache, and fail when it has to keep them."""
    failing, synced, sync = Event(), Event(), os.fdatasync

    def fdatasync(file: int) -> None:
        if failing.is_set():
            raise no_space()
        sync(file)
        synced.set()

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    monkeypatch.setattr(black_box, "FLUSH_S", 0.01)
    with Recorder(tmp_path, file_mb=1, total_mb=2) as box:
        box.add("can.log", 1, b"kept")
        assert synced.wait(10)
        failing.set()
        box.add("can.log", 2, b"lost")
    assert (box.written, box.lost, box.error) == (1, 1, "No space left on device")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"kept"]
