"""The screen of `fusiond top`: the latest messages of one vehicle as lines of coloured text, for a terminal or a picture."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
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
EVENTS = 12  # shown
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


def screen(view: View, silent_s: float, width: int, height: int) -> list[Line]:
    """At most `height` lines of at most `width` columns; `silent_s` is the time since the last state."""
    lines = list(_lines(view, silent_s))
    if len(lines) > height:
        lines = [*lines[: height - 1], (Span(f"... {len(lines) - height + 1} lines more", "dim"),)]
    return [tuple(_cut(line, width)) for line in lines]


def plain(line: Line) -> str:
    """A line without its colours."""
    return "".join(span.text for span in line).rstrip()


def _cut(line: Line, width: int) -> Iterator[Span]:
    for span in line:
        if width <= 0:
            return
        text = "".join(character if character.isprintable() else "?" for character in span.text[:width])
        yield Span(text, span.colour)  # no text of a message may control the terminal
        width -= len(span.text)


def _lines(view: View, silent_s: float) -> Iterator[Line]:
    if view.state is None:
        yield (Span("no state yet", "yellow"),)
    else:
        yield from _state(view.state, view.rate_hz, silent_s)
    if view.health is not None:
        yield from _health(view.health, view.before)
    if view.events:
        yield ()
        yield (Span("EVENTS", "bold"),)
        for event in reversed(view.events):
            yield (Span(f"{_clock(event.t_ns)}  ", "dim"), Span(event.text, SEVERITIES[event.severity]))


# --- The state


def _state(message: StateMessage, rate_hz: float | None, silent_s: float) -> Iterator[Line]:
    silent = silent_s >= SILENT_S
    yield (
        Span(f"{message.vehicle}  ", "bold"),
        Span(message.mode.value.replace("_", " "), "dim" if silent else MODES[message.mode]),
        Span(f"  {_clock(message.t_ns)} UTC", "dim"),
        *([Span(f"  {rate_hz:.0f} Hz")] if rate_hz else []),
        Span(f"  resets {message.resets}", "yellow" if message.resets else "plain"),
        *([Span(f"  no state for {silent_s:.0f} s", "red")] if silent else []),
    )
    if message.fault:
        yield (Span(f"state withheld: {message.fault}", "red"),)
    if message.state is not None:
        yield from _motion(message.state)
    if message.age_ms is not None:
        yield _pair("IMU age", f"{message.age_ms:.1f} ms")


def _motion(state: State) -> Iterator[Line]:
    north, east, down = state.velocity_ned_mps
    latitude, longitude = _compass(state.lat_deg, "NS"), _compass(state.lon_deg, "EW")
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


def _compass(degrees: float, letters: str) -> str:
    return f"{abs(degrees):.7f} {letters[degrees < 0]}"


def _clock(t_ns: int) -> str:
    return f"{datetime.fromtimestamp(t_ns // SECOND, UTC):%H:%M:%S}.{t_ns % SECOND // (100 * MILLISECOND)}"


# --- The health


def _health(health: HealthMessage, before: HealthMessage | None) -> Iterator[Line]:
    latency = health.latency_ms
    stages = [("fused", latency.fused), ("published", latency.published)]
    text = "  ".join(f"{name} {_quantiles(quantiles)}" for name, quantiles in stages if quantiles)
    if text:
        yield _pair("latency", f"{text} ms (p50 p99 max)")
    yield _pair("up", f"{_duration(health.uptime_s)}  fusiond {health.version}")
    if health.reset_reason:
        yield _pair("reset", health.reset_reason)
    yield ()
    old = before.sources if before else {}
    rows = [_source(name, source, old.get(name)) for name, source in health.sources.items()]
    yield from _table(("SOURCE", "rate Hz", "age ms", *OUTCOMES.values(), "ratio", "NIS", "jitter ms", ""), rows)
    if health.inputs:
        yield ()
        inputs = [
            (Span(name), Span(str(one.received)), _alarm(one.dropped), Span(_counts(one.counts), "dim"))
            for name, one in health.inputs.items()
        ]
        yield from _table(("INPUT", "received", "dropped", ""), inputs)
    if health.outputs:
        yield ()
        outputs = [_output(name, one) for name, one in health.outputs.items()]
        yield from _table(("OUTPUT", "offered", "dropped", "p50 p99 max ms", ""), outputs)


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


def _table(heads: Sequence[str], rows: Iterable[Sequence[Span]]) -> Iterator[Line]:
    """Columns of minimum width: the first and the last aligned left, numbers right."""
    rows = list(rows)
    last = len(heads) - 1
    widths = [max(map(len, (head, *(row[i].text for row in rows)))) for i, head in enumerate(heads)]

    def aligned(i: int, text: str) -> str:
        return text.ljust(widths[i]) if i in (0, last) else text.rjust(widths[i])

    yield tuple(Span(aligned(i, head) + "  ", "bold") for i, head in enumerate(heads))
    for row in rows:
        yield tuple(Span(aligned(i, span.text) + "  ", span.colour) for i, span in enumerate(row))
