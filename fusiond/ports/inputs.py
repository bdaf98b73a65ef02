"""What the live inputs have in common: a bounded inbox between their threads and the engine, and their health.

Each input is read in a thread of its own, so that a receipt is stamped when it happens and no input can hold up
another. When the inbox of an input is full it is thinned: every third frame of the kinds that come most often is
dropped, and counted. So an estimator that cannot keep up still has every instant of them all, and whatever comes seldom.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from threading import Event, Lock
from typing import Generic, Protocol, TypeVar

from fusiond.config.schema import Config
from fusiond.events import Received
from fusiond.ports.clock import Clock

Item = TypeVar("Item")
THIN = 3  # a full inbox loses one in so many: gaps of two, four, eight would make a rolling counter stand still
POLL_S = 0.2  # how long a thread waits for input before it looks whether it is to stop


class InputLost(Exception):
    """An input ended or cannot be opened; the message says which and why. It is opened again later."""


class Inbox(Generic[Item]):
    """Stamped frames on their way from an input's thread to the engine, at most `size`. `wake` is called when an empty
    one fills; `kind` tells frames apart that tell different things."""

    def __init__(self, size: int, wake: Callable[[], None], kind: Callable[[Item], Hashable]) -> None:
        self.received = self.dropped = 0
        self.missed = 0  # frames that were lost before they came here, as far as the input can tell
        self._items: list[tuple[int, Item]] = []
        self._size, self._wake, self._kind = size, wake, kind
        self._lock = Lock()

    def put(self, t_ns: int, item: Item) -> None:
        """Leave a frame, received at `t_ns`."""
        with self._lock:
            was_empty = not self._items
            self.received += 1
            if len(self._items) == self._size:
                self._thin()
            self._items.append((t_ns, item))
        if was_empty:
            self._wake()

    def take(self) -> list[tuple[int, Item]]:
        """All that was left since the last time, oldest first."""
        with self._lock:
            items, self._items = self._items, []
        return items

    def _thin(self) -> None:
        """Of each kind that is there more often than the mean drop every third frame, but none that came later after the
        one before than they do on average: what is left lies evenly. Of kinds without number drop the oldest."""
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


@dataclass(frozen=True)
class Receiver:
    """What an input works for: the part of the daemon that takes its frames."""

    clock: Clock  # stamps the receipts
    wake: Callable[[], None]  # called when an empty inbox fills
    is_alive: Callable[[], bool]  # whether the estimator works: an input answers its peer only then


