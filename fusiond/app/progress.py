"""A progress bar on a terminal; nothing if the output is not a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TextIO, TypeVar

from fusiond.units import MILLISECOND, SECOND

WIDTH = 30  # characters of the bar
INTERVAL_NS = 100 * MILLISECOND  # between two drawings
STRIDE = 64  # events between two readings of the clock

Item = TypeVar("Item")


def shown(
    items: Iterable[Item], share: Callable[[], float], elapsed_ns: Callable[[], int], stream: TextIO
) -> Iterator[Item]:
    """The same items, with a bar that shows the progress.

    `share` returns the part done, 0 to 1; `elapsed_ns` the recorded time that has passed, for the speed.
    """
    if not stream.isatty():
        yield from items
        return
    began = drawn = time.monotonic_ns()
    try:
        for number, item in enumerate(items):
            yield item
            if number % STRIDE == 0 and (now := time.monotonic_ns()) - drawn >= INTERVAL_NS:
                drawn = now
                stream.write("\r" + line(share(), elapsed_ns() / SECOND, (now - began) / SECOND))
                stream.flush()
    finally:
        stream.write("\r\x1b[K")  # leaves an empty line
        stream.flush()


def line(share: float, recorded_s: float, real_s: float) -> str:
    """One drawing of the bar."""
    done = min(1.0, max(0.0, share))
    full = round(done * WIDTH)
    pace = recorded_s / real_s if real_s > 0 else 0.0
    return f"[{'#' * full}{'.' * (WIDTH - full)}] {100 * done:3.0f} %  {recorded_s:.0f} s of drive, {pace:.0f} x real time"
