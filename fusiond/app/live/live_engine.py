"""The engine live: frames from the inboxes are put into one order, decoded, fused and recorded; ticks are made when due.

Receive stamps increase strictly over all inputs and ticks, by at least a microsecond (the resolution of the logs). A frame
that was overtaken by a tick or by a frame of another input counts as received just after it. So the recorded stamps define
the complete order, and a replay makes the same ticks. The number of moved stamps and the largest move are counted.
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
from fusiond.units import MICROSECOND

MAX_FRAMES = 256  # processed in one step
MOVED_NS = 100 * MICROSECOND  # smaller moves only separate frames that were read together


class FrameInput(Protocol):
    """The part of an input that is used here: see fusiond.ports.inputs.LiveInput."""

    name: str
    file: str
    inbox: Any

    def decode(self, item: Any, t_ns: int) -> list[Any]: ...
    def record(self, item: Any, t_ns: int) -> bytes: ...


class LiveEngine:
    """The engine of a running daemon. `now` reads the clock; `sink` gets every message; `io_health` returns the health of
    inputs and outputs; `record` gets kind of file, stamp and bytes of each frame; `stored_state` is for a hot start."""

    def __init__(
        self,
        config: Config,
        now: Callable[[], int],
        sink: Callable[[Message], None],
        io_health: Callable[[], IoHealth] = IoHealth,
        record: Callable[[str, int, bytes], None] | None = None,
        stored_state: StoredState | None = None,
    ) -> None:
        self.engine = Engine(config, sink, io_health=io_health, stored_state=stored_state)
        self.record = record
        self.moved = self.max_moved_ns = 0  # stamps: number, and largest move
        self.offered = 0  # measurements given to the fusion
        self.to_fusion = RecentLatencies()  # from receipt to the end of the fusion
        self._now = now
        self._last_ns = 0
        self._frames: list[tuple[int, FrameInput, Any]] = []  # received, but not processed yet

    @property
    def next_tick_ns(self) -> int | None:
        """When the next tick is due; None before the first event."""
        return self.engine.next_tick_ns

    def step(self, inputs: Mapping[str, FrameInput], *, give_way: bool = False) -> bool:
        """Process the frames in the inboxes, and make the ticks that are due.

        With `give_way` it returns after a tick of which only the state has been published, so that the state reaches its
        readers before the work on the other messages begins: they are left to `Engine.flush`, and later frames to the next
        step. So are frames beyond the first MAX_FRAMES: the caller gets control back under any load. Returns whether frames
        are left.
        """
        self.engine.flush()
        frames = self._frames
        if len(frames) < MAX_FRAMES:  # the others wait in the inboxes, which are bounded
            frames += [(t_ns, one, item) for one in inputs.values() for t_ns, item in one.inbox.take()]
            frames.sort(key=itemgetter(0))
        for number, (t_ns, one, item) in enumerate(frames):
            if number == MAX_FRAMES or (give_way and self._tick_before(t_ns)):
                self._frames = frames[number:]
                return True
            self._feed_frame(self._ordered(t_ns), one, item)
            if give_way and self.engine.unfinished:  # a tick that waited for this frame
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
        """Make the tick that is due before an instant. Returns whether there is one."""
        due = self.engine.next_tick_ns
        if due is None or due >= t_ns:
            return False
        self._elapse(due)
        return True

    def _elapse(self, t_ns: int) -> None:
        """Make the ticks up to an instant. Every later frame counts as received after it."""
        self.engine.elapse(t_ns)
        self._last_ns = max(self._last_ns, t_ns // MICROSECOND * MICROSECOND)

    def _ordered(self, t_ns: int) -> int:
        """The receive stamp of a frame in the strict order."""
        whole = t_ns // MICROSECOND * MICROSECOND
        if whole <= self._last_ns:
            self.moved += self._last_ns - whole > MOVED_NS
            self.max_moved_ns = max(self.max_moved_ns, self._last_ns - whole)
            whole = self._last_ns + MICROSECOND
        self._last_ns = whole
        return whole

    def _feed_frame(self, t_ns: int, frame_input: FrameInput, item: Any) -> None:
        usable = 0
        for event in frame_input.decode(item, t_ns):
            receipt = self.engine.feed(event)
            if receipt is not None:
                self.offered += 1
                usable += receipt.refusal is not Outcome.INVALID
        if usable:
            self.engine.fusion.history.apply_rows()  # now, so that a tick need not do it
            late_ns = max(0, self._now() - t_ns)
            for _ in range(usable):
                self.to_fusion.add(late_ns)
        if self.record:
            self.record(frame_input.file, t_ns, frame_input.record(item, t_ns))
