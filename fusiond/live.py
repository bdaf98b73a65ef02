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

from fusiond.engine import Engine
from fusiond.kernel import Outcome
from fusiond.latency import RecentLatencies
from fusiond.messages import Message, StateMessage
from fusiond.publication import Publication, Surroundings
from fusiond.sections import Config
from fusiond.stored import StoredState

MICROSECOND = 1_000  # ns
MOVED_NS = 100 * MICROSECOND  # less is only to tell apart frames that were read at once

OnMessage = Callable[[Message], None]


class Source(Protocol):
    """Whose frames these are: see fusiond_adapters.inputs.LiveInput."""

    name: str
    file: str
    inbox: Any

    def decode(self, item: Any, t_ns: int) -> list[Any]: ...
    def record(self, item: Any, t_ns: int) -> bytes: ...


class LiveEngine:
    """Engine and inputs of a running daemon. `now` reads the time line; `on_message` takes whatever is to go out;
    `surroundings` tells the health of the shell; `record` takes kind of file, stamp, bytes; `stored` is for a hot start."""

    def __init__(
        self,
        config: Config,
        now: Callable[[], int],
        on_message: OnMessage,
        surroundings: Callable[[], Surroundings] = Surroundings,
        record: Callable[[str, int, bytes], None] | None = None,
        stored: StoredState | None = None,
    ) -> None:
        self.engine = Engine(config, config.publish.rate_hz, self._tick, stored=stored)
        self.publication = Publication(config, self.engine, surroundings)
        self.record = record
        self.moved = self.most_moved_ns = 0  # stamps, see above
        self.offered = 0  # measurements given to the fusion
        self.to_fusion = RecentLatencies()  # from receipt to having been fused
        self.to_publication = RecentLatencies()  # from the instant of a tick to its being handed to the outputs
        self._now, self._on_message = now, on_message
        self._last_ns = 0

    @property
    def next_tick_ns(self) -> int | None:
        """When the next tick is due; None before the first event."""
        return self.engine.next_tick_ns

    def step(self, sources: Mapping[str, Source]) -> None:
        """Take what the inboxes hold, and make the ticks that are due."""
        frames = [(t_ns, source, item) for source in sources.values() for t_ns, item in source.inbox.take()]
        frames.sort(key=itemgetter(0))
        for t_ns, source, item in frames:
            self._take(self._ordered(t_ns), source, item)
        now = self._now()
        due = self.engine.next_tick_ns
        if due is not None and due <= now:
            self.engine.elapse(now)
            self._last_ns = max(self._last_ns, now // MICROSECOND * MICROSECOND)

    def _ordered(self, t_ns: int) -> int:
        """The stamp under which a frame counts as received."""
        whole = t_ns // MICROSECOND * MICROSECOND
        if whole <= self._last_ns:
            self.moved += self._last_ns - whole > MOVED_NS
            self.most_moved_ns = max(self.most_moved_ns, self._last_ns - whole)
            whole = self._last_ns + MICROSECOND
        self._last_ns = whole
        return whole

    def _take(self, t_ns: int, source: Source, item: Any) -> None:
        taken = 0
        for event in source.decode(item, t_ns):
            self.engine.advance(t_ns)
            receipt = self.engine.take(event)
            if receipt is not None:
                self.offered += 1
                self.publication.add(event, receipt)
                taken += receipt.refusal is not Outcome.INVALID
        if taken:
            self.engine.fusion.history.catch_up()  # now, so that a tick finds it done
            late_ns = max(0, self._now() - t_ns)
            for _ in range(taken):
                self.to_fusion.add(late_ns)
        if self.record:
            self.record(source.file, t_ns, source.record(item, t_ns))

    def _tick(self, since_start_ns: int, message: StateMessage) -> None:
        messages = self.publication.at(since_start_ns, message)
        self._on_message(next(messages))  # the state itself, before the work on the others begins
        self.to_publication.add(max(0, self._now() - message.t_ns))
        for other in messages:
            self._on_message(other)
