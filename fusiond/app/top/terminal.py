"""`fusiond top`: a vehicle's state and health in a terminal, read over Zenoh."""

from __future__ import annotations

import os
import select
import shutil
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TextIO

from fusiond.app.client import Client, ClientError
from fusiond.app.top.view import Colour, Line, View, plain, screen
from fusiond.messages.types import EventMessage, HealthMessage, Message, StateMessage
from fusiond.ports.outputs import Outbox

SHOWN: tuple[type[Message], ...] = (StateMessage, HealthMessage, EventMessage)
MAX_WAITING = 1024  # messages
REDRAW_S = 0.25
FIRST_S = 5.0  # how long `once` waits for a state and a health message
CODES: dict[Colour, str] = {"plain": "0", "dim": "2", "bold": "1", "green": "32", "yellow": "33", "red": "1;31"}
ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"  # the alternate screen without a cursor, and back
HOME, REST_OF_LINE, REST_OF_SCREEN = "\x1b[H", "\x1b[K", "\x1b[J"
QUIT = frozenset("qQ\x03\x04")


class Watch:
    """Receives the messages of one vehicle, inside its block."""

    def __init__(self, client: Client, clock: Callable[[], float] = time.monotonic) -> None:
        self.view = View()
        self._client, self._clock = client, clock
        self._outbox = Outbox(MAX_WAITING, SHOWN)
        self._stack = ExitStack()
        self._last = clock()

    def update(self, timeout_s: float) -> None:
        """Add the messages received, after waiting for one up to `timeout_s`."""
        for message in self._outbox.take(timeout_s):
            self.view.add(message)
            if isinstance(message, StateMessage):
                self._last = self._clock()

    @property
    def silent_s(self) -> float:
        """Time since the last state."""
        return self._clock() - self._last

    def __enter__(self) -> Watch:
        with ExitStack() as stack:
            for kind in SHOWN:
                stack.enter_context(self._client.subscribed(kind, self._outbox.put))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def choose(client: Client) -> str:
    """The only vehicle. Raises ClientError if there is none, or several."""
    found = sorted(client.alive())
    if len(found) == 1:
        return found[0]
    if not found:
        raise ClientError("no fusiond is running there")
    raise ClientError(f"several vehicles are running; choose one by --vehicle: {', '.join(found)}")


def once(watch: Watch, out: TextIO) -> None:
    """Print one screen without colours. Raises ClientError if no state comes."""
    until = time.monotonic() + FIRST_S
    while (watch.view.state is None or watch.view.health is None) and time.monotonic() < until:
        watch.update(REDRAW_S)
    if watch.view.state is None:
        raise ClientError(f"no state for {FIRST_S:g} s")
    width, height = shutil.get_terminal_size((200, 100))
    for line in screen(watch.view, watch.silent_s, width, max(height, 100)):
        out.write(plain(line) + "\n")


def live(watch: Watch, keys: TextIO, out: TextIO) -> None:
    """Redraw until `q` is pressed."""
    with _raw(keys), _screen(out):
        while not _pressed(keys) & QUIT:
            width, height = shutil.get_terminal_size()
            lines = screen(watch.view, watch.silent_s, width, height - 1)
            out.write(HOME + "".join(ansi(line) + REST_OF_LINE + "\n" for line in lines) + REST_OF_SCREEN)
            out.flush()
            watch.update(0)
            select.select([keys], [], [], REDRAW_S)


def ansi(line: Line) -> str:
    """A line with the terminal's codes for its colours."""
    return "".join(f"\x1b[{CODES[span.colour]}m{span.text}\x1b[0m" for span in line)


def _pressed(keys: TextIO) -> set[str]:
    ready, _, _ = select.select([keys], [], [], 0)
    return set(os.read(keys.fileno(), 64).decode("ascii", "replace") or "q") if ready else set()


@contextmanager
def _raw(keys: TextIO) -> Iterator[None]:
    """Read single keys without echo; Ctrl-C works as usual."""
    before = termios.tcgetattr(keys)
    tty.setcbreak(keys)
    try:
        yield
    finally:
        termios.tcsetattr(keys, termios.TCSADRAIN, before)


@contextmanager
def _screen(out: TextIO) -> Iterator[None]:
    out.write(ENTER)
    try:
        yield
    finally:
        out.write(LEAVE)
        out.flush()


def run(endpoint: str, vehicle: str | None, config_file: str | None, *, just_once: bool) -> None:
    """Run `fusiond top`. Raises ClientError."""
    if vehicle is None:
        with Client(endpoint, "*", config_file=config_file) as client:
            vehicle = choose(client)
    with Client(endpoint, vehicle, config_file=config_file) as client, Watch(client) as watch:
        if just_once or not (sys.stdin.isatty() and sys.stdout.isatty()):
            once(watch, sys.stdout)
        else:
            live(watch, sys.stdin, sys.stdout)
