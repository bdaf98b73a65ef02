"""Colours are for terminals that have them and users who want them."""

from __future__ import annotations

import io

import pytest

from fusiond.app.colours import painted


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "term", "no_color", "coloured"),
    [
        (Terminal(), "xterm", "", True),
        (Terminal(), "xterm", "1", False),
        (Terminal(), "dumb", "", False),
        (io.StringIO(), "xterm", "", False),
    ],
)
def test_where_there_are_colours(
    monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, term: str, no_color: str, coloured: bool
) -> None:
    monkeypatch.setenv("TERM", term)
    monkeypatch.setenv("NO_COLOR", no_color)
    assert painted("text", "red", stream) == ("\x1b[31mtext\x1b[0m" if coloured else "text")
