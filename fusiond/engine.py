"""The engine: the only way of an event through clock, fusion and publication. Live and replay call the same `feed`.

Whoever drives the engine gives it events in order of receipt; live, `elapse` also lets time pass where no event comes.
All that is to be published is handed to one sink, in order.

Tick k stands k periods after the receipt of the first event. It is made after all events received up to it and before
any received later, so what it tells depends on the events and their receive stamps alone. With `publish.on_imu` it waits
for the first inertial sample from then on, for half a period at the most, and stands at its receipt: its state is as new
as that sample. A tick has two steps: its state goes to the sink at once; the rest goes with `flush`, or by itself before
anything else is done. So a live run can let the state reach its readers before the work on the rest begins, and the
messages are the same whether it does or not.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import ImuSample, Received
from fusiond.filter.stored_state import StoredState
from fusiond.messages.from_solution import state_message
from fusiond.messages.outcomes import totals
from fusiond.messages.schedule import RATE_DENOMINATOR, IoHealth, Publication
from fusiond.messages.types import Message, StateMessage

SECOND = 1_000_000_000  # ns
MAX_SILENCE_NS = 60 * SECOND  # ticks go on for this long after an event; a longer hole is passed over

Sink = Callable[[Message], None]


class Engine:
    """The fusion of one vehicle, its ticks, and what is published at them.

    `sink` takes every message, of all kinds or, with `only_states`, the states alone; without a sink there are no ticks.
    `rate_hz` of the ticks is by default the configuration's. `io_health` tells what the health says of the shell.
    `pace` is called with the time [ns from the first event] before each tick and each event, and may sleep. `stored` is for
    a hot start; StoredStateError where it is not for this configuration.
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
        stored: StoredState | None = None,
    ) -> None:
        self.fusion = Fusion(config, stored=stored)
        self.publication = None if sink is None or only_states else Publication(config, self.fusion, io_health)
        self.first_ns: int | None = None  # receipt of the first event
        self.now_ns = 0  # latest receipt so far
        self.ticks = self.skipped = 0  # made, and passed over in long silences
        self._vehicle = config.vehicle.name
        self._sink, self._pace = sink, pace
        self._period = SECOND / Fraction(rate_hz or config.publish.rate_hz).limit_denominator(RATE_DENOMINATOR)
        self._wait_ns = int(self._period / 2) if config.publish.on_imu else 0  # of a tick for an inertial sample
        self._imu = self.fusion.plan.sources[self.fusion.plan.imu_source]
        self._tick = 0  # number of the next tick
        self._prepared: StateMessage | None = None  # its message, if nothing comes before it
        self._last: tuple[int, StateMessage] | None = None  # time and state of the last tick, until its rest has gone out

    @property
    def elapsed_ns(self) -> int:
        """How much of the drive has passed, by receipts."""
        return 0 if self.first_ns is None else self.now_ns - self.first_ns

    @property
    def next_tick_ns(self) -> int | None:
        """When the next tick is made, if no inertial sample has it made sooner; None before the first event."""
        return None if self.first_ns is None else self.first_ns + self._since(self._tick) + self._wait_ns

    @property
    def unfinished(self) -> bool:
        """Whether only the state of the last tick has gone out yet."""
        return self._last is not None

    # --- What drives it

    def feed(self, event: Received) -> Receipt | None:
        """Let time pass up to an event's receipt, fuse it, and publish what is due. None where it taught the clock only."""
        self.advance(event.t_receive_ns)
        receipt = self.fusion.receive(event)
        if receipt is not None:
            if self.publication:
                self.publication.add(event, receipt)
            if self._wait_ns and event.source == self._imu:
                self._make_tick_that_waited(event)
        return receipt

    def advance(self, t_receive_ns: int) -> None:
        """Let time pass up to a receipt; one that is earlier than the one before it counts as received with that."""
        if self.first_ns is None:
            self.first_ns = self.now_ns = t_receive_ns
        if t_receive_ns > self.now_ns:
            self._make_ticks_before(t_receive_ns)
            self.now_ns = t_receive_ns
        self._prepared = None
        self.flush()
        if self._pace:
            self._pace(self.elapsed_ns)

    def elapse(self, t_ns: int) -> None:
        """Make the ticks up to an instant before which no event can come any more."""
        if self.first_ns is not None:
            self._make_ticks_before(t_ns + 1)

    def prepare(self) -> None:
        """Make the next tick's state beforehand. The tick makes it anew where an event comes before it."""
        due = self.next_tick_ns
        if due is not None and self._prepared is None and due < self.now_ns + MAX_SILENCE_NS:
            self._prepared = self.message(due)

    def flush(self) -> None:
        """Publish what is due besides the state at the last tick."""
        if self._last is not None:
            (since_ns, state), self._last = self._last, None
            if self.publication and self._sink:
                for message in self.publication.after_state(since_ns, state):
                    self._sink(message)

    def finish(self) -> None:
        """Make the ticks up to the last event, whole."""
        self.elapse(self.now_ns)
        self.flush()

    def message(self, t_ns: int) -> StateMessage:
        """The state at an instant."""
        return state_message(self.fusion.estimate_at(t_ns), self._vehicle, totals(self.fusion))

    # --- Ticks

    def _since(self, number: int) -> int:
        """The instant of a tick, from the first event."""
        return number * self._period.numerator // self._period.denominator

    def _make_ticks_before(self, t_ns: int) -> None:
        assert self.first_ns is not None
        if self._sink is None:
            return
        until = min(t_ns, self.now_ns + MAX_SILENCE_NS) - self.first_ns
        while (since := self._since(self._tick) + self._wait_ns) < until:
            self._make_tick(since)
        if self._since(self._tick) + self._wait_ns < t_ns - self.first_ns:
            before = self.first_ns + self._wait_ns - t_ns
            following = -(before * self._period.denominator // self._period.numerator)
            self.skipped += following - self._tick
            self._tick, self._prepared = following, None

    def _make_tick_that_waited(self, event: Received) -> None:
        """For an inertial sample, which has come now."""
        if self._sink and isinstance(event.payload, ImuSample) and self._since(self._tick) <= self.elapsed_ns:
            self._make_tick(self.elapsed_ns)

    def _make_tick(self, since_ns: int) -> None:
        """The next tick, at an instant [from the first event]: its state."""
        assert self.first_ns is not None and self._sink is not None
        self.flush()
        if self._pace:
            self._pace(since_ns)
        state, self._prepared = self._prepared or self.message(self.first_ns + since_ns), None
        self._last = since_ns, state
        self.ticks += 1
        self._tick += 1
        self._sink(state)
