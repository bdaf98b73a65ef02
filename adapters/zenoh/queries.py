"""Answers to Zenoh queries: the latest message of every kind, and the state at an instant within the horizon.

They come from published messages that are kept here, never from the filter. `fusiond/<vehicle>/state?t_ns=...` returns
the published state nearest to that instant.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import zenoh

from fusiond.config.schema import Config
from fusiond.messages.codec import encode
from fusiond.messages.keys import key as key_of
from fusiond.messages.types import Message, StateMessage
from fusiond.units import SECOND
from fusiond_adapters.zenoh.session import CONTENT_TYPES, message_key


class Answers:
    """Messages kept for queries; written by the output's thread, read by Zenoh's."""

    def __init__(self, config: Config) -> None:
        self.answered = 0
        self._vehicle, self._encoding = config.vehicle.name, config.publish.encoding
        self._period_ns = SECOND / config.publish.rate_hz
        self._horizon_s = config.filter.horizon_s
        self._latest: dict[str, Message] = {}  # by key
        self._states: deque[StateMessage] = deque(maxlen=math.ceil(self._horizon_s * config.publish.rate_hz) + 1)
        self._lock = Lock()

    def keep(self, message: Message) -> None:
        """Keep a published message."""
        where = message_key(message, self._vehicle)
        with self._lock:
            self._latest[where] = message
            if isinstance(message, StateMessage):
                self._states.append(message)

    @contextmanager
    def declared(self, session: zenoh.Session) -> Iterator[None]:
        """Inside the block, answers the queries of a session."""
        with session.declare_queryable(key_of(self._vehicle, "**"), self._answer):
            yield

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            selected = query.key_expr
            t_ns = query.parameters.get("t_ns")
            if t_ns is not None:
                self._answer_at(query, t_ns)
                return
            with self._lock:
                found = {where: message for where, message in self._latest.items() if selected.intersects(where)}
            for where, message in found.items():
                self._reply(query, where, message)

    def _answer_at(self, query: zenoh.Query, asked: str) -> None:
        where = key_of(self._vehicle, "state")
        if not query.key_expr.intersects(where):
            query.reply_err(f"t_ns is for {where} only")
        elif not (asked.isascii() and asked.isdigit()):
            query.reply_err(f"t_ns is a whole number of nanoseconds, not '{asked}'")
        elif (state := self.state_at(int(asked))) is None:
            query.reply_err(f"t_ns={asked}: no state was published about then, or that was over {self._horizon_s:g} s ago")
        else:
            self._reply(query, where, state)

    def state_at(self, t_ns: int) -> StateMessage | None:
        """The published state nearest to an instant; None if it is more than a period away."""
        with self._lock:
            nearest = min(self._states, key=lambda state: abs(state.t_ns - t_ns), default=None)
        return nearest if nearest is not None and abs(nearest.t_ns - t_ns) <= self._period_ns else None

    def _reply(self, query: zenoh.Query, where: str, message: Message) -> None:
        payload = encode(message, self._encoding)
        query.reply(where, payload, encoding=zenoh.Encoding(CONTENT_TYPES[self._encoding]))
        self.answered += 1
