"""`fusiond fleet`: many vehicles over Zenoh, in a terminal, as lines of alarms, for Prometheus and for Foxglove."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from threading import Event, Thread
from typing import NamedTuple, TextIO

from fusiond.app.client import Client
from fusiond.app.fleet.vehicles import Changes, Fleet, Picture
from fusiond.app.fleet.view import page, screen
from fusiond.app.top.terminal import can_redraw, codes_for, redraw
from fusiond.app.top.view import plain
from fusiond.config.outputs import SITES
from fusiond.errors import OutputError
from fusiond.messages.types import HealthMessage, StateMessage

UNFOLDED = 10_000  # columns
GATHER_S = 2.5  # how long `once` listens: a health message comes each second
LOOK_S = 0.5  # between two looks for alarms and for the map


class Address(NamedTuple):
    """Where to serve."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


@contextmanager
def listening(client: Client) -> Iterator[Fleet]:
    """Inside the block, a fleet of all vehicles that the client hears."""
    fleet = Fleet(time.monotonic)
    with ExitStack() as stack:
        stack.enter_context(client.heard(StateMessage, fleet.hear_state))
        stack.enter_context(client.heard(HealthMessage, fleet.hear_health))
        stack.enter_context(client.presence(fleet.hear_presence))
        yield fleet


def once(fleet: Fleet, out: TextIO) -> None:
    """Listen for a moment, and print everything as text: into a pipe or a file each vehicle as one line."""
    time.sleep(GATHER_S)
    width = shutil.get_terminal_size().columns if out.isatty() else UNFOLDED
    for line in screen(fleet.look(), width):
        out.write(plain(line) + "\n")


def alarms(fleet: Fleet, out: TextIO, stop: Event) -> None:
    """Print a line where an alarm begins or ends, until told to stop."""
    changes = Changes()
    while not stop.wait(LOOK_S):
        for begun, alarm in changes.since(fleet.look()):
            now = datetime.now(UTC)
            what = alarm.urgency if begun else "ended"
            text = "".join(letter if letter.isprintable() else "?" for letter in alarm.text)
            out.write(f"{now:%Y-%m-%dT%H:%M:%SZ} {what:8} {alarm.vehicle} {alarm.kind}: {text}\n")
            out.flush()


def live(fleet: Fleet) -> None:
    """The screen, until `q` is pressed."""
    redraw(
        lambda place, width, height: page(fleet.look(), width, height, place),
        sys.stdin,
        sys.stdout,
        codes_for(os.environ.get("NO_COLOR")),
    )


# --- Servers


@contextmanager
def prometheus(address: Address, look: Callable[[], Picture]) -> Iterator[str]:
    """Inside the block, metrics are served; gives their address. Raises OutputError, ConfigError without the extra."""
    from fusiond.app.fleet.metrics import FleetPage  # noqa: PLC0415
    from fusiond_adapters.prometheus.http import HttpServer  # noqa: PLC0415 - needs the extra `prometheus`
    from fusiond_adapters.prometheus.server import PATH  # noqa: PLC0415

    try:
        server = HttpServer(address.host, address.port, PATH, FleetPage(look).text)
        server.start()
    except OSError as error:
        raise OutputError(f"--prometheus {address}: {error.strerror}") from error
    try:
        yield f"http://{address.host}:{server.port}{PATH}"
    finally:
        server.stop()


@contextmanager
def foxglove(address: Address, look: Callable[[], Picture]) -> Iterator[str]:
    """Inside the block, all vehicles are served on a map; gives the address. Raises OutputError, ConfigError without the
    extra."""
    from fusiond.app.fleet.map import SCHEMAS, FleetMap  # noqa: PLC0415
    from fusiond_adapters.foxglove.server import served, topic  # noqa: PLC0415 - needs the extra `foxglove`

    stop = Event()
    with ExitStack() as stack:
        try:
            context, gate = stack.enter_context(served("fusiond fleet", address.host, address.port, SITES))
        except (OSError, RuntimeError) as error:
            raise OutputError(f"--foxglove {address}: {getattr(error, 'strerror', None) or error}") from error
        topics = {name: topic(context, name, kind, json.dumps(schema).encode()) for name, (kind, schema) in SCHEMAS.items()}
        fleet_map = FleetMap()

        def draw() -> None:
            while not stop.wait(LOOK_S):
                for name, data, now_ns in fleet_map.records(look()):
                    topics[name].log(data, log_time=now_ns)

        thread = Thread(target=draw, name="foxglove")
        thread.start()
        try:
            yield f"ws://{address.host}:{gate.port}"
        finally:
            stop.set()
            thread.join()


def run(
    client: Client,
    *,
    just_once: bool,
    just_alarms: bool,
    prometheus_at: Address | None,
    foxglove_at: Address | None,
) -> None:
    """Run `fusiond fleet`. Raises OutputError, ConfigError."""
    with ExitStack() as stack:
        fleet = stack.enter_context(listening(client))
        for serve, at in ((prometheus, prometheus_at), (foxglove, foxglove_at)):
            if at is not None:
                print(stack.enter_context(serve(at, fleet.look)), file=sys.stderr)
        interactive = sys.stdin.isatty() and sys.stdout.isatty() and can_redraw(os.environ.get("TERM"))
        if just_once:
            once(fleet, sys.stdout)
        elif just_alarms or not interactive:
            alarms(fleet, sys.stdout, Event())
        else:
            live(fleet)
