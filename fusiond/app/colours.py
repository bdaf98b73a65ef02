"""Colours of lines on a terminal: none elsewhere, and none where $NO_COLOR forbids them."""

from __future__ import annotations

import os
from typing import Literal, TextIO

CODES = {"red": "31", "yellow": "33", "bold": "1"}  # SGR, ECMA-48


def painted(text: str, colour: Literal["red", "yellow", "bold"], stream: TextIO) -> str:
    """The text in a colour if the stream is a terminal that has colours, and the user wants them (no-color.org)."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") in (None, "", "dumb") or not stream.isatty():
        return text
    return f"\x1b[{CODES[colour]}m{text}\x1b[0m"
