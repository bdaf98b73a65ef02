"""A Zenoh output with a session on loopback, for the tests of the client and the adapter."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Literal

from fusiond.app.client import Client
from fusiond.config.outputs import Encoding, Publish, Zenoh
from fusiond.config.schema import Config, Vehicle
from fusiond.messages.types import EventMessage, Message
from fusiond.ports.outputs import OutputLost
from fusiond_adapters.zenoh.output import ZenohOutput
from tests.helpers.network import DEADLINE


def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def settings(where: str, encoding: Encoding = "json", mode: Literal["peer", "router"] = "peer") -> Config:
    section = Zenoh(mode=mode, listen=[where])
    return Config(vehicle=Vehicle(name="rover"), zenoh=section, publish=Publish(encoding=encoding, rate_hz=50.0))


@contextmanager
def publishing(config: Config, *first: Message) -> Iterator[ZenohOutput]:
    """The output as the daemon runs it, with some messages published."""
    output, stop, opened, ends = ZenohOutput(config), Event(), Event(), []

    def session() -> None:
        try:
            output.session(stop)
        except OutputLost as lost:
            ends.append(lost)

    output.outbox.attend(lambda: 0, opened.set)
    thread = Thread(target=session)
    thread.start()
    try:
        assert opened.wait(DEADLINE)
        for message in first:
            output.outbox.put(message)
        yield output
    finally:
        stop.set()
        output.outbox.rouse()
        thread.join(DEADLINE)
    assert not ends


def event(text: str) -> EventMessage:
    return EventMessage(vehicle="rover", t_ns=1, kind="mode", severity="info", subject="", text=text)


def sees(client: Client, vehicle: str) -> bool:
    """Whether a client sees that a vehicle is alive within 10 s: what was declared a moment ago takes its way."""
    ends = time.monotonic() + 10.0
    while client.alive() != {vehicle} and time.monotonic() < ends:
        time.sleep(0.05)
    return client.alive() == {vehicle}
