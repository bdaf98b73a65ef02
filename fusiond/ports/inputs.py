"""The interface of live inputs, and the bounded inbox between an input's thread and the engine.

Each input is read in a thread of its own: receipts are stamped when they happen, and no input can delay another. A full
inbox is thinned: every third frame of the most frequent kinds is dropped and counted. An estimator that cannot keep up
still gets frames of every kind, evenly spaced, and all frames of the rare kinds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from threading import Event, Lock
from typing import Generic, Protocol, Self, TypeVar

from fusiond.events import Received
from fusiond.ports.clock import Clock

Item = TypeVar("Item")
THIN = 3  # a full inbox drops every third frame; with every second, a rolling counter would seem to stop
POLL_S = 0.2  # a thread checks at least this often whether it should stop


class InputLost(Exception):
    """An input ended or cannot be opened; the message says which and why. It is opened again later."""


class Inbox(Generic[Item]):
    """Stamped frames on their way from an input's thread to the engine, at most `size`. `wake` is called when a frame
    comes into an empty inbox; `kind` returns the kind of a frame, such as its message id."""

    def __init__(self, size: int, wake: Callable[[], None], kind: Callable[[Item], Hashable]) -> None:
        self.received = self.dropped = 0
        self.missed = 0  # frames lost before they reached the inbox, as far as the input knows
        self._items: list[tuple[int, Item]] = []
        self._size, self._wake, self._kind = size, wake, kind
        self._lock = Lock()

    def put(self, t_ns: int, item: Item) -> None:
        """Add a frame received at `t_ns`."""
        with self._lock:
            was_empty = not self._items
            self.received += 1
            if len(self._items) == self._size:
                self._thin()
            self._items.append((t_ns, item))
        if was_empty:
            self._wake()

    def take(self) -> list[tuple[int, Item]]:
        """Remove and return all frames, oldest first."""
        with self._lock:
            items, self._items = self._items, []
        return items

    def _thin(self) -> None:
        """Drop every third frame of each kind that is more frequent than the mean. A frame after a longer gap than usual is
        kept, so the rest is evenly spaced. If there are too many kinds, drop the oldest third."""
        kinds = [self._kind(item) for _, item in self._items]
        stamps: dict[Hashable, list[int]] = {}
        for (t_ns, _), kind in zip(self._items, kinds, strict=True):
            stamps.setdefault(kind, []).append(t_ns)
        mean = len(kinds) / len(stamps)
        spacing = {
            kind: (all_ns[-1] - all_ns[0]) / max(1, len(all_ns) - 1)
            for kind, all_ns in stamps.items()
            if len(all_ns) >= mean
        }
        close: Counter[Hashable] = Counter()
        last: dict[Hashable, int] = {}
        kept = []
        for entry, kind in zip(self._items, kinds, strict=True):
            if kind in spacing and entry[0] - last.get(kind, entry[0]) <= spacing[kind]:
                close[kind] += 1
                if close[kind] % THIN == 0:
                    continue
            last[kind] = entry[0]
            kept.append(entry)
        if len(kept) == self._size:
            del kept[: self._size // THIN]
        self.dropped += self._size - len(kept)
        self._items = kept


class LiveInput(Protocol[Item]):
    """One link or bus. `prepare` and `session` run in a thread; `decode` and `record` are called by the engine."""

    name: str
    about: str  # description for users
    file: str  # name of the log of its frames, without the date
    inbox: Inbox[Item]

    def adopt(self, fresh: Self) -> None:
        """Use from the next session what a reload may change, of an input made and prepared with a new configuration. Cannot
        fail."""

    def prepare(self) -> None:
        """Load what is slow to load, once, before the first session. Raises ConfigError."""

    def session(self, stop: Event) -> None:
        """Open, read into the inbox until `stop` is set, close. Raises InputLost."""

    def decode(self, item: Item, t_ns: int) -> list[Received]:
        """The events in a frame."""

    def record(self, item: Item, t_ns: int) -> bytes:
        """The bytes of a frame for its log."""

    def counts(self) -> dict[str, int]:
        """Counts of frames by outcome."""


@dataclass(frozen=True)
class InputContext:
    """What an input needs of the daemon."""

    clock: Clock  # stamps the receipts
    wake: Callable[[], None]  # called when a frame comes into an empty inbox
    is_alive: Callable[[], bool]  # whether the estimator works: heartbeats are sent only then


