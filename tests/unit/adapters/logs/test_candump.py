"""The reader of candump logs: exact stamps, all forms of lines, bad lines counted."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from fusiond_adapters.logs.candump import OTHERS, WANTED
from tests.helpers.logs import CANDUMP, events, stamps


def test_no_group_is_possessive() -> None:
    """Python 3.11.2, Debian 12's, matches such a group to the middle of the repetition that fails."""
    assert not re.search(rb"\)[*+?]\+", OTHERS + WANTED)


def test_candump_stamps_are_exact(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    micro, nano = "(1700000000.123456) can0 0AA#1A6F1A6F1A6F1A6F", "(1700000000.123456789) can0 0aa#1a6f1a6f1a6f1a6f T"
    path.write_text(f"{micro}\n{nano}\r\n")
    found, _ = events(path)
    assert stamps(found[::4]) == [1_700_000_000_123_456_000, 1_700_000_000_123_456_789]


def test_candump_in_all_its_forms_and_with_bad_lines(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    lines = CANDUMP.splitlines()
    odd = [
        "(1700000000.000001) can0 0AA##31A6F1A6F1A6F1A6F",  # CAN FD
        "(1700000000.000002) can0 0AA#R8",
        "(1700000000.000003) can0 0AA#R",
        "(1700000000.000004) can0 20000080#0000000000000000",  # error frame
        "(1700000000.000005) can0 000000AA#1A6F1A6F1A6F1A6F",  # 29-bit id
        "",
        "(1700000000.000006) can0 0AA#1A6F1A6F1A6F1A6",  # half a byte
        "(1700000000.0000",
        "0AA#1A6F1A6F1A6F1A6F",
        "(1700000000.000007) can0 0AA#1A6F1A6F1A6F1A6G",
        "\x00\x01\x02",
        "(1700000000.000008) can0 0AA#1A6F",  # short
    ]
    path.write_text("\n".join([*lines, *odd, *lines]))
    found, counts = events(path)
    assert len(found) == 4 * (10 + 2 + 10)
    assert Counter(type(event.payload).__name__ for event in found) == {"WheelSpeed": 4 * 21 + 1, "Invalid": 3}
    assert {name: counts[name] for name in ("frames", "remote frames", "error frames", "other ids", "bad lines")} == {
        "frames": 26, "remote frames": 2, "error frames": 1, "other ids": 1, "bad lines": 5,
    }  # fmt: skip
