"""A census of a .tlog: the messages of each sender with their rates, whatever the configuration asks for."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from fusiond.config.toml import ConfigError
from fusiond.events import Received
from fusiond.units import SECOND
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.tlog import read_tlog
from fusiond_adapters.mavlink.decoder import HEADER_1, MAGIC_2, SENDER_1, SENDER_2, Dialect

MANY = "all"  # the dialect with the messages of nearly all others


class Sent(NamedTuple):
    """A message that a sender sent."""

    system: int
    component: int
    message: str  # its name, or its number where the dialect does not know it
    messages: int
    rate_hz: float  # on average, from its first to its last


class _Counting:
    """Stands in for a decoder, and only counts."""

    def __init__(self, dialect: Dialect) -> None:
        self.dialect = dialect
        self.found: dict[tuple[int, int, int], list[int]] = {}  # system, component, number: count, first, last [ns]

    def decode(self, frame: bytes, t_receive_ns: int) -> list[Received]:
        if len(frame) < HEADER_1:
            return []
        if frame[0] == MAGIC_2:
            counter, system, component, low, high = SENDER_2.unpack_from(frame, 4)
            return self.decode_by_header(low | high << 16, counter, system, component, frame, t_receive_ns)
        counter, system, component, number = SENDER_1.unpack_from(frame, 2)
        return self.decode_by_header(number, counter, system, component, frame, t_receive_ns)

    def decode_by_header(
        self, number: int, _counter: int, system: int, component: int, _frame: bytes, t_receive_ns: int
    ) -> list[Received]:
        found = self.found.setdefault((system, component, number), [0, t_receive_ns, t_receive_ns])
        found[0] += 1
        found[2] = t_receive_ns
        return []


def census(path: str | Path) -> list[Sent]:
    """The messages of a .tlog, by sender, the most frequent first; none of a file that cannot be read."""
    try:
        dialect = Dialect(MANY)
        counting = _Counting(dialect)
        for _ in read_tlog(LogFile(path), counting):
            pass
    except (LogError, ConfigError):
        return []
    sent = []
    for (system, component, number), (count, first_ns, last_ns) in counting.found.items():
        seconds = (last_ns - first_ns) / SECOND
        rate_hz = (count - 1) / seconds if seconds > 0 else 0.0
        sent.append(Sent(system, component, dialect.name_of(number), count, rate_hz))
    return sorted(sent, key=lambda one: (-one.messages, one))
