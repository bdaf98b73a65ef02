"""The engine: events in, and a state message at every tick of receive time. Live and replay are this same code.

Tick k stands k periods after the receipt of the first event. It is made after all events received up to it and before
any received later, so what it tells depends on the events and their receive stamps alone. With `publish.on_imu` it waits
for the first inertial sample from then on, for half a period at the most, and stands at its receipt: its state is as new
as that sample. Whoever drives the engine gives events in order of receipt; live, `elapse` besides lets time pass where no
event comes.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import ImuSample, Received
from fusiond.filter.stored_state import StoredState
from fusiond.messages.outcomes import totals
from fusiond.messages.types import StateMessage, state_message

SECOND = 1_000_000_000  # ns
LONGEST_SILENCE_NS = 60 * SECOND  # ticks go on for so long after an event; a longer hole is passed over
RATE_DENOMINATOR = 1_000_000  # a rate is taken as a fraction with at most this, so that ticks never drift

OnTick = Callable[[int, StateMessage], None]  # time since the first event [ns], message


class Engine:
    """The fusion of one vehicle and its ticks; without `on_tick` there are none.

    `before_tick` is called with the time of a tick [ns from the first event] before it is made, and may sleep. `stored` is
    for a hot start; StoredStateError where it is not for this configuration.
    """

    def __init__(
        self,
        config: Config,
        rate_hz: float,
        on_tick: OnTick | None,
        before_tick: Callable[[int], None] | None = None,
        stored: StoredState | None = None,
    ) -> None:
        self.fusion = Fusion(config, stored=stored)
        self.first_ns: int | None = None  # receipt of the first event
        self.now_ns = 0  # latest receipt so far
        self.rows = self.skipped = 0  # ticks made, and passed over in long silences
        self._vehicle = config.vehicle.name
        self._on_tick, self._before_tick = on_tick, before_tick
        self._period = SECOND / Fraction(rate_hz).limit_denominator(RATE_DENOMINATOR)
        self._wait_ns = int(self._period / 2) if config.publish.on_imu else 0  # of a tick for an inertial sample
        self._imu = self.fusion.plan.sources[self.fusion.plan.imu_source]
        self._tick = 0  # number of the next tick
        self._prepared: StateMessage | None = None  # its message, if nothing comes before it
        self.take: Callable[[Received], Receipt | None] = self.fusion.receive
        """Fuse an event, after `advance` to its receipt. None where it taught the clock only."""

    @property
    def elapsed_ns(self) -> int:
        """How much of the drive has passed, by receipts."""
        return 0 if self.first_ns is None else self.now_ns - self.first_ns

    @property
    def next_tick_ns(self) -> int | None:
        """When the next tick is made, if no inertial sample has it made sooner; None before the first event."""
        return None if self.first_ns is None else self.first_ns + self._since(self._tick) + self._wait_ns

    def advance(self, t_receive_ns: int) -> None:
        """Let time pass up to an event; one received earlier than the one before it counts as received with that."""
        if self.first_ns is None:
            self.first_ns = self.now_ns = t_receive_ns
        if t_receive_ns > self.now_ns:
            if self._on_tick is not None:
                self._publish_before(t_receive_ns)
            self.now_ns = t_receive_ns
        self._prepared = None

    def taken(self, event: Received) -> None:
        """An event has been taken, after `advance` to its receipt: make the tick that waited for it."""
        if not self._wait_ns or self._on_tick is None or event.source != self._imu:
            return
        if isinstance(event.payload, ImuSample) and self._since(self._tick) <= self.elapsed_ns:
            self._make_tick(self.elapsed_ns)

    def elapse(self, t_ns: int) -> None:
        """Make the ticks up to an instant before which no event can come any more."""
        if self.first_ns is not None:
            self._publish_before(t_ns + 1)

    def prepare(self) -> None:
        """Make the next tick's message beforehand. The tick makes it anew where an event comes before it."""
        due = self.next_tick_ns
        if due is not None and self._prepared is None and due < self.now_ns + LONGEST_SILENCE_NS:
            self._prepared = self.message(due)

    def finish(self) -> None:
        """Make the ticks up to the last event."""
        self.elapse(self.now_ns)

    def message(self, t_ns: int) -> StateMessage:
        """What is to be told of an instant."""
        return state_message(self.fusion.estimate_at(t_ns), self._vehicle, totals(self.fusion))

    def _since(self, number: int) -> int:
        """The instant of a tick, from the first event."""
        return number * self._period.numerator // self._period.denominator

    def _publish_before(self, t_ns: int) -> None:
        """Make the ticks that stand before an instant."""
        assert self.first_ns is not None
        if self._on_tick is None:
            return
        until = min(t_ns, self.now_ns + LONGEST_SILENCE_NS) - self.first_ns
        while (since := self._since(self._tick) + self._wait_ns) < until:
            self._make_tick(since)
        if self._since(self._tick) + self._wait_ns < t_ns - self.first_ns:
            before = self.first_ns + self._wait_ns - t_ns
            following = -(before * self._period.denominator // self._period.numerator)
            self.skipped += following - self._tick
            self._tick, self._prepared = following, None

    def _make_tick(self, since_ns: int) -> None:
        """The next tick, at an instant [from the first event]."""
        assert self.first_ns is not None and self._on_tick is not None
        if self._before_tick:
            self._before_tick(since_ns)
        message, self._prepared = self._prepared or self.message(self.first_ns + since_ns), None
        self._on_tick(since_ns, message)
        self.rows += 1
        self._tick += 1
