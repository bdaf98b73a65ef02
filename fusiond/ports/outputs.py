"""What the live outputs have in common: a bounded outbox between the estimator and their threads, and their health.

Each output sends in a thread of its own, so that a consumer that is slow or dead holds up neither the estimator nor
another output. When the outbox of an output is full the oldest message is dropped and counted: what is new is worth more.
An output whose sending never waits may have states handed to it at once instead, without the way through its thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Condition, Event
from typing import Any, Protocol

from fusiond.config.schema import Config
from fusiond.messages.latency import RecentLatencies
from fusiond.messages.types import Message, StateMessage
from fusiond.ports.inputs import LiveInput
from fusiond_adapters.host.clock import HostClock

POLL_S = 0.2  # how long an output's thread waits for messages before it looks whether it is to stop


class OutputLost(Exception):
    """An output ended or cannot be opened; the message says which and why. It is opened again later."""


class Outbox:
    """Messages on their way from the estimator to an output's thread."""

    def __init__(self, size: int, wants: tuple[type[Message], ...]) -> None:
        """`wants` are the kinds of messages that are let in."""
        self.offered = self.dropped = 0
        self.latency = RecentLatencies()  # from the instant of a state to its being taken, or sent at once
        self.at_once: Callable[[StateMessage], bool] | None = None
        """Sends a state in the estimator's thread, and never waits. False: it cannot just now, and the state is queued."""
        self.patience_s = 0.0
        """How long `put` may wait for room before it drops the oldest message; 0 in a live run. With patience nothing is to
        be lost, so `put` queues states too."""
        self._wants = wants
        self._messages: deque[Message] = deque(maxlen=size)
        self._stalled = False  # it waited in vain, and nothing has been taken since
        self._changed = Condition()
        self._now: Callable[[], int] | None = None
        self._on_opened: Callable[[], None] | None = None

    def attend(self, now: Callable[[], int], on_opened: Callable[[], None]) -> None:
        """Before a session: `on_opened` is called in the output's thread when that first takes messages, and so is open;
        from then on latencies are measured by `now`."""
        self._now, self._on_opened = now, on_opened

    def put(self, message: Message, *, may_wait: bool = True) -> None:
        """Leave a message, if it is of a wanted kind. Never waits for the reader without `patience_s`; the reader's own
        thread must not (`may_wait`)."""
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
        """All that was left since the last time, oldest first; waits up to `timeout_s` for the first. Empty after that."""
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
        """Messages that nobody has taken yet."""
        return len(self._messages)

    def _is_full(self) -> bool:
        return len(self._messages) == self._messages.maxlen

    def rouse(self) -> None:
        """Let a waiting `take` return: there is something other than messages to look at, such as a stop."""
        with self._changed:
            self._changed.notify_all()


class LiveOutput(Protocol):
    """One output. `session` runs in a thread of its own, under the daemon's supervisor."""

    name: str
    about: str  # for people
    outbox: Outbox

    def session(self, stop: Event) -> None:
        """Open, send what the outbox gets until told to stop (and then what is left in it), close. Raises OutputLost."""

    def counts(self) -> dict[str, int]:
        """What became of the messages so far."""

    def notes(self) -> dict[str, str]:
        """What the health should tell of it, such as whether the autopilot uses what it is sent."""


@dataclass(frozen=True)
class Around:
    """What an output may build on besides the configuration."""

    clock: HostClock  # the time line of all stamps
    inputs: Mapping[str, LiveInput[Any]]  # by kind and name, such as mavlink.fc: to answer on the link one hears


Factory = Callable[[Config, Around], Sequence[LiveOutput]]  # raises ConfigError, also where an extra is missing
