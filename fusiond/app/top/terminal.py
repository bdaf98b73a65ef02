"""`fusiond top`: a vehicle's state and health in a terminal, read over Zenoh."""

from __future__ import annotations

import os
import re
import select
import shutil
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TextIO

from fusiond.app.client import Client, ClientError
from fusiond.app.top.view import Colour, Line, Place, View, page, plain, screen
from fusiond.messages.types import EventMessage, HealthMessage, Message, StateMessage
from fusiond.ports.outputs import Outbox

SHOWN: tuple[type[Message], ...] = (StateMessage, HealthMessage, EventMessage)
MAX_WAITING = 1024  # messages
REDRAW_S = 0.25
FIRST_S = 5.0  # how long `once` waits for a state and a health message
CODES: dict[Colour, str] = {"plain": "0", "dim": "2", "bold": "1", "green": "32", "yellow": "33", "red": "1;31"}
COLOURLESS: dict[Colour, str] = {"plain": "0", "dim": "0", "bold": "1", "green": "0", "yellow": "1", "red": "7"}  # NO_COLOR
ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"  # the alternate screen without a cursor, and back
HOME, REST_OF_LINE, REST_OF_SCREEN = "\x1b[H", "\x1b[K", "\x1b[J"
QUIT = frozenset("qQ\x03\x04")
KEYS = {  # what terminals send for a key, and its name
    "\x1b[A": "up", "\x1bOA": "up", "k": "up", "\x1b[B": "down", "\x1bOB": "down", "j": "down",
    "\x1b[C": "right", "\x1bOC": "right", "l": "right", "\x1b[D": "left", "\x1bOD": "left", "h": "left",
    "\x1b[5~": "page up", "b": "page up", "\x1b[6~": "page down", " ": "page down",
    "\x1b[H": "home", "\x1bOH": "home", "\x1b[1~": "home", "g": "home",
    "\x1b[F": "end", "\x1bOF": "end", "\x1b[4~": "end", "G": "end", "\t": "tab",
}  # fmt: skip
KEY = re.compile(r"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Za-z]|[^\x1b]")


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
    def complete(self) -> bool:
        """Whether there is all that a screen shows, without the events. While nothing is heard there is no state."""
        health = self.view.health
        waits = health is not None and bool(health.inputs) and not any(one.received for one in health.inputs.values())
        return health is not None and (self.view.state is not None or waits)

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
    """Print everything as text. Raises ClientError if nothing comes."""
    until = time.monotonic() + FIRST_S
    while not watch.complete and time.monotonic() < until:
        watch.update(REDRAW_S)
    if watch.view.state is None and watch.view.health is None:
        raise ClientError(f"neither a state nor a health message for {FIRST_S:g} s")
    width, _ = shutil.get_terminal_size((200, 100))
    for line in screen(watch.view, watch.silent_s, width):
        out.write(plain(line) + "\n")


def live(watch: Watch, keys: TextIO, out: TextIO, codes: Mapping[Colour, str] = CODES) -> None:
    """Redraw until `q` is pressed; other keys choose what is shown."""

    def drawn(place: Place, width: int, height: int) -> list[Line]:
        watch.update(0)
        return page(watch.view, watch.silent_s, width, height, place)

    redraw(drawn, keys, out, codes)


def redraw(
    drawn: Callable[[Place, int, int], list[Line]], keys: TextIO, out: TextIO, codes: Mapping[Colour, str] = CODES
) -> None:
    """Draw a screen, for a place, width and height, until `q` is pressed; other keys move the place."""
    place, pressed = Place(), list[str]()
    with _raw(keys), _screen(out):
        while not QUIT.intersection(pressed):
            width, height = shutil.get_terminal_size()
            for key in pressed:
                place.press(KEYS.get(key, key), max(1, height - 3))
            lines = drawn(place, width, height)
            out.write(HOME + "\n".join(ansi(line, codes) + REST_OF_LINE for line in lines) + REST_OF_SCREEN)
            out.flush()
            select.select([keys], [], [], REDRAW_S)
            pressed = _pressed(keys)


def ansi(line: Line, codes: Mapping[Colour, str] = CODES) -> str:
    """A line with the terminal's codes for its colours."""
    return "".join(f"\x1b[{codes[span.colour]}m{span.text}\x1b[0m" for span in line)


def _pressed(keys: TextIO) -> list[str]:
    """The keys pressed, as the terminal sent them; `q` when it has gone."""
    ready, _, _ = select.select([keys], [], [], 0)
    return KEY.findall(os.read(keys.fileno(), 64).decode("ascii", "replace") or "q") if ready else []


def can_redraw(terminal: str | None) -> bool:
    """Whether a terminal of this kind ($TERM) can place a cursor."""
    return terminal not in (None, "", "dumb")


def codes_for(no_color: str | None) -> Mapping[Colour, str]:
    """The codes to use with this value of $NO_COLOR: any but the empty one turns colours off (no-color.org)."""
    return COLOURLESS if no_color else CODES


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
    interactive = sys.stdin.isatty() and sys.stdout.isatty() and can_redraw(os.environ.get("TERM"))
    with Client(endpoint, vehicle, config_file=config_file) as client, Watch(client) as watch:
        if just_once or not interactive:
            once(watch, sys.stdout)
        else:
            live(watch, sys.stdin, sys.stdout, codes_for(os.environ.get("NO_COLOR")))
