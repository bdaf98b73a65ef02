"""`fusiond top`: its screen, and the command itself, over real Zenoh and on a real terminal."""

from __future__ import annotations

import os
import pty
import re
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread

import msgspec
import pytest

from fusiond.__main__ import UNUSABLE, main
from fusiond.app.top.terminal import COLOURLESS, KEY, KEYS, ansi, can_redraw, codes_for
from fusiond.app.top.view import PARTS, Line, Place, View, page, plain, screen
from fusiond.config.outputs import Zenoh
from fusiond.estimator.solution import Mode
from fusiond.messages.types import EventMessage, HealthMessage, InputHealth, Message, OutputHealth, StateMessage
from fusiond_adapters.zenoh.session import ZenohPublisher, open_session
from tests.helpers.drive import messages, settings
from tests.helpers.network import DEADLINE, free_port

CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def view_of(*published: Message) -> View:
    view = View()
    for message in published:
        view.add(message)
    return view


def texts(lines: list[Line]) -> list[str]:
    return [plain(line) for line in lines]


def until(mode: Mode) -> list[Message]:
    """The messages up to the first health in a mode."""
    published = list(messages())
    last = next(i for i, m in enumerate(published) if isinstance(m, HealthMessage) and m.mode is mode and i > 100)
    return published[: last + 1]


def colour_of(lines: list[Line], text: str) -> str:
    return next(span.colour for line in lines for span in line if text in span.text)


# --- What is shown


def test_state_sources_and_events() -> None:
    published = until(Mode.DEAD_RECKONING)
    state = [message for message in published if isinstance(message, StateMessage)][-1]
    health = published[-1]
    assert state.state is not None and isinstance(health, HealthMessage)
    lines = screen(view_of(*published), 0.0, 200)
    text = "\n".join(texts(lines))
    assert text.startswith("tested  dead reckoning")
    assert f"{state.state.lat_deg:.7f} N" in text and f"{state.state.sigma_yaw_deg:.2f}" in text and " 50 Hz" in text
    for source, found in health.sources.items():
        (row,) = [line for line in texts(lines) if line.startswith(f"{source} ")]
        assert row.split()[3:10] == [str(count) for count in msgspec.structs.astuple(found.outcomes)]
    assert "mode: nominal -> dead_reckoning" in text and "up        0:00:0" in text
    assert colour_of(lines, "dead reckoning") == colour_of(lines, "-> dead_reckoning") == "yellow"


def test_before_anything_has_come() -> None:
    assert texts(screen(View(), 1.0, 80)) == ["no state yet"]
    first = next(message for message in messages() if isinstance(message, StateMessage))
    assert first.state is None
    assert texts(screen(view_of(first), 0.0, 80))[0].startswith("tested  aligning")


def test_silence_faults_and_absent_sources_are_red() -> None:
    health = [message for message in messages() if isinstance(message, HealthMessage)][-1]
    state = [message for message in messages() if isinstance(message, StateMessage)][-1]
    gone = msgspec.structs.replace(health.sources["rear_left"], present=False)
    health = msgspec.structs.replace(health, sources=health.sources | {"rear_left": gone})
    state = msgspec.structs.replace(state, fault="height_m: not finite", state=None, mode=Mode.LOST)
    lines = screen(view_of(state, health), 7.0, 200)
    for text in ("no state for 7 s", "state withheld: height_m: not finite", "nothing received"):
        assert colour_of(lines, text) == "red"


def test_what_should_not_grow_is_yellow_while_it_does() -> None:
    health = [message for message in messages() if isinstance(message, HealthMessage)][-1]

    def rejected(count: int) -> HealthMessage:
        outcomes = msgspec.structs.replace(health.sources["rear_left"].outcomes, rejected=count)
        source = msgspec.structs.replace(health.sources["rear_left"], outcomes=outcomes)
        return msgspec.structs.replace(health, sources={"rear_left": source})

    assert colour_of(screen(view_of(rejected(770), rejected(777)), 0, 200), "777") == "yellow"
    assert colour_of(screen(view_of(rejected(777), rejected(777)), 0, 200), "777") == "plain"


def test_outputs_and_their_losses() -> None:
    health = next(message for message in messages() if isinstance(message, HealthMessage))
    outputs = {"zenoh": OutputHealth(offered=50, dropped=8, counts={}, notes={"session": "1 router connected"})}
    lines = screen(view_of(msgspec.structs.replace(health, outputs=outputs)), 0, 200)
    assert colour_of(lines, "8") == "yellow" and "zenoh" in "\n".join(texts(lines))


@pytest.mark.parametrize(("width", "height"), [(10, 5), (60, 12), (80, 24), (300, 100), (20, 1)])
@pytest.mark.parametrize("part", range(len(PARTS)))
def test_it_fits_any_terminal(width: int, height: int, part: int) -> None:
    lines = page(view_of(*messages()), 0.0, width, height, Place(part))
    assert len(lines) == height and all(len(plain(line)) <= width for line in lines)


def busy() -> View:
    """What a vehicle with inputs, outputs with long notes and many events shows."""
    published = until(Mode.DEAD_RECKONING)
    health = published[-1]
    assert isinstance(health, HealthMessage)
    inputs = {"mavlink.fc": InputHealth(received=5, dropped=0, counts={f"asked for message {n}": n for n in range(1, 9)})}
    notes = {"session": "0 routers, 1 peer, 1 client connected", "error": "a reason that is longer than the line is wide"}
    outputs = {name: OutputHealth(offered=50, dropped=8, counts={}, notes=notes) for name in ("zenoh", "ros2", "mcap")}
    return view_of(*published[:-1], msgspec.structs.replace(health, inputs=inputs, outputs=outputs))


def test_at_80_x_24_the_keys_show_everything() -> None:
    view, place = busy(), Place()
    whole = texts(screen(view, 0.0, 80))
    assert len(whole) > 40 and {"OUTPUT", "EVENTS"} <= {line.split(" ")[0] for line in whole}
    seen: list[str] = []
    for _ in range(3):
        lines = texts(page(view, 0.0, 80, 24, place))
        assert lines[0] == whole[0] and "q quit" in lines[-1]
        seen += [line for line in lines[1:-1] if line not in seen]
        place.press("page down", 21)
    assert {line[:80].rstrip() for line in whole[1:]} <= set(seen)
    place.press("home", 21)
    assert texts(page(view, 0.0, 80, 24, place))[1] == whole[1]
    for part, first in enumerate(("position", "position", "SOURCE", "INPUT", "EVENTS"), 1):
        place.press(str(part), 21)
        lines = texts(page(view, 0.0, 80, 24, place))
        assert lines[1].startswith(first) and len(lines) == 24
        assert "of" in lines[-1] or part != 1
    place.press("tab", 21)
    assert place.part == 0


def test_columns_beyond_the_terminal_are_reached_sideways() -> None:
    view, place = busy(), Place(PARTS.index("sources"))
    assert "jitter ms" not in "\n".join(texts(page(view, 0.0, 80, 24, place)))
    for _ in range(9):
        place.press("right", 21)
        lines = texts(page(view, 0.0, 80, 24, place))
    assert "jitter ms" in lines[1] and lines[0].startswith("tested")
    for _ in range(9):
        place.press("left", 21)
    assert texts(page(view, 0.0, 80, 24, place))[1].startswith("SOURCE")


def test_a_long_text_goes_on_below() -> None:
    lines = texts(screen(busy(), 0.0, 80, "in/out"))
    assert all(len(line) <= 80 for line in lines)
    text = " ".join(" ".join(lines).split())
    assert "asked for message 8 8" in text and "error: a reason that is longer than the line is wide" in text


def test_inputs_are_shown_while_nothing_is_heard() -> None:
    health = next(message for message in messages() if isinstance(message, HealthMessage))
    silent = {"mavlink.fc": InputHealth(received=0, dropped=0, counts={"sessions": 1})}
    lines = screen(view_of(msgspec.structs.replace(health, inputs=silent)), 0.0, 80)
    assert plain(lines[0]) == "tested  nothing heard yet"
    (row,) = [line for line in texts(lines) if line.startswith("mavlink.fc")]
    assert row.split() == ["mavlink.fc", "0", "0", "nothing", "heard", "yet"]
    assert colour_of(lines, "nothing heard yet") == "yellow"


def test_keys_and_terminals() -> None:
    assert [KEYS.get(key, key) for key in KEY.findall("\x1b[B\x1b[6~3\x1bOAjq")] == [
        "down", "page down", "3", "up", "down", "q",
    ]  # fmt: skip
    line = page(busy(), 0.0, 80, 24, Place())[0]
    assert codes_for("1") is COLOURLESS and codes_for("") is codes_for(None) is not COLOURLESS
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]m", ansi(line, COLOURLESS)) and "\x1b[33m" in ansi(line)
    assert [can_redraw(kind) for kind in ("xterm-256color", "dumb", "", None)] == [True, False, False, False]


def test_no_message_controls_the_terminal() -> None:
    event = next(message for message in messages() if isinstance(message, EventMessage))
    lines = screen(view_of(msgspec.structs.replace(event, text="\x1b[2J\x07\n")), 0.0, 80)
    assert plain(lines[-1]).endswith("?[2J??")
    assert ansi(lines[-1]).count("\x1b[") == 2 * len(lines[-1])


# --- The command


@contextmanager
def published(vehicle: str = "tested") -> Iterator[int]:
    """The port of a vehicle that is dead reckoning, published repeatedly over Zenoh."""
    published = until(Mode.DEAD_RECKONING)
    again = [message for message in published if isinstance(message, StateMessage)][-1], published[-1]
    port, stop = free_port(socket.SOCK_STREAM), Event()
    with (
        open_session(Zenoh(listen=[f"tcp/127.0.0.1:{port}"])) as session,
        ZenohPublisher(session, vehicle, "json") as publisher,
    ):

        def publish() -> None:
            while not stop.wait(0.02):
                for message in again:
                    publisher.publish(message)

        thread = Thread(target=publish)
        thread.start()
        try:
            yield port
        finally:
            stop.set()
            thread.join(DEADLINE)


def test_once_prints_a_screen(capsys: pytest.CaptureFixture[str]) -> None:
    assert settings().vehicle.name == "tested"
    with published() as port:
        assert main(["top", "--connect", f"127.0.0.1:{port}", "--once"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("tested  dead reckoning") and "\x1b" not in out and "gps0.position" in out


def test_no_fusiond_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["top", "--connect", f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", "--once"]) == UNUSABLE
    assert "no Zenoh answers there" in capsys.readouterr().err
    port = free_port(socket.SOCK_STREAM)
    with open_session(Zenoh(listen=[f"tcp/127.0.0.1:{port}"])):
        assert main(["top", "--connect", f"tcp/127.0.0.1:{port}"]) == UNUSABLE
    assert "no fusiond is running there" in capsys.readouterr().err


def test_several_vehicles_have_to_be_chosen_from(capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port(socket.SOCK_STREAM)
    with (
        open_session(Zenoh(listen=[f"tcp/127.0.0.1:{port}"])) as session,
        ZenohPublisher(session, "one", "json"),
        ZenohPublisher(session, "two", "json"),
    ):
        assert main(["top", "--connect", f"tcp/127.0.0.1:{port}"]) == UNUSABLE
    assert "choose one by --vehicle: one, two" in capsys.readouterr().err


@contextmanager
def top_in_a_terminal(port: int, **environment: str) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """`fusiond top` on a terminal of 80 x 24: its other end, and the process."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "fusiond", "top", "--connect", f"127.0.0.1:{port}", "--vehicle", "tested"]
    kept = {name: value for name, value in os.environ.items() if name != "NO_COLOR"}
    variables = kept | {"COLUMNS": "80", "LINES": "24", "TERM": "xterm"} | environment
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=subprocess.PIPE, env=variables)
    os.close(theirs)
    try:
        yield ours, process
    finally:
        process.kill()
        process.communicate()
        os.close(ours)


def test_a_terminal_gets_it_redrawn_until_q() -> None:
    with published() as port, top_in_a_terminal(port) as (terminal, process):
        seen = received(terminal, "dead reckoning") + received(terminal, "rear_right")
        os.write(terminal, b"3\x1b[C")
        seen += received(terminal, "\x1b[1m3 sources")
        os.write(terminal, b"q")
        rest = received(terminal, "\x1b[?1049l")  # the terminal's own screen again
        assert process.wait(DEADLINE) == 0
    assert seen.startswith("\x1b[?1049h") and "\x1b[33m" in seen and rest.endswith("\x1b[?25h\x1b[?1049l")
    assert "tested  dead reckoning" in CODES.sub("", seen)


@pytest.mark.parametrize(("variables", "until_text"), [({"NO_COLOR": "1"}, "q quit"), ({"TERM": "dumb"}, "rear_right")])
def test_terminals_without_colours_or_cursor(variables: dict[str, str], until_text: str) -> None:
    with published() as port, top_in_a_terminal(port, **variables) as (terminal, process):
        seen = received(terminal, until_text)
        if "NO_COLOR" in variables:
            assert not re.search(r"\x1b\[[0-9;]*3[0-9]m", seen) and "\x1b[7m" not in seen and "\x1b[1m" in seen
            os.write(terminal, b"q")
            received(terminal, "\x1b[?1049l")
        else:
            assert "\x1b" not in seen
        assert process.wait(DEADLINE) == 0


def received(terminal: int, text: str) -> str:
    """What a terminal is sent until a text is in it."""
    seen, until_s = "", time.monotonic() + DEADLINE
    while text not in seen and time.monotonic() < until_s:
        if select.select([terminal], [], [], 0.2)[0]:
            seen += os.read(terminal, 65536).decode("utf-8", "replace")
    assert text in seen, seen
    return seen
