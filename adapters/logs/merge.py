"""Several logs of one drive merged into one stream of `Received` events, in the order of receipt."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import chain, islice
from pathlib import Path
from typing import TypeVar

from msgspec.structs import replace

from fusiond.config.schema import Config
from fusiond.events import Received
from fusiond.sessions import Receipts
from fusiond.units import SECOND
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading
from fusiond_adapters.logs.guess import guess
from fusiond_adapters.registry import INPUTS, LOG_FORMATS

READ_AHEAD = 512  # events
REACH_NS = 60 * SECOND  # the logs of one host step back within this of each other, but for longer holes in them

Item = TypeVar("Item")
_Frame = tuple[int, bool, list[Received]]  # latest stamp so far; whether it begins a session; the events
_Head = tuple[int, int, list[Received]]  # stamp and number of the log that the events are next in


def open_logs(paths: Sequence[str | Path], config: Config) -> LogSet:
    """Prepare the logs of one drive for reading. Only their sizes are read yet.

    The suffix of a path gives the format. A .tlog belongs to the first [mavlink.NAME]; a CAN log may contain any [can.NAME],
    distinguished by channel (see `can_channels`). `LINK=path` or `BUS=path` names the link or bus.
    Raises LogError for a path that is not a log, ConfigError for a configuration that does not fit its DBC files.
    """
    if not paths:
        raise LogError("no log given")
    sequences: dict[str, int] = {}
    return LogSet([_open(str(path), config, sequences) for path in paths])


class LogSet:
    """The logs of one drive; iterating, once, yields their events merged by `t_receive_ns`.

    Each log keeps its own order. If its stamps run back, an event counts as received with the latest one before it: nothing
    is lost, and no other log is delayed. Equal stamps are in the order in which the logs were given.
    Where those of one source step back (`fusiond.sessions`), a new session begins. All logs enter it together, after all of
    the old one: each at its own step if that is near, else where it is, for then another host's clock has stamped it. A lone
    stamp behind counts as the latest before it.
    Iterating raises LogError if a file is not a log.
    """

    def __init__(self, logs: Sequence[_Log]) -> None:
        self._logs = logs
        self._begun = False

    def __iter__(self) -> Iterator[Received]:
        if self._begun:
            raise RuntimeError("a LogSet is read once")
        self._begun = True
        return _ahead(chain.from_iterable(self._merged()))

    def _merged(self) -> Iterator[list[Received]]:
        """The events of each frame, session by session."""
        logs = self._logs
        heads = [(frame[0], number, frame[2]) for number, log in enumerate(logs) if (frame := log.next_frame())]
        while heads:
            heapq.heapify(heads)
            following: list[_Head] = []  # those of the next session
            while heads:
                t_ns, number, events = heads[0]
                yield events
                frame = logs[number].next_frame()
                if frame is None:
                    heapq.heappop(heads)
                elif not frame[1]:
                    heapq.heapreplace(heads, (frame[0], number, frame[2]))
                else:
                    heapq.heappop(heads)
                    if not following:
                        heads, following = self._divided(heads, t_ns)
                    following.append((frame[0], number, frame[2]))
            heads = following

    def _divided(self, heads: list[_Head], t_ns: int) -> tuple[list[_Head], list[_Head]]:
        """When a log has stepped back after a stamp: as a heap the heads of the logs that still belong to the session, as
        they end or step back soon; and the other heads, which enter the next session."""
        own = [head for head in heads if self._logs[head[1]].ends_session_before(t_ns + REACH_NS)]
        others = [head for head in heads if head not in own]
        heapq.heapify(own)
        return own, others

    @property
    def bytes_total(self) -> int:
        """Size of all files on disk."""
        return sum(log.file.bytes_total for log in self._logs)

    @property
    def bytes_read(self) -> int:
        """How much of `bytes_total` has been read."""
        return sum(log.file.bytes_read for log in self._logs)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Counts of the content by log, without zeros."""
        return {str(log.file.path): log.counts() for log in self._logs}

    @property
    def protocols(self) -> frozenset[str]:
        """The sections of the configuration whose logs were given, such as mavlink."""
        return frozenset(log.protocol for log in self._logs)

    @property
    def apart_s(self) -> float:
        """By how much the MAVLink and the CAN logs miss each other [s]; 0 if they overlap, or there are none of a kind."""
        read = [log for log in self._logs if log.first_ns is not None]
        gaps = [
            max(link.first_ns or 0, bus.first_ns or 0) - min(link.last_ns, bus.last_ns)
            for link in read
            for bus in read
            if (link.protocol, bus.protocol) == ("mavlink", "can")
        ]
        return max(0, min(gaps, default=0)) / SECOND

    @property
    def warnings(self) -> list[str]:
        """Warnings about the logs, complete once they are read."""
        found = [warning for log in self._logs for warning in log.file.warnings]
        empty = [log for log in self._logs if log.is_empty]
        found += [f"{log.file.path}: nothing in it that the configuration asks for" for log in empty]
        links = [log for log in self._logs if log.first_ns is not None and log.protocol == "mavlink"]
        buses = [log for log in self._logs if log.first_ns is not None and log.protocol == "can"]
        if self.apart_s:
            spans = "; ".join(log.span() for log in (*links, *buses))
            found.append(f"the MAVLink and the CAN logs do not overlap in time: {spans}")
        return found


def _ahead(items: Iterator[Item]) -> Iterator[Item]:
    """The same items, read READ_AHEAD at a time. Reading and fusing many events in turn is faster by a sixth: code and
    data stay in the processor's caches."""
    while some := list(islice(items, READ_AHEAD)):
        yield from some


class _Log:
    """One log, its decoders, and the stamps seen in it."""

    def __init__(self, file: LogFile, reading: Reading) -> None:
        self.file = file
        self.protocol = reading.protocol
        self.first_ns: int | None = None
        self.last_ns = 0
        self.is_empty = False  # read to its end without an event
        self._reading = reading
        self._placed = self._place()
        self._ahead: deque[_Frame] = deque()  # read, but not taken

    def next_frame(self) -> _Frame | None:
        """The next frame; None at the end."""
        return self._ahead.popleft() if self._ahead else next(self._placed, None)

    def ends_session_before(self, until_ns: int) -> bool:
        """Whether the log ends or steps back before a stamp. It is read up to there."""
        for frame in chain(tuple(self._ahead), self._read_ahead()):
            if frame[1]:
                return True
            if frame[0] > until_ns:
                return False
        return True

    def _read_ahead(self) -> Iterator[_Frame]:
        for frame in self._placed:
            self._ahead.append(frame)
            yield frame

    def _place(self) -> Iterator[_Frame]:
        """Every frame with events. One that alone steps back counts as received with the latest one before it."""
        frames = filter(None, self._reading.frames)
        events = next(frames, None)
        self.is_empty = events is None
        if events is None:
            self.file.bytes_read = self.file.bytes_total
            return
        latest_ns = self.first_ns = self.last_ns = events[0].t_receive_ns
        receipts = Receipts()
        while events is not None:
            t_ns, following, steps_back = events[0].t_receive_ns, next(frames, None), False
            if t_ns >= latest_ns:
                latest_ns = t_ns
            elif not receipts.steps_back(events[0].source, t_ns):
                self.first_ns = min(self.first_ns, t_ns)
                self.file.counts["stamps run back"] += len(events)
            elif following is None or _is_nearer(following[0].t_receive_ns, latest_ns, t_ns):
                self.file.counts["stamps run back"] += len(events)
                events = [replace(event, t_receive_ns=latest_ns) for event in events]
            else:
                steps_back = True
                self.file.counts["steps back"] += 1
                receipts.clear()
                self.first_ns, self.last_ns = min(self.first_ns, t_ns), max(self.last_ns, latest_ns)
                latest_ns = t_ns
            for event in events:
                receipts.add(event.source, event.t_receive_ns)
            yield latest_ns, steps_back, events
            events = following
        self.last_ns = max(self.last_ns, latest_ns)
        self.file.bytes_read = self.file.bytes_total

    def counts(self) -> dict[str, int]:
        total = self.file.counts.copy()
        for decoder in self._reading.decoders:
            total.update(decoder.counts)
        return {name: count for name, count in total.items() if count}

    def span(self) -> str:
        first, last = (_readable(t_ns) for t_ns in (self.first_ns or 0, self.last_ns))
        return f"{self.file.path} from {first} to {last}"


def _is_nearer(t_ns: int, this_ns: int, that_ns: int) -> bool:
    return abs(t_ns - this_ns) < abs(t_ns - that_ns)


def _readable(t_ns: int) -> str:
    seconds = t_ns // SECOND
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _open(argument: str, config: Config, sequences: dict[str, int]) -> _Log:
    name, path = _split(argument, config)
    file = LogFile(path)
    for kind in LOG_FORMATS:
        if kind.suffix == file.suffix:
            return _Log(file, kind.open(Opening(file, kind.about, name, config, sequences)))
    seems = guess(file)
    raise LogError(f"{path}: unknown kind of log{f': {seems}' if seems else ''}; known: {_known()}")


def _known() -> str:
    known = ", ".join(f"{kind.suffix} ({kind.about})" for kind in LOG_FORMATS)
    return f"{known}; all also with .gz or .zst"


def _split(argument: str, config: Config) -> tuple[str | None, str]:
    """`NAME=path` into its parts; a `=` that does not follow the name of a link or bus is part of the path."""
    name, equals, path = argument.partition("=")
    known = [configured for section in INPUTS for configured in getattr(config, section)]
    if equals and name in known:
        return name, path
    if equals and name.isidentifier() and not Path(argument).exists():
        raise LogError(f"{argument}: there is no link or bus '{name}'; configured: {', '.join(known) or 'none'}")
    return None, argument
