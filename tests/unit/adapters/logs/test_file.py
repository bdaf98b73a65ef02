"""Log files: zipped, cut off, missing, and files that are not of their format."""

from __future__ import annotations

import gzip
import random
from pathlib import Path

import pytest

from fusiond_adapters.logs.file import ZIPPED, LogError, LogFile
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.logs import CANDUMP, configured, events, records, written


def zstandard(content: bytes) -> bytes:
    compressed: bytes = pytest.importorskip("zstandard").ZstdCompressor(level=1).compress(content)
    return compressed


PACKED = {".gz": gzip.compress, ".zst": zstandard}


@pytest.mark.parametrize("suffix", PACKED)
def test_zipped_tlog_is_the_same(tlog: Path, suffix: str) -> None:
    tlog.write_bytes(b"".join(records(20)))
    zipped = tlog.with_suffix(f".tlog{suffix}")
    zipped.write_bytes(PACKED[suffix](tlog.read_bytes()))
    assert events(zipped)[0] == events(tlog)[0]
    halves = b"".join(records(20)[:10]), b"".join(records(20)[10:])
    zipped.write_bytes(b"".join(map(PACKED[suffix], halves)))  # of several members, one after another
    assert events(zipped)[0] == events(tlog)[0]


@pytest.mark.parametrize("suffix", PACKED)
def test_a_zipped_log_cut_off_keeps_what_came_before(tlog: Path, suffix: str) -> None:
    zipped = tlog.with_suffix(f".tlog{suffix}")
    packed = PACKED[suffix](random.Random(1).randbytes(400_000) + b"".join(records(100)))
    for cut in (1, 100):
        zipped.write_bytes(packed[:-cut])
        log = LogFile(zipped)
        assert sum(map(len, log.blocks())) > 100_000
        assert log.counts == {f"damaged {ZIPPED[suffix]}": 1}


@pytest.mark.parametrize("suffix", PACKED)
@pytest.mark.parametrize("kind", ["db", "mf4"])
def test_what_is_read_from_a_file_is_unzipped_into_one(tmp_path: Path, suffix: str, kind: str) -> None:
    if kind == "mf4":
        pytest.importorskip("asammdf")
    plain = written(tmp_path / f"a.{kind}")
    zipped = tmp_path / f"a.{kind}{suffix}"
    zipped.write_bytes(PACKED[suffix](plain.read_bytes()))
    assert len(events(plain)[0]) == 160
    assert events(zipped)[0] == events(plain)[0]


def test_a_zstandard_file_cannot_claim_more_memory_than_a_log_needs(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog.zst"
    path.write_bytes(zstandard(bytes(50_000_000)))
    assert max(map(len, LogFile(path).blocks())) < 20_000_000


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
    (tmp_path / "a.gz").write_bytes(b"x")
    with pytest.raises(LogError, match=r"a\.gz: is not a gzip file"):
        open_logs([tmp_path / "a.gz"], configured())
    for name in ("a.dat", "a"):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(LogError, match=r"unknown kind of log; known: .*\.tlog"):
            open_logs([tmp_path / name], configured())
    with pytest.raises(LogError, match="no log given"):
        open_logs([], configured())
