"""A progress bar on a terminal; nothing where the output is none."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TextIO, TypeVar

WIDTH = 30  # characters of the bar
INTERVAL_NS = 100_000_000  # between two drawings
STRIDE = 64  # events between two looks at the clock

Item = TypeVar("Item")


def shown(
    items: Iterable[Item], share: Callable[[], float], elapsed_ns: Callable[[], int], stream: TextIO
) -> Iterator[Item]:
    """The same items, with a bar that tells how far they have come.

    `share` is the part done, 0 to 1; `elapsed_ns` the recorded time that has passed, for the pace.
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
                stream.write("\r" + line(share(), elapsed_ns() / 1e9, (now - began) / 1e9))
                stream.flush()
    finally:
        stream.write("\r\x1b[K")  # leaves an empty line to whoever writes next
        stream.flush()


def line(share: float, recorded_s: float, real_s: float) -> str:
    """One drawing of the bar."""
    done = min(1.0, max(0.0, share))
    full = round(done * WIDTH)
    pace = recorded_s / real_s if real_s > 0 else 0.0
    return f"[{'#' * full}{'.' * (WIDTH - full)}] {100 * done:3.0f} %  {recorded_s:.0f} s of drive, {pace:.0f} x real time"
