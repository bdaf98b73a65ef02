"""What the live outputs have in common: a bounded outbox between the estimator and their threads, and their health.

Each output sends in a thread of its own, so that a consumer that is slow or dead holds up neither the estimator nor
another output. When the outbox of an output is full the oldest message is dropped and counted: what is new is worth more.
"""

from __future__ import annotations

from collections import deque
from threading import Condition, Event
from typing import Protocol

from fusiond.messages import Message


class OutputLost(Exception):
    """An output ended or cannot be opened; the message says which and why. It is opened again later."""


class Outbox:
    """Messages on their way from the estimator to an output's thread."""

    def __init__(self, size: int, wants: tuple[type[Message], ...]) -> None:
        """`wants` are the kinds of messages that are let in."""
        self.offered = self.dropped = 0
        self._wants = wants
        self._messages: deque[Message] = deque(maxlen=size)
        self._filled = Condition()

    def put(self, message: Message) -> None:
        """Leave a message, if it is of a wanted kind. Never waits for the reader."""
        if not isinstance(message, self._wants):
            return
        with self._filled:
            self.offered += 1
            self.dropped += len(self._messages) == self._messages.maxlen
            self._messages.append(message)
            self._filled.notify()

    def take(self, timeout_s: float) -> list[Message]:
        """All that was left since the last time, oldest first; waits up to `timeout_s` for the first. Empty after that."""
        with self._filled:
            if not self._messages:
                self._filled.wait(timeout_s)
            messages = list(self._messages)
            self._messages.clear()
        return messages

    def rouse(self) -> None:
        """Let a waiting `take` return: there is something other than messages to look at, such as a stop."""
        with self._filled:
            self._filled.notify_all()


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
