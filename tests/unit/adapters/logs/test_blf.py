"""BLF with sizes that lie: what comes before is read, what is wrong is told, in little time and memory."""

from __future__ import annotations

import io
import tracemalloc
import zlib
from pathlib import Path

import can
import pytest

from fusiond_adapters.logs.blf import CONTAINER, CONTAINER_KIND, DEFLATED, MAGIC, OBJECT, BlfError, checked
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.logs import configured, written

HUGE = 0xFFFF_FFF0
FRAME = OBJECT.pack(MAGIC, 32, 1, 48, 1) + bytes(16) + b"\1\0\0\x08\xaa\0\0\0" + bytes(8)


@pytest.fixture(scope="module")
def header(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("blf") / "good.blf").read_bytes()[:144]


def container(content: bytes, size: int = 0) -> bytes:
    packed = zlib.compress(content)
    size = size or OBJECT.size + CONTAINER.size + len(packed)
    return OBJECT.pack(MAGIC, 16, 1, size, CONTAINER_KIND) + CONTAINER.pack(DEFLATED) + packed + bytes(size % 4)


def other(size: int, kind: int = 65) -> bytes:
    return OBJECT.pack(MAGIC, 32, 1, size, kind)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (container(FRAME * 20 + other(0)), "an object of kind 65 claims 0 bytes"),
        (container(FRAME * 20 + other(0, kind=1)), "an object of kind 1 claims 0 bytes"),
        (container(FRAME * 20 + other(HUGE, kind=1) + bytes(99)), f"an object of kind 1 claims {HUGE} bytes"),
        (container(FRAME * 20 + other(HUGE)) + container(FRAME) * 50, "it ends inside an object"),
        (container(FRAME * 20 + bytes(16 << 20)), "no object where one should begin"),
        (container(FRAME * 20) + container(b"", size=HUGE), "bytes before the end of an object"),
        (container(FRAME * 20) + container(FRAME, size=15), "an object claims 15 bytes"),
    ],
    ids=["0", "0 of CAN", "huge of CAN", "huge", "zeros", "container huge", "container 15"],
)
def test_a_lying_size_is_told_and_what_comes_before_it_is_read(
    header: bytes, tmp_path: Path, content: bytes, reason: str
) -> None:
    path = tmp_path / "drive.blf"
    path.write_bytes(header + content)
    logs = open_logs([path], configured())
    tracemalloc.start()
    try:
        assert len(list(logs)) == 4 * 20
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    assert logs.counts[str(path)] == {"frames": 20, "unreadable tail": 1, "decoded": 20}
    (warning,) = (warning for warning in logs.warnings if "its end" in warning)
    assert warning.startswith(f"{path}: cannot be read to its end: ")
    assert reason in warning


@pytest.mark.parametrize("size", [0, 143, HUGE])
def test_a_header_of_a_lying_size(header: bytes, tmp_path: Path, size: int) -> None:
    path = tmp_path / "drive.blf"
    path.write_bytes(header[:4] + size.to_bytes(4, "little") + header[8:] + container(FRAME))
    with pytest.raises(LogError, match=r"is not a \.blf log: it"):
        list(open_logs([path], configured()))


def test_objects_of_other_kinds_are_skipped_whatever_their_size(header: bytes) -> None:
    large = other(1 << 20) + bytes((1 << 20) - OBJECT.size)
    stream = io.BufferedReader(io.BytesIO(header + container(FRAME + large + FRAME) + container(FRAME)))  # type: ignore[arg-type]
    read = b"".join(checked(stream))
    assert len(list(can.BLFReader(io.BytesIO(read)))) == 3
    assert len(read) < 1000


def test_what_is_not_a_blf() -> None:
    with pytest.raises(BlfError, match="does not start like one"):
        list(checked(io.BufferedReader(io.BytesIO(b"(1.0) can0 0AA#00\n" * 20))))  # type: ignore[arg-type]
