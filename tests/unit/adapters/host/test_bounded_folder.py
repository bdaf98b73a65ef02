"""Folders of bounded size: the files of the oldest recording go first, whatever the clock says."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.units import SECOND
from fusiond_adapters.host.bounded_folder import BoundedFolder

NOW, IN_1971 = 1_790_000_000 * SECOND, 31_600_000 * SECOND  # ns
SIZE = 100  # bytes of a full file


def recording(folder: Path, total: int = 500) -> BoundedFolder:
    return BoundedFolder(folder, r"\w+\.log", SIZE, total)


def fill(box: BoundedFolder, t_ns: int, files: int, size: int = SIZE) -> list[str]:
    """Write so many files, a second apart; their names."""
    made = [box.new_file(t_ns + number * SECOND, "can.log") for number in range(files)]
    for path in made:
        path.write_bytes(bytes(size))
    return [path.name for path in made]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_names_hold_the_recording_and_the_instant(tmp_path: Path) -> None:
    first, second = recording(tmp_path), recording(tmp_path)
    path = first.new_file(1_700_000_000_123_456_789, "can.log")
    assert path.name == "0001-20231114T221320.123456Z-can.log"
    path.touch()
    assert second.new_file(0, "can.log").name == "0002-19700101T000000.000000Z-can.log"
    assert first.new_file(SECOND, "can.log").name == "0001-19700101T000001.000000Z-can.log"


def test_the_oldest_go_until_one_more_full_file_fits(tmp_path: Path) -> None:
    (tmp_path / "notes.log").write_bytes(bytes(1000))
    (tmp_path / "20231114T221320.123456Z-can.log").write_bytes(bytes(SIZE))  # of a version that did not count
    first = fill(recording(tmp_path), NOW, 4)
    later = recording(tmp_path)
    later.new_file(NOW, "can.log")
    assert names(tmp_path) == [*first, "notes.log"]
    later = recording(tmp_path, 300)
    later.new_file(NOW, "can.log", open_files={tmp_path / first[0]})
    assert names(tmp_path) == [first[0], first[3], "notes.log"]
    assert later.removed == 0


@pytest.mark.parametrize("clock_ns", [IN_1971, 2 * NOW])
def test_a_wrong_clock_erases_nothing_that_is_younger(tmp_path: Path, clock_ns: int) -> None:
    """The drive under a wrong clock takes the place of the oldest, keeps all it wrote, and outlives older drives."""
    old = fill(recording(tmp_path), NOW, 4)
    drive = recording(tmp_path)
    wrong = [name for number in range(3) for name in fill(drive, clock_ns + number * SECOND, 1)]
    assert names(tmp_path) == [*old[2:], *wrong] and drive.removed == 0
    right = [name for number in range(2) for name in fill(recording(tmp_path), NOW, 1)]
    assert names(tmp_path) == [*wrong, *right]


def test_a_recording_larger_than_the_limit_loses_its_own_beginning_and_says_so(tmp_path: Path) -> None:
    drive = recording(tmp_path)
    made = [name for number in range(8) for name in fill(drive, IN_1971 + number * SECOND, 1)]
    assert names(tmp_path) == made[3:] and drive.removed == 3


def test_what_is_kept_goes_last_of_its_recording(tmp_path: Path) -> None:
    box = BoundedFolder(tmp_path, r"\w+\.(?:log|json)", SIZE, 500, r"\w+\.json")
    box.new_file(NOW, "config.json").write_bytes(bytes(SIZE))
    for number in range(1, 13):
        fill(box, NOW + number * SECOND, 1)
    assert [name.rpartition("-")[2] for name in names(tmp_path)] == ["config.json", *["can.log"] * 4]
    later = BoundedFolder(tmp_path, r"\w+\.(?:log|json)", SIZE, 500, r"\w+\.json")
    for number in range(60, 65):
        fill(later, NOW + number * SECOND, 1)
    assert [name[:4] for name in names(tmp_path)] == ["0002"] * 5  # of an older recording nothing is held back
