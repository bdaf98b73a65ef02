"""Log files: zipped, cut off, missing, and files that are not of their format."""

from __future__ import annotations

import gzip
import random
from pathlib import Path

import pytest

from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.logs import CANDUMP, configured, events, records


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
        *((f"a.{kind}.gz", gzip.compress(b"", mtime=0)) for kind in ("tlog", "log", "asc", "blf", "trc", "csv")),
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
