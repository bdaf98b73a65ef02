"""The engine: the only way of an event through clock, fusion and publication. Live and replay call the same `feed`.

The caller gives the engine events in order of receipt; live, it also calls `elapse` while no event comes. All messages to
publish are handed to one sink, in order.

Where receipts step back (`fusiond.sessions`), the clock of the host was set back, or another drive follows in the log. The
ticks of the old session are finished, and the fusion begins anew on the new time line. Time since the first event goes on.
Any other receipt that is earlier than the latest counts as simultaneous with it.

Tick k is k periods after the receipt of the first event. It is made after all events received up to it and before any
received later, so its messages depend only on the events and their receive stamps. With `publish.on_imu` a tick waits for
the next inertial sample, for half a period at most, and is made at its receipt: its state is as new as that sample. A tick
has two steps: its state goes to the sink at once; its other messages go with `flush`, or before anything else is done. So
a live run can deliver the state to its readers before the work on the other messages begins, and the messages are the
same whether it does or not.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

from msgspec.structs import replace

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import ImuSample, Received
from fusiond.filter.stored_state import StoredState
from fusiond.messages.from_solution import state_message
from fusiond.messages.outcomes import totals
from fusiond.messages.schedule import RATE_DENOMINATOR, IoHealth, Publication
from fusiond.messages.types import HealthMessage, Message, StateMessage
from fusiond.units import SECOND

MAX_SILENCE_NS = 60 * SECOND  # ticks continue for this long after an event; in a longer gap they are skipped

Sink = Callable[[Message], None]


class StepBack(NamedTuple):
    """The begin of a new session: how long after the first event, and how far the receipts stepped back."""

    since_ns: int
    by_ns: int


class Engine:
    """The fusion of one vehicle, its ticks, and what is published at them.

    `sink` gets every message, or with `only_states` only the states; without a sink there are no ticks. `rate_hz` of the
    ticks is by default the configuration's. `io_health` returns the health of inputs and outputs. `pace` is called with the
    time [ns from the first event] before each tick and each event, and may sleep. `stored_state` is for a hot start.
    Raises StoredStateError if it is not for this configuration.
    """

    def __init__(
        self,
        config: Config,
        sink: Sink | None,
        *,
        rate_hz: float | None = None,
        only_states: bool = False,
        io_health: Callable[[], IoHealth] = IoHealth,
        pace: Callable[[int], None] | None = None,
        stored_state: StoredState | None = None,
    ) -> None:
        self.fusion = Fusion(config, stored=stored_state)
        self.publication = None if sink is None or only_states else Publication(config, self.fusion, io_health)
        self.first_ns: int | None = None  # receipt of the first event
        self.origin_ns = 0  # the first event's instant on the time line of the present session
        self.now_ns = 0  # latest receipt of the session so far
        self.steps_back: list[StepBack] = []
        self.ticks = self.skipped = 0  # made, and skipped in long gaps
        self._vehicle = config.vehicle.name
        self._sink, self._pace = sink, pace
        self._period = SECOND / Fraction(rate_hz or config.publish.rate_hz).limit_denominator(RATE_DENOMINATOR)
        self._wait_ns = int(self._period / 2) if config.publish.on_imu else 0  # how long a tick waits for an inertial sample
        self._imu = self.fusion.params.sources[self.fusion.params.imu_source]
        self._tick = 0  # number of the next tick
        self._prepared: StateMessage | None = None  # its state, if no event comes before it
        self._newest: StateMessage | None = None  # the state of the last tick
        self._last: tuple[int, StateMessage] | None = None  # the last tick, until its other messages are published

    @property
    def elapsed_ns(self) -> int:
        """Time from the first receipt to the latest."""
        return self.now_ns - self.origin_ns

    @property
    def next_tick_ns(self) -> int | None:
        """When the next tick is made, unless an inertial sample triggers it sooner; None before the first event."""
        return None if self.first_ns is None else self.origin_ns + self._since(self._tick) + self._wait_ns

    @property
    def unfinished(self) -> bool:
        """Whether only the state of the last tick has been published yet."""
        return self._last is not None

    # --- Events and time

    def feed(self, event: Received) -> Receipt | None:
        """Advance to an event's receipt, fuse it, and publish what is due. None if the event was for the clock only."""
        if event.t_receive_ns < self.now_ns and self.fusion.clock.steps_back(event):
            self._begin_session(event.t_receive_ns)
        self.advance(event.t_receive_ns)
        receipt = self.fusion.feed(event)
        if receipt is not None:
            if self.publication:
                self.publication.add(event, receipt)
            if self._wait_ns and event.source == self._imu:
                self._make_waiting_tick(event)
        return receipt

    def advance(self, t_receive_ns: int) -> None:
        """Make the ticks before a receipt. A receipt earlier than the latest counts as simultaneous with it."""
        if self.first_ns is None:
            self.first_ns = self.origin_ns = self.now_ns = t_receive_ns
        if t_receive_ns > self.now_ns:
            self._make_ticks_before(t_receive_ns)
            self.now_ns = t_receive_ns
        self._prepared = None
        self.flush()
        if self._pace:
            self._pace(self.elapsed_ns)

    def _begin_session(self, t_receive_ns: int) -> None:
        self.finish()
        by_ns = self.now_ns - t_receive_ns
        self.steps_back.append(StepBack(self.elapsed_ns, by_ns))
        self.origin_ns -= by_ns
        self.now_ns = t_receive_ns
        self.fusion.begin_session()
        if self.publication:
            self.publication.begin_session(t_receive_ns)

    def elapse(self, t_ns: int) -> None:
        """Make the ticks up to an instant, when no earlier event can come any more."""
        if self.first_ns is not None:
            self._make_ticks_before(t_ns + 1)

    def prepare(self) -> None:
        """Make the state of the next tick in advance. If an event comes before the tick, it is made again."""
        due = self.next_tick_ns
        if due is not None and self._prepared is None and due < self.now_ns + MAX_SILENCE_NS:
            self._prepared = self.message(due)

    def flush(self) -> None:
        """Publish the other messages of the last tick."""
        if self._last is not None:
            (since_ns, state), self._last = self._last, None
            if self.publication and self._sink:
                for message in self.publication.after_state(since_ns, state):
                    self._sink(message)

    def finish(self) -> None:
        """Make the ticks up to the last event, with all their messages."""
        self.elapse(self.now_ns)
        self.flush()

    def message(self, t_ns: int) -> StateMessage:
        """The state message of an instant."""
        return state_message(self.fusion.solution_at(t_ns), self._vehicle, totals(self.fusion))

    def health(self, t_ns: int) -> HealthMessage | None:
        """The health at an instant without a tick: before the first event, or while ticks pause."""
        if self.publication is None:
            return None
        state = self._newest or self.message(t_ns)
        since_ns = 0 if self.first_ns is None else t_ns - self.origin_ns
        return self.publication.health(since_ns, replace(state, t_ns=t_ns))

    # --- Ticks

    def _since(self, number: int) -> int:
        """The instant of a tick [ns from the first event]."""
        return number * self._period.numerator // self._period.denominator

    def _make_ticks_before(self, t_ns: int) -> None:
        if self._sink is None:
            return
        until = min(t_ns, self.now_ns + MAX_SILENCE_NS) - self.origin_ns
        while (since := self._since(self._tick) + self._wait_ns) < until:
            self._make_tick(since)
        if self._since(self._tick) + self._wait_ns < t_ns - self.origin_ns:
            before = self.origin_ns + self._wait_ns - t_ns
            following = -(before * self._period.denominator // self._period.numerator)
            self.skipped += following - self._tick
            self._tick, self._prepared = following, None

    def _make_waiting_tick(self, event: Received) -> None:
        """Make the tick that waited for this inertial sample, if one did."""
        if self._sink and isinstance(event.payload, ImuSample) and self._since(self._tick) <= self.elapsed_ns:
            self._make_tick(self.elapsed_ns)

    def _make_tick(self, since_ns: int) -> None:
        """Publish the state of the next tick, at an instant [ns from the first event]."""
        assert self._sink is not None
        self.flush()
        if self._pace:
            self._pace(since_ns)
        state, self._prepared = self._prepared or self.message(self.origin_ns + since_ns), None
        self._last, self._newest = (since_ns, state), state
        self.ticks += 1
        self._tick += 1
        self._sink(state)
