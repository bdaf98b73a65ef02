"""The screen of `fusiond top`: the latest messages of one vehicle as lines of coloured text, for a terminal or a picture."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from textwrap import wrap
from typing import Literal, NamedTuple

from fusiond.estimator.solution import Mode
from fusiond.messages.types import (
    EventMessage,
    HealthMessage,
    Message,
    OutcomeCounts,
    OutputHealth,
    Quantiles,
    Severity,
    SourceHealth,
    State,
    StateMessage,
)
from fusiond.units import MILLISECOND, SECOND

SILENT_S = 2.0  # a longer time without a state is shown
EVENTS = 100  # kept
FEW_EVENTS = 12  # shown beside everything else
STATES = 100  # over which the rate of the states is measured

Colour = Literal["plain", "dim", "bold", "green", "yellow", "red"]
MODES: dict[Mode, Colour] = {
    Mode.ALIGNING: "yellow", Mode.NOMINAL: "green", Mode.DEAD_RECKONING: "yellow", Mode.LOST: "red",
}  # fmt: skip
SEVERITIES: dict[Severity, Colour] = {"info": "plain", "notice": "plain", "warning": "yellow", "critical": "red"}
OUTCOMES = {  # column headings by field
    "fused": "fused", "rejected": "rejected", "too_old": "too old", "duplicate": "dupl", "invalid": "invalid",
    "waiting": "waiting", "gathered": "gathered",
}  # fmt: skip
BAD_OUTCOMES = frozenset({"rejected", "too_old", "invalid"})
PARTS = ("all", "state", "sources", "in/out", "events")  # what can be shown, by the keys 1, 2, ...
INDENT, LEAST_TEXT = 4, 20  # columns: of a text that continues below its line, and the narrowest such text
SIDEWAYS = 16  # columns that a key scrolls


class Span(NamedTuple):
    """Text in one colour."""

    text: str
    colour: Colour = "plain"


Line = tuple[Span, ...]


class View:
    """The latest messages of one vehicle."""

    def __init__(self) -> None:
        self.state: StateMessage | None = None
        self.health: HealthMessage | None = None
        self.before: HealthMessage | None = None  # the previous health
        self.events: deque[EventMessage] = deque(maxlen=EVENTS)
        self._stamps: deque[int] = deque(maxlen=STATES)

    def add(self, message: Message) -> None:
        """Add a message of any kind."""
        if isinstance(message, StateMessage):
            self.state = message
            self._stamps.append(message.t_ns)
        elif isinstance(message, HealthMessage):
            self.before, self.health = self.health, message
        elif isinstance(message, EventMessage):
            self.events.append(message)

    @property
    def rate_hz(self) -> float | None:
        """States per second, by their stamps."""
        stamps = self._stamps
        span_ns = stamps[-1] - stamps[0] if stamps else 0
        return (len(stamps) - 1) * SECOND / span_ns if span_ns > 0 else None


@dataclass
class Place:
    """What of the screen a terminal shows: a part, and how far it is scrolled."""

    part: int = 0  # of PARTS
    top: int = 0  # lines above the terminal
    left: int = 0  # columns left of it

    def press(self, key: str, page: int) -> None:
        """Move by a key's name; `page` is the number of lines that are scrolled."""
        if key.isdigit() and 1 <= int(key) <= len(PARTS):
            self.part, self.top, self.left = int(key) - 1, 0, 0
        elif key == "tab":
            self.part, self.top, self.left = (self.part + 1) % len(PARTS), 0, 0
        elif key in ("left", "right"):
            self.left = max(0, self.left + (SIDEWAYS if key == "right" else -SIDEWAYS))
        else:
            far = {"up": -1, "down": 1, "page up": -page, "page down": page, "home": -self.top, "end": self.top + 10**6}
            self.top = max(0, self.top + far.get(key, 0))


def screen(view: View, silent_s: float, width: int, part: str = PARTS[0]) -> list[Line]:
    """All lines of a part; `silent_s` is the time since the last state. A text that is too long for the width goes on
    below, but numbers do not."""
    return [printable(line) for line in (_title(view, silent_s), *_lines(view, width, part))]


def page(view: View, silent_s: float, width: int, height: int, place: Place) -> list[Line]:
    """What a terminal of this size shows: the first line, what fits of the others, and the keys. `place` is kept inside."""
    title, *lines = screen(view, silent_s, width, PARTS[place.part])
    return scrolled(title, lines, width, height, place, lambda room: _keys(place, len(lines), room))


def scrolled(
    title: Line, lines: Sequence[Line], width: int, height: int, place: Place, keys: Callable[[int], Line]
) -> list[Line]:
    """A title, what fits of the lines, and below them what `keys` says of so many shown. `place` is kept inside."""
    room = max(0, height - 2)
    place.top = min(place.top, max(0, len(lines) - room))
    place.left = min(place.left, max(0, max(map(length, lines), default=0) - width))
    shown = [from_column(line, place.left) for line in lines[place.top : place.top + room]]
    shown += [()] * (room - len(shown))
    return [cut(line, width) for line in (title, *shown, keys(room))[: max(1, height)]]


def _keys(place: Place, lines: int, room: int) -> Line:
    """The last line: the parts with their keys, and where in the lines the terminal is."""
    parts = [Span(f"{number} {part}  ", "bold" if number == place.part + 1 else "dim")
             for number, part in enumerate(PARTS, 1)]  # fmt: skip
    last = min(lines, place.top + room)
    where = f"arrows: {place.top + 1}-{last} of {lines} lines" if lines > room else "arrows"
    return (*parts, Span("q quit  ", "dim"), Span(where, "bold" if last < lines else "dim"))


def plain(line: Line) -> str:
    """A line without its colours."""
    return "".join(span.text for span in line).rstrip()


def length(line: Line) -> int:
    """Characters of a line."""
    return sum(len(span.text) for span in line)


def printable(line: Line) -> Line:
    """A line without control characters: no text of a message may control the terminal."""
    return tuple(
        Span("".join(letter if letter.isprintable() else "?" for letter in span.text), span.colour) for span in line
    )


def cut(line: Line, width: int) -> Line:
    """The first so many columns of a line."""
    kept = []
    for span in line:
        kept.append(Span(span.text[: max(0, width)], span.colour))
        width -= len(span.text)
    return tuple(span for span in kept if span.text)


def from_column(line: Line, column: int) -> Line:
    """A line without its first so many columns."""
    rest = []
    for span in line:
        rest.append(Span(span.text[max(0, column) :], span.colour))
        column -= len(span.text)
    return tuple(span for span in rest if span.text)


def _title(view: View, silent_s: float) -> Line:
    if view.state is not None:
        return tuple(_first(view.state, view.rate_hz, silent_s))
    if view.health is None:
        return (Span("no state yet", "yellow"),)
    heard = any(one.received for one in view.health.inputs.values())
    return Span(f"{view.health.vehicle}  ", "bold"), Span("no state yet" if heard else "nothing heard yet", "yellow")


def _lines(view: View, width: int, part: str) -> Iterator[Line]:
    """Below the first line."""
    everything = part == PARTS[0]
    if everything or part == "state":
        if view.state is not None:
            yield from _state(view.state)
        if view.health is not None:
            yield from _running(view.health)
    if view.health is not None:
        if everything or part == "sources":
            yield from _spaced(_sources(view.health, view.before, width), everything)
        if everything or part == "in/out":
            yield from _spaced(_inputs(view.health, width), everything)
            yield from _spaced(_outputs(view.health, width), bool(view.health.inputs))
    if view.events and (everything or part == "events"):
        yield from _spaced(_events(islice(reversed(view.events), FEW_EVENTS if everything else None), width), everything)


def _spaced(lines: Iterable[Line], apart: bool) -> Iterator[Line]:
    """Lines, if there are any below an empty one."""
    for number, line in enumerate(lines):
        if apart and not number:
            yield ()
        yield line


def _events(events: Iterable[EventMessage], width: int) -> Iterator[Line]:
    yield (Span("EVENTS", "bold"),)
    for event in events:
        yield from _folded((Span(f"{_clock(event.t_ns)}  ", "dim"),), Span(event.text, SEVERITIES[event.severity]), width)


def _folded(line: Line, text: Span, width: int) -> Iterator[Line]:
    """A line that ends with a text; where the text does not fit, it goes on below."""
    if length(line) + len(text.text.rstrip()) <= width:
        yield (*line, text)
        return
    room = max(LEAST_TEXT, width - INDENT)
    first, *rest = wrap(text.text, max(1, width - length(line))) if width - length(line) >= LEAST_TEXT else ["", text.text]
    yield (*line, Span(first, text.colour))
    yield from ((Span(" " * INDENT), Span(row, text.colour)) for row in wrap(" ".join(rest), room))


# --- The state


def _first(message: StateMessage, rate_hz: float | None, silent_s: float) -> Iterator[Span]:
    silent = silent_s >= SILENT_S
    yield Span(f"{message.vehicle}  ", "bold")
    yield Span(message.mode.value.replace("_", " "), "dim" if silent else MODES[message.mode])
    if silent:
        yield Span(f"  no state for {silent_s:.0f} s", "red")
    yield Span(f"  {_clock(message.t_ns)} UTC", "dim")
    if rate_hz:
        yield Span(f"  {rate_hz:.0f} Hz")
    yield Span(f"  resets {message.resets}", "yellow" if message.resets else "plain")


def _state(message: StateMessage) -> Iterator[Line]:
    if message.fault:
        yield (Span(f"state withheld: {message.fault}", "red"),)
    if message.state is not None:
        yield from _motion(message.state)
    if message.age_ms is not None:
        yield _pair("IMU age", f"{message.age_ms:.1f} ms")


def _motion(state: State) -> Iterator[Line]:
    north, east, down = state.velocity_ned_mps
    latitude, longitude = compass(state.lat_deg, "NS"), compass(state.lon_deg, "EW")
    sigma_n, sigma_e, sigma_d = state.sigma_position_ned_m
    yield _pair("position", f"{latitude}  {longitude}  {state.height_m:.2f} m")
    yield _pair("  sigma", f"north {sigma_n:.2f}  east {sigma_e:.2f}  down {sigma_d:.2f} m")
    speed, course = math.hypot(north, east), math.degrees(math.atan2(east, north)) % 360
    over_ground = f"{speed:.2f} +- {state.sigma_velocity_mps:.2f} m/s  course {course:.1f} deg"
    yield _pair("velocity", f"{over_ground}  down {down:.2f} m/s")
    yaw = f"yaw {state.yaw_deg % 360:.2f} +- {state.sigma_yaw_deg:.2f}"
    yield _pair("attitude", f"{yaw}  roll {state.roll_deg:.2f}  pitch {state.pitch_deg:.2f} deg")
    gyro = math.degrees(max(state.sigma_gyro_bias_rps))
    scale = f"wheel scale {100 * state.wheel_scale:+.2f} +- {100 * state.sigma_wheel_scale:.2f} %"
    yield _pair("sensors", f"{scale}  gyro bias +- {gyro:.4f} deg/s")


def _pair(name: str, text: str) -> Line:
    return Span(f"{name:10}", "dim"), Span(text)


def compass(degrees: float, letters: str) -> str:
    """A latitude or longitude with one of two letters for its sign."""
    return f"{abs(degrees):.7f} {letters[degrees < 0]}"


def _clock(t_ns: int) -> str:
    return f"{datetime.fromtimestamp(t_ns // SECOND, UTC):%H:%M:%S}.{t_ns % SECOND // (100 * MILLISECOND)}"


# --- The health


def _running(health: HealthMessage) -> Iterator[Line]:
    latency = health.latency_ms
    stages = [("fused", latency.fused), ("published", latency.published)]
    text = "  ".join(f"{name} {_quantiles(quantiles)}" for name, quantiles in stages if quantiles)
    if text:
        yield _pair("latency", f"{text} ms (p50 p99 max)")
    yield _pair("up", f"{_duration(health.uptime_s)}  fusiond {health.version}")
    if health.reset_reason:
        yield _pair("reset", health.reset_reason)


def _sources(health: HealthMessage, before: HealthMessage | None, width: int) -> Iterator[Line]:
    old = before.sources if before else {}
    rows = [_source(name, source, old.get(name)) for name, source in health.sources.items()]
    yield from table(("SOURCE", "rate Hz", "age ms", *OUTCOMES.values(), "ratio", "NIS", "jitter ms", ""), rows, width)


def _inputs(health: HealthMessage, width: int) -> Iterator[Line]:
    if health.inputs:
        rows = [
            (
                Span(name),
                Span(str(one.received), "plain" if one.received else "yellow"),
                _alarm(one.dropped),
                Span(_counts(one.counts) if one.received else "nothing heard yet", "dim" if one.received else "yellow"),
            )
            for name, one in health.inputs.items()
        ]
        yield from table(("INPUT", "received", "dropped", ""), rows, width)


def _outputs(health: HealthMessage, width: int) -> Iterator[Line]:
    if health.outputs:
        rows = [_output(name, one) for name, one in health.outputs.items()]
        yield from table(("OUTPUT", "offered", "dropped", "p50 p99 max ms", ""), rows, width)


def _source(name: str, source: SourceHealth, before: SourceHealth | None) -> Sequence[Span]:
    present: Colour = "plain" if source.present else "red"
    old = before.outcomes if before else source.outcomes
    ratio = source.test_ratio
    jitter = None if source.clock is None else source.clock.jitter_ms
    degraded = source.status not in (None, "nominal")
    text = " ".join(filter(None, (source.status if degraded else "", source.reason)))
    return (
        Span(name, present),
        Span(f"{source.rate_hz:.1f}", present),
        Span(_number(source.age_ms, 0), present),
        *(_outcome(outcome, source.outcomes, old) for outcome in OUTCOMES),
        Span(_number(ratio, 2), "yellow" if ratio is not None and ratio > 1 else "plain"),
        Span(_number(source.nis_mean, 2)),
        Span(_number(jitter, 2)),
        Span("nothing received" if not source.present else text, "red" if not source.present else "yellow"),
    )


def _outcome(name: str, counts: OutcomeCounts, before: OutcomeCounts) -> Span:
    """A count; yellow if it is of a bad outcome and has grown."""
    count = getattr(counts, name)
    grows = name in BAD_OUTCOMES and count > getattr(before, name)
    return Span(str(count), "yellow" if grows else "plain" if count else "dim")


def _output(name: str, output: OutputHealth) -> Sequence[Span]:
    notes = "  ".join(f"{key}: {text}" for key, text in output.notes.items())
    latency = _quantiles(output.latency_ms) if output.latency_ms else "-"
    return Span(name), Span(str(output.offered)), _alarm(output.dropped), Span(latency), Span(notes, "dim")


def _alarm(count: int) -> Span:
    return Span(str(count), "yellow" if count else "dim")


def _counts(counts: dict[str, int]) -> str:
    return "  ".join(f"{name} {count}" for name, count in counts.items() if count)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _quantiles(quantiles: Quantiles) -> str:
    return f"{quantiles.p50:.2f} {quantiles.p99:.2f} {quantiles.max:.2f}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def table(heads: Sequence[str], rows: Iterable[Sequence[Span]], width: int) -> Iterator[Line]:
    """Columns of minimum width: the first aligned left, numbers right; the last is text, which may go on below."""
    rows, last = list(rows), len(heads) - 1
    widths = [max(map(len, (head, *(row[i].text for row in rows)))) for i, head in enumerate(heads)]

    def aligned(i: int, text: str) -> str:
        return (text.ljust(widths[i]) if i == 0 else text.rjust(widths[i])) + "  "

    yield tuple(Span(aligned(i, head), "bold") for i, head in enumerate(heads[:last]))
    for row in rows:
        numbers = tuple(Span(aligned(i, span.text), span.colour) for i, span in enumerate(row[:last]))
        yield from _folded(numbers, row[last], width)
