"""Answers to Zenoh queries: the latest message of every kind, and the state at an instant within the horizon.

They come from published messages that are kept here, never from the filter. `fusiond/<vehicle>/state?t_ns=...` returns
the published state nearest to that instant. A thread answers, for a share of the time: whoever asks too often gets no
reply to some queries, and delays no state.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any

import zenoh

from fusiond.config.schema import Config
from fusiond.messages.codec import encode
from fusiond.messages.keys import key as key_of
from fusiond.messages.types import Message, StateMessage
from fusiond.units import SECOND
from fusiond_adapters.host.budget import Budget
from fusiond_adapters.zenoh.session import CONTENT_TYPES, message_key

MAX_WAITING = 64  # queries; a newer one takes the place of the oldest, which Zenoh ends without a reply


class Answers:
    """Messages kept for queries; written by the output's thread and the estimator's, read by a thread of its own."""

    def __init__(self, config: Config) -> None:
        self.answered = 0  # messages sent as replies
        self._vehicle, self._encoding = config.vehicle.name, config.publish.encoding
        self._period_ns = SECOND / config.publish.rate_hz
        self._horizon_s = config.filter.horizon_s
        self._latest: dict[str, Message] = {}  # by key
        self._states: deque[StateMessage] = deque(maxlen=math.ceil(self._horizon_s * config.publish.rate_hz) + 1)

    def keep(self, message: Message) -> None:
        """Keep a published message."""
        self._latest[message_key(message, self._vehicle)] = message
        if isinstance(message, StateMessage):
            self._states.append(message)

    @contextmanager
    def declared(self, session: zenoh.Session) -> Iterator[None]:
        """Inside the block, answers the queries of a session."""
        waiting: Any = zenoh.handlers.RingChannel(MAX_WAITING)
        queryable: Any = session.declare_queryable(key_of(self._vehicle, "**"), waiting)  # its stub lacks types
        thread = Thread(target=self._serve, args=(queryable.handler,), name="zenoh answers")
        thread.start()
        try:
            yield
        finally:
            queryable.undeclare()
            thread.join()

    def _serve(self, queries: Any) -> None:
        budget = Budget()
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:  # no longer declared
                return
            with query:
                try:
                    self._answer(query, budget)
                except zenoh.ZError:  # who asked has gone
                    continue

    def _answer(self, query: zenoh.Query, budget: Budget) -> None:
        t_ns = query.parameters.get("t_ns")
        if t_ns is not None:
            self._answer_at(query, t_ns)
        else:
            selected = query.key_expr
            for where, message in self._latest.copy().items():  # which is written to meanwhile
                if selected.intersects(where):
                    self._reply(query, where, message)
                    budget.rest()
        budget.rest()

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
        kept = self._states.copy()  # which is written to meanwhile
        nearest = min(kept, key=lambda state: abs(state.t_ns - t_ns), default=None)
        return nearest if nearest is not None and abs(nearest.t_ns - t_ns) <= self._period_ns else None

    def _reply(self, query: zenoh.Query, where: str, message: Message) -> None:
        payload = encode(message, self._encoding)
        query.reply(where, payload, encoding=zenoh.Encoding(CONTENT_TYPES[self._encoding]))
        self.answered += 1
