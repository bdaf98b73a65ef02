"""What the live inputs have in common: a bounded inbox between their threads and the engine, and their health.

Each input is read in a thread of its own, so that a receipt is stamped when it happens and no input can hold up
another. When the inbox of an input is full the oldest frame is dropped and counted: what is new is worth more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Event, Lock
from typing import Generic, Protocol, TypeVar

from fusiond.measurements import Received
from fusiond.sections import Config

Item = TypeVar("Item")
POLL_S = 0.2  # how long a thread waits for input before it looks whether it is to stop


class InputLost(Exception):
    """An input ended or cannot be opened; the message says which and why. It is opened again later."""


class Inbox(Generic[Item]):
    """Stamped frames on their way from an input's thread to the engine. `wake` is called when an empty one fills."""

    def __init__(self, size: int, wake: Callable[[], None]) -> None:
        self.received = self.dropped = 0
        self.missed = 0  # frames that were lost before they came here, as far as the input can tell
        self._items: deque[tuple[int, Item]] = deque(maxlen=size)
        self._wake = wake
        self._lock = Lock()

    def put(self, t_ns: int, item: Item) -> None:
        """Leave a frame, received at `t_ns`."""
        with self._lock:
            was_empty = not self._items
            self.received += 1
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append((t_ns, item))
        if was_empty:
            self._wake()

    def take(self) -> list[tuple[int, Item]]:
        """All that was left since the last time, oldest first."""
        with self._lock:
            items = list(self._items)
            self._items.clear()
        return items


class LiveInput(Protocol[Item]):
    """One link or bus. `prepare` and `session` run in a thread; `decode` and `record` are called by the engine."""

    name: str
    about: str  # for people
    file: str  # the log that a frame belongs to: the name of a file without its date
    inbox: Inbox[Item]

    def configure(self, config: Config) -> None:
        """Take what may change while running, for the sessions to come. Raises ConfigError."""

    def prepare(self) -> None:
        """Load what takes long to load. Once, before the first session. Raises ConfigError."""

    def session(self, stop: Event) -> None:
        """Open, read into the inbox until told to stop, close. Raises InputLost."""

    def decode(self, item: Item, t_ns: int) -> list[Received]:
        """The events in a frame."""

    def record(self, item: Item, t_ns: int) -> bytes:
        """A frame as it stands in its log."""

    def counts(self) -> dict[str, int]:
        """What became of the frames so far."""
