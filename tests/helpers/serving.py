"""A server output in a thread, for the tests of Foxglove and Prometheus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

from fusiond.ports.outputs import OutputLost
from tests.helpers.network import DEADLINE


@contextmanager
def serving(server: Any) -> Iterator[list[OutputLost]]:
    """A session in a thread, and what it raised."""
    stop, opened, lost = Event(), Event(), list[OutputLost]()
    server.outbox.attend(lambda: 0, opened.set)

    def run() -> None:
        try:
            server.session(stop)
        except OutputLost as error:
            lost.append(error)
            opened.set()

    thread = Thread(target=run)
    thread.start()
    try:
        assert opened.wait(DEADLINE)
        yield lost
    finally:
        stop.set()
        server.outbox.rouse()
        thread.join(DEADLINE)
        assert not thread.is_alive()
