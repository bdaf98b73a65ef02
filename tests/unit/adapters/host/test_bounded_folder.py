"""Folders of bounded size: names that sort by time, and the oldest removed first."""

from __future__ import annotations

from pathlib import Path

from fusiond_adapters.host.bounded_folder import file_name, make_room, name_pattern


def test_names_hold_the_instant_and_match_their_pattern() -> None:
    name = file_name(1_700_000_000_123_456_789, "can.log")
    assert name == "20231114T221320.123456Z-can.log"
    assert name_pattern(r"\w+\.log").fullmatch(name)
    assert not name_pattern(r"\w+\.log").fullmatch("can.log")


def test_the_oldest_go_until_one_more_full_file_fits(tmp_path: Path) -> None:
    names = [file_name(second * 10**9, "can.log") for second in range(4)]
    for name in (*names, "notes.txt"):
        (tmp_path / name).write_bytes(bytes(100))
    pattern = name_pattern(r"\w+\.log")
    make_room(tmp_path, pattern, file_bytes=100, total_bytes=500)
    assert len(list(tmp_path.iterdir())) == 5
    make_room(tmp_path, pattern, file_bytes=100, total_bytes=300, open_files={tmp_path / names[0]})
    assert sorted(path.name for path in tmp_path.iterdir()) == [names[0], names[3], "notes.txt"]
