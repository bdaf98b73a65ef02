"""The progress bar: on terminals only, within its bounds."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from fusiond.app.progress import line, shown
from fusiond.units import SECOND


class Terminal:
    """A text stream that says whether it is a terminal, and keeps what is written."""

    def __init__(self, tty: bool) -> None:
        self.tty = tty
        self.text = ""

    def isatty(self) -> bool:
        return self.tty

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        self.text += ""


def test_progress_is_shown_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 10**15, SECOND))
    monkeypatch.setattr("fusiond.app.progress.time.monotonic_ns", lambda: next(clock))
    for tty in (True, False):
        stream = Terminal(tty)
        items = list(shown(range(200), lambda: 0.5, lambda: 3 * SECOND, stream))  # type: ignore[arg-type]
        assert items == list(range(200))
        assert ("50 %  3 s of drive" in stream.text) is tty
    assert Terminal(False).text == ""


def test_progress_line_stays_within_its_bounds() -> None:
    assert "100 %" in line(1.7, 10.0, 2.0)
    assert line(0.0, 0.0, 0.0).startswith("[..")


def test_progress_ends_its_line_when_the_work_breaks_off() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise OSError("gone")

    stream = Terminal(True)
    with pytest.raises(OSError, match="gone"):
        list(shown(broken(), lambda: 0.0, lambda: 0, stream))  # type: ignore[arg-type]
    assert stream.text.endswith("\x1b[K")
