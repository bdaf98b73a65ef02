"""What is in a log, without a configuration: its streams of messages, who sends them, how regularly."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field

from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.guess import guess
from fusiond_adapters.registry import LOG_FORMATS

MOST_INTERVALS = 20_000  # of a stream, from which the rate and the jitter are told
SPACING_NS = 200 * MILLISECOND  # of the frames that are kept
MOST_KEPT = 20_000  # frames of an id
STEP_BACK_NS = SECOND  # of one stream's stamps: a new session begins


class Stream(Struct):
    """The messages of one kind from one sender. Times in [s] count from the first message of the log."""

    sender: str
    name: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    gap_ns: int = 0  # the longest interval
    gap_at_ns: int = 0  # where it began
    steps_back: int = 0
    intervals_ns: list[int] = field(default_factory=list)  # the first ones
    kept: list[tuple[int, bytes]] = field(default_factory=list)  # stamps and data of some CAN frames

    def add(self, t_ns: int) -> None:
        """Add a message."""
        if self.count:
            interval_ns = t_ns - self.last_ns
            if interval_ns < -STEP_BACK_NS:
                self.steps_back += 1
            elif interval_ns > self.gap_ns:
                self.gap_ns, self.gap_at_ns = interval_ns, self.last_ns
            if len(self.intervals_ns) < MOST_INTERVALS:
                self.intervals_ns.append(interval_ns)
        else:
            self.first_ns = t_ns
        self.count += 1
        self.last_ns = t_ns

    def keep(self, t_ns: int, data: bytes) -> None:
        """Keep a frame's data, if the last one that was kept is some time ago."""
        if not self.kept or (t_ns - self.kept[-1][0] >= SPACING_NS and len(self.kept) < MOST_KEPT):
            self.kept.append((t_ns, data))

    @property
    def rate_hz(self) -> float:
        """By the median interval; 0 where there is none."""
        median_ns = float(np.median(self.intervals_ns)) if self.intervals_ns else 0.0
        if median_ns > 0:
            return SECOND / median_ns
        elapsed_ns = self.last_ns - self.first_ns
        return (self.count - 1) * SECOND / elapsed_ns if elapsed_ns > 0 else 0.0

    @property
    def jitter_s(self) -> float:
        """How far intervals lie from their median: 1.48 times the median of that, which is sigma where it is Gaussian."""
        if not self.intervals_ns:
            return 0.0
        intervals = np.array(self.intervals_ns)
        return 1.4826 * float(np.median(np.abs(intervals - np.median(intervals)))) / SECOND


class Survey:
    """The streams of one log, and what is known of their senders."""

    def __init__(self, file: LogFile, protocol: str, about: str) -> None:
        self.file, self.protocol, self.about = file, protocol, about
        self.streams: dict[tuple[str, str], Stream] = {}
        self.senders: dict[str, str] = {}  # what a sender says of itself
        self.ids: dict[str, tuple[int, bool]] = {}  # of a CAN stream's name: its id, and whether that has 29 bits

    def add(self, sender: str, name: str, t_ns: int) -> Stream:
        """Add a message."""
        stream = self.streams.get((sender, name))
        if stream is None:
            stream = self.streams[sender, name] = Stream(sender, name)
        stream.add(t_ns)
        return stream

    def add_all(self, sender: str, name: str, t_ns: Sequence[int]) -> None:
        """Add the messages of a stream."""
        for one_ns in t_ns:
            self.add(sender, name, one_ns)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the first message and of the last; 0 if there is none."""
        streams = self.streams.values()
        return min((s.first_ns for s in streams), default=0), max((s.last_ns for s in streams), default=0)

    @property
    def sessions(self) -> int:
        """How many time lines there are: each step back of the stamps begins one."""
        return 1 + max((stream.steps_back for stream in self.streams.values()), default=0)


def survey(path: str | Path) -> Survey:
    """Read a whole log. Raises LogError."""
    file = LogFile(path)
    for kind in LOG_FORMATS:
        if kind.suffix == file.suffix:
            found = Survey(file, "", kind.about)
            module: Any = import_module(f"fusiond_adapters.{kind.reader}")
            module.survey(found)
            if not found.streams:
                raise LogError(f"{path}: no message in it; is it a {kind.about} log?")
            file.bytes_read = file.bytes_total
            return found
    seems = guess(file)
    raise LogError(f"{path}: unknown kind of log{f': {seems}' if seems else ''}")
