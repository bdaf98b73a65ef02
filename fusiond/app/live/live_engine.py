"""The engine live: frames from the inboxes, put into one order, decoded, fused, recorded; ticks made when they are due.

One order. Receive stamps ascend strictly, by a microsecond at the least (that is what the logs hold), over all inputs
and ticks: a frame that was overtaken on its way here, by a tick or by a frame of another input, counts as received just
after. So the recording's stamps tell the whole order, and its replay makes the same ticks of it. How many stamps were
moved, and how far, is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import itemgetter
from typing import Any, Protocol

from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.filter.rows import Outcome
from fusiond.filter.stored_state import StoredState
from fusiond.messages import Message
from fusiond.messages.latency import RecentLatencies
from fusiond.messages.schedule import IoHealth

MICROSECOND = 1_000  # ns
MAX_FRAMES = 256  # taken at once
MOVED_NS = 100 * MICROSECOND  # less is only to tell apart frames that were read at once


class Source(Protocol):
    """Whose frames these are: see fusiond.ports.inputs.LiveInput."""

    name: str
    file: str
    inbox: Any

    def decode(self, item: Any, t_ns: int) -> list[Any]: ...
    def record(self, item: Any, t_ns: int) -> bytes: ...


class LiveEngine:
    """Engine and inputs of a running daemon. `now` reads the time line; `sink` takes whatever is to go out;
    `io_health` tells the health of the shell; `record` takes kind of file, stamp, bytes; `stored` is for a hot start."""

    def __init__(
        self,
        config: Config,
        now: Callable[[], int],
        sink: Callable[[Message], None],
        io_health: Callable[[], IoHealth] = IoHealth,
        record: Callable[[str, int, bytes], None] | None = None,
        stored: StoredState | None = None,
    ) -> None:
        self.engine = Engine(config, sink, io_health=io_health, stored=stored)
        self.record = record
        self.moved = self.max_moved_ns = 0  # stamps, see above
        self.offered = 0  # measurements given to the fusion
        self.to_fusion = RecentLatencies()  # from receipt to having been fused
        self._now = now
        self._last_ns = 0
        self._frames: list[tuple[int, Source, Any]] = []  # received, but not taken yet

    @property
    def next_tick_ns(self) -> int | None:
        """When the next tick is due; None before the first event."""
        return self.engine.next_tick_ns

    def step(self, sources: Mapping[str, Source], *, give_way: bool = False) -> bool:
        """Take what the inboxes hold, and make the ticks that are due.

        With `give_way` it ends after a tick of which only the state has gone out, so that this reaches its readers before
        the work on the other messages begins: they are left to `Engine.flush`, and frames received after it to the next
        step. So are frames beyond the first MAX_FRAMES: however great the load, whoever calls this comes round. Returns
        whether frames are left.
        """
        self.engine.flush()
        frames = self._frames
        if len(frames) < MAX_FRAMES:  # the others may wait where they are bounded
            frames += [(t_ns, source, item) for source in sources.values() for t_ns, item in source.inbox.take()]
            frames.sort(key=itemgetter(0))
        for number, (t_ns, source, item) in enumerate(frames):
            if number == MAX_FRAMES or (give_way and self._tick_before(t_ns)):
                self._frames = frames[number:]
                return True
            self._feed_frame(self._ordered(t_ns), source, item)
            if give_way and self.engine.unfinished:  # a tick that has waited for this frame
                self._frames = frames[number + 1 :]
                return True
        self._frames = []
        now, due = self._now(), self.engine.next_tick_ns
        if due is not None and due <= now:
            self._elapse(now)
        if not give_way:
            self.engine.flush()
        return False

    def _tick_before(self, t_ns: int) -> bool:
        """Make the tick that is due before an instant; whether there is one."""
        due = self.engine.next_tick_ns
        if due is None or due >= t_ns:
            return False
        self._elapse(due)
        return True

    def _elapse(self, t_ns: int) -> None:
        """Make the ticks up to an instant; whatever comes now was received after it."""
        self.engine.elapse(t_ns)
        self._last_ns = max(self._last_ns, t_ns // MICROSECOND * MICROSECOND)

    def _ordered(self, t_ns: int) -> int:
        """The stamp under which a frame counts as received."""
        whole = t_ns // MICROSECOND * MICROSECOND
        if whole <= self._last_ns:
            self.moved += self._last_ns - whole > MOVED_NS
            self.max_moved_ns = max(self.max_moved_ns, self._last_ns - whole)
            whole = self._last_ns + MICROSECOND
        self._last_ns = whole
        return whole

    def _feed_frame(self, t_ns: int, source: Source, item: Any) -> None:
        usable = 0
        for event in source.decode(item, t_ns):
            receipt = self.engine.feed(event)
            if receipt is not None:
                self.offered += 1
                usable += receipt.refusal is not Outcome.INVALID
        if usable:
            self.engine.fusion.history.catch_up()  # now, so that a tick finds it done
            late_ns = max(0, self._now() - t_ns)
            for _ in range(usable):
                self.to_fusion.add(late_ns)
        if self.record:
            self.record(source.file, t_ns, source.record(item, t_ns))
