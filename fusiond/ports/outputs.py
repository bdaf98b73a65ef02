"""The interface of live outputs, and the bounded outbox between the estimator and an output's thread.

Each output sends in a thread of its own: a slow or dead reader delays neither the estimator nor another output. When an
outbox is full, the oldest message is dropped and counted. An output that never blocks can send states directly in the
estimator's thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Condition, Event
from typing import Any, Protocol

from fusiond.messages.latency import RecentLatencies
from fusiond.messages.types import Message, StateMessage
from fusiond.ports.clock import Clock
from fusiond.ports.inputs import LiveInput

POLL_S = 0.2  # an output's thread checks at least this often whether it should stop


class OutputLost(Exception):
    """An output ended or cannot be opened; the message says which and why. It is opened again later."""


class Outbox:
    """Messages on their way from the estimator to an output's thread."""

    def __init__(self, size: int, wants: tuple[type[Message], ...]) -> None:
        """`wants` are the kinds of messages that it accepts."""
        self.offered = self.dropped = 0
        self.latency = RecentLatencies()  # from the instant of a state until it is taken or sent directly
        self.at_once: Callable[[StateMessage], bool] | None = None
        """Sends a state in the estimator's thread without waiting. False: it could not, and the state is queued."""
        self.patience_s = 0.0
        """How long `put` may wait for room before it drops the oldest message; 0 in a live run. If it is not 0, `put` queues
        states too, so that none is lost."""
        self._wants = wants
        self._messages: deque[Message] = deque(maxlen=size)
        self._stalled = False  # `put` waited in vain, and nothing has been taken since
        self._changed = Condition()
        self._now: Callable[[], int] | None = None
        self._on_opened: Callable[[], None] | None = None

    def attend(self, now: Callable[[], int], on_opened: Callable[[], None]) -> None:
        """Prepare a session: `on_opened` is called in the output's thread when it first takes messages, that is when it is
        open. Latencies are measured by `now`."""
        self._now, self._on_opened = now, on_opened

    def put(self, message: Message, *, may_wait: bool = True) -> None:
        """Add a message of a kind that it accepts. Without `patience_s` it never waits for the reader. The reader's own
        thread must not wait: `may_wait` is False there."""
        if not isinstance(message, self._wants):
            return
        with self._changed:
            self.offered += 1
        if type(message) is StateMessage and not self.patience_s and (send := self.at_once) and send(message):
            if self._now:
                self.latency.add(max(0, self._now() - message.t_ns))
            return
        with self._changed:
            if may_wait and self.patience_s and self._is_full() and not self._stalled:
                self._stalled = not self._changed.wait_for(lambda: not self._is_full(), self.patience_s)
            self.dropped += self._is_full()
            self._messages.append(message)
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[Message]:
        """Remove and return all messages, oldest first, after waiting up to `timeout_s` for one; empty if none came."""
        if self._on_opened:
            on_opened, self._on_opened = self._on_opened, None
            on_opened()
        with self._changed:
            if not self._messages:
                self._changed.wait(timeout_s)
            messages = list(self._messages)
            self._messages.clear()
            self._stalled = False
            self._changed.notify_all()
        if self._now:
            now = self._now()
            for message in messages:
                if type(message) is StateMessage:
                    self.latency.add(max(0, now - message.t_ns))
        return messages

    @property
    def waiting(self) -> int:
        """Number of messages not taken yet."""
        return len(self._messages)

    def _is_full(self) -> bool:
        return len(self._messages) == self._messages.maxlen

    def rouse(self) -> None:
        """Make a waiting `take` return, for example because the output should stop."""
        with self._changed:
            self._changed.notify_all()


class LiveOutput(Protocol):
    """One output. `session` runs in a thread of its own, under the daemon's supervisor."""

    name: str
    about: str  # description for users
    outbox: Outbox

    def session(self, stop: Event) -> None:
        """Open, send messages until `stop` is set and the outbox is empty, close. Raises OutputLost."""

    def counts(self) -> dict[str, int]:
        """Counts of messages by outcome."""

    def notes(self) -> dict[str, str]:
        """Notes for the health, such as whether the autopilot uses the state."""


@dataclass(slots=True)
class KeptFrame:
    """What is kept from run to run of the local frame that positions are sent in. Its output replaces the values, and any
    thread may read them."""

    origin: tuple[float, float, float] | None = None  # latitude, longitude [deg], height [m]; none: not chosen yet
    reset_counter: int | None = None  # the newest; none: there was none yet


@dataclass(frozen=True)
class OutputContext:
    """What an output can use in addition to the configuration."""

    clock: Clock  # the time line of all stamps
    inputs: Mapping[str, LiveInput[Any]]  # by section and name, such as mavlink.fc: to send over a link that is already open
    frame: KeptFrame = field(default_factory=KeptFrame)  # of the last run, and for the next


