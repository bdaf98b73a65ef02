"""The plots of a report, section by section, from what was gathered. Needs bokeh."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FactorRange, HoverTool, Span
from numpy.typing import NDArray

from fusiond.app.replay.summary import Summary
from fusiond.app.report.board import (
    AXIS_COLOURS,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SOURCE_COLOURS,
    Board,
    Key,
    Panel,
)
from fusiond.app.report.gathered import AXES, INNOVATION, Gathered
from fusiond.units import SECOND

Array = NDArray[np.float64]

STATUS_COLOURS = {
    "nominal": GREEN, "noisy": "#c9a227", "biased": ORANGE, "frozen": "#c2569b", "absent": GREY,
    "aligning": "#c9a227", "dead reckoning": PURPLE, "lost": RED,
}  # fmt: skip
SEVERITY_COLOURS = {"info": GREEN, "notice": BLUE, "warning": ORANGE, "critical": RED}
NORTH_EAST_DOWN = ("north", "east", "down")
MODELS: Mapping[str, tuple[str, str, tuple[str, ...], float]] = {  # model: what, unit, axes, factor to the unit
    "gnss_position": ("position", "m", NORTH_EAST_DOWN, 1.0),
    "gnss_velocity": ("velocity", "m/s", NORTH_EAST_DOWN, 1.0),
    "wheel_speed": ("speed", "m/s", ("speed",), 1.0),
    "barometric_height": ("height", "m", ("height",), 1.0),
    "gnss_yaw": ("yaw", "deg", ("yaw",), math.degrees(1.0)),
    "yaw_rate": ("yaw rate", "deg/s", ("clockwise",), math.degrees(1.0)),
    "steering": ("steering angle", "deg", ("to the right",), math.degrees(1.0)),
    "lateral_acceleration": ("lateral acceleration", "m/s²", ("to the right",), 1.0),
    "parked": ("velocity while parked", "m/s", ("x", "y", "z"), 1.0),
}
UNITS = {"deg": "deg", "m": "m", "ms": "ms", "mps2": "deg per m/s²", "s": "deg/s"}  # last part of a calibration's name
LEAST_NIS = 0.01  # an axis of logarithms ends there
LOG_FROM = 30.0  # an axis of sigmas is logarithmic where the largest is this many times the least


@dataclass
class Section:
    """One part of the report."""

    name: str
    title: str
    words: list[str] = field(default_factory=list)
    panels: list[Panel] = field(default_factory=list)


def sections(board: Board, gathered: Gathered, summary: Summary) -> Iterator[Section]:
    """The sections with plots over time, in order."""
    curves = gathered.state.curves()
    if len(curves["t"]):
        yield _accuracy(board, curves, summary)
        yield _motion(board)
    else:
        yield Section("errors", "Accuracy", ["There was no state at any time, so there are neither errors nor sigmas."])
    yield _health(board, gathered, summary)
    yield _innovations(board, gathered)
    yield _latencies(board, gathered)
    yield _calibration(board, gathered, bool(len(curves["t"])))
    for panel in board.panels:
        board.settle(panel)


# --- Errors, or sigmas alone


def _accuracy(board: Board, curves: dict[str, Array], summary: Summary) -> Section:
    offset = summary.truth.heading.offset_deg if summary.truth else 0.0
    data = dict(curves)
    data["heading_error"] = (data["heading_error"] - offset + 180.0) % 360.0 - 180.0
    for name, sigma in (("north", "north"), ("east", "east"), ("height", "down"), ("heading", "heading")):
        two = 2 * np.nan_to_num(data[f"{sigma}_sigma"])
        data[f"{name}_low"], data[f"{name}_high"] = -two, two
    data["velocity_low"], data["velocity_high"] = 0 * data["north_high"], data["velocity_sigma"] * 2 * math.sqrt(2)
    board.source("state", data)
    return _errors(board, offset) if summary.truth else _sigmas(board, data)


def _errors(board: Board, offset: float) -> Section:
    words = ["Published less true. An honest filter is inside the band, two published sigmas, for 95 % of the time."]
    if abs(offset) > 0.005:
        words.append(
            f"The mean heading error of {offset:+.2f} deg was taken off: the truth's axes need not be those of the IMU."
        )
    found = Section("errors", "Errors against the truth", words)
    for name, title, unit in (
        ("north", "North error", "m"), ("east", "East error", "m"), ("height", "Height error", "m"),
        ("velocity", "Horizontal velocity error", "m/s"), ("heading", "Heading error", "deg"),
    ):  # fmt: skip
        panel = board.panel(f"{name}_error", title, unit, always=(0.0,), wide=name in ("north", "east"))
        board.band(panel, "state", f"{name}_low", f"{name}_high", "± 2 sigma" if name != "velocity" else "2 sigma", BLUE)
        drawn = board.line(panel, "state", f"{name}_error", "error", BLUE)
        label = ("error", f"{name}_error", f"0.000 {unit}")
        board.hover(panel, drawn, [label, ("2 sigma", f"{name}_high", "0.000")])
        found.panels.append(panel)
    return found


def _sigmas(board: Board, data: dict[str, Array]) -> Section:
    words = [
        "No truth was given, so there are no errors to show; --truth compares with a reference track. These are the sigmas"
        " that the filter itself publishes, one standard deviation."
    ]
    found = Section("errors", "Uncertainty", words)
    kinds: Sequence[tuple[str, str, str, Sequence[tuple[str, str]]]] = (
        ("position_sigma", "Position sigma", "m",
         [("north_sigma", "north"), ("east_sigma", "east"), ("down_sigma", "height")]),
        ("velocity_sigma", "Velocity sigma", "m/s", [("velocity_sigma", "horizontal, per axis")]),
        ("heading_sigma", "Heading sigma", "deg", [("heading_sigma", "heading")]),
    )  # fmt: skip
    for name, title, unit, columns in kinds:
        values = np.concatenate([data[column] for column, _ in columns])
        values = values[np.isfinite(values) & (values > 0)]
        steep = len(values) > 0 and float(values.max()) > LOG_FROM * float(values.min())
        how: dict[str, Any] = {"y_axis_type": "log"} if steep else {"always": (0.0,)}
        panel = board.panel(name, title, unit, wide=name == "position_sigma", fixed=steep, **how)
        lines = [
            board.line(panel, "state", column, label, colour)
            for (column, label), colour in zip(columns, AXIS_COLOURS, strict=False)
        ]
        board.hover(panel, lines[0], [(label, column, f"0.000 {unit}") for column, label in columns])
        found.panels.append(panel)
    return found


# --- Motion

MOTION: Sequence[tuple[str, str, str, Sequence[tuple[str, str]], bool]] = (
    ("speed", "Speed over ground", "m/s", [("speed", "speed"), ("climb", "climb")], True),
    ("heading", "Heading", "deg", [("heading", "heading")], False),
    ("height", "Height", "m", [("height", "height")], False),
    ("attitude", "Roll and pitch", "deg", [("roll", "roll"), ("pitch", "pitch")], False),
    ("acceleration", "Specific force, level", "m/s²",
     [("acceleration_x", "forward"), ("acceleration_y", "right")], False),
    ("rates", "Angular rates", "deg/s", [("rate_z", "yaw"), ("rate_y", "pitch"), ("rate_x", "roll")], False),
    ("vertical", "Specific force, down", "m/s²", [("acceleration_z", "down")], False),
)  # fmt: skip


def _motion(board: Board) -> Section:
    found = Section("motion", "Motion", ["The state as published."])
    for name, title, unit, columns, wide in MOTION:
        panel = board.panel(name, title, unit, wide=wide)
        draw = board.dots if name == "heading" else board.line
        coloured = zip(columns, AXIS_COLOURS, strict=False)
        lines = [draw(panel, "state", column, label, colour) for (column, label), colour in coloured]
        board.hover(panel, lines[0], [(label, column, f"0.00 {unit}") for column, label in columns])
        found.panels.append(panel)
    return found


# --- Health


def _health(board: Board, gathered: Gathered, summary: Summary) -> Section:
    words = [
        "What the filter believes of each source, and the mode of the state. Point at a stretch for the reason."
    ]
    rows = {"state": gathered.modes, **gathered.statuses}
    merged = sum(spans.merged for spans in rows.values())
    if merged:
        words.append(f"{merged} short stretches are drawn as part of the one before.")
    silent = [name for name, source in summary.sources.items() if not source.events]
    if silent:
        words.append(f"Nothing was received from {', '.join(silent)}.")
    if "wheel_speed" not in gathered.models.values():
        words.append("The configuration has no wheels, so speed and heading rest on the other sources.")
    names = [*reversed(rows), "events"]
    data: dict[str, list[Any]] = {"row": [], "start": [], "stop": [], "status": [], "note": [], "colour": []}
    for name, spans in rows.items():
        for span in spans.items:
            status = span.value.replace("_", " ")
            values = (name, span.start_ns / SECOND, span.stop_ns / SECOND, status, span.note or "-", _colour(status))
            for column, value in zip(data.values(), values, strict=True):
                column.append(value)
    height, factors = 50 + 24 * len(names), FactorRange(factors=names)
    panel = board.panel("health", "Mode and source health", height=height, wide=True, fixed=True, y_range=factors)
    panel.plot.min_border_left = 150
    bars = panel.plot.hbar(
        "row", left="start", right="stop", height=0.66, color="colour", line_color=None, source=ColumnDataSource(data)
    )
    tips = [("", "@row: @status"), ("reason", "@note"), ("seconds", "@start{0.0} to @stop{0.0}")]
    panel.plot.add_tools(HoverTool(renderers=[bars], tooltips=tips, point_policy="follow_mouse"))
    panel.keys = [Key("", status, _colour(status), "shade") for status in dict.fromkeys(data["status"])]
    _mark_events(panel, gathered)
    panel.plot.ygrid.grid_line_color = None
    return Section("health", "Health", words, [panel])


def _colour(status: str) -> str:
    return STATUS_COLOURS.get(status, GREY)


def _mark_events(panel: Panel, gathered: Gathered) -> None:
    marks = {
        "t": [second for second, _ in gathered.events],
        "row": ["events"] * len(gathered.events),
        "colour": [SEVERITY_COLOURS[event.severity] for _, event in gathered.events],
        "text": [event.text for _, event in gathered.events],
    }
    source = ColumnDataSource(marks)
    drawn = panel.plot.scatter("t", "row", marker="diamond", size=11, color="colour", line_color=None, source=source)
    panel.plot.add_tools(HoverTool(renderers=[drawn], tooltips=[("", "@text"), ("second", "@t{0.0}")]))


# --- Innovations


def _innovations(board: Board, gathered: Gathered) -> Section:
    words = [
        "Measurement less prediction. The band is the gate: what lies outside was rejected, unless the source is configured"
        " to be weighted instead. An axis of a vector can be inside its band and the vector still outside its gate."
    ]
    found = Section("innovations", "Innovations", words)
    if not gathered.innovations:
        found.words = ["No measurement was tested against the state."]
        return found
    found.panels.append(_consistency(board, gathered))
    for number, name in enumerate(sorted(gathered.innovations)):
        what, unit, axes, factor = MODELS.get(gathered.models.get(name, ""), ("", "", ("1", "2", "3"), 1.0))
        data = gathered.innovations[name].curves()
        for column in INNOVATION[: 2 * AXES]:
            data[column] = data[column] * factor
        gated = _gated(data, gathered.axes[name])
        usual = float(np.median(gated["high"]))  # a gate that opens wide at times must not flatten the rest
        source = board.source(f"innovation {name}", gated)
        panel = board.panel(f"innovation_{number}", f"{name}, {what}".rstrip(", "), unit, always=(-usual, usual))
        columns = list(zip(INNOVATION[: gathered.axes[name]], axes, AXIS_COLOURS, strict=False))
        board.band(panel, source, "low", "high", "gate", GREY, fitted=False)
        lines = [board.line(panel, source, column, label, shade, line_width=1.0) for column, label, shade in columns]
        if name in gathered.rejected:
            rejected = gathered.rejected[name].curves()
            marks = {"t": rejected["t"], **{column: rejected[column] * factor for column, _, _ in columns}}
            outside = board.source(f"rejected {name}", marks)
            for column, _, _ in columns:
                board.dots(panel, outside, column, "rejected", RED, marker="x", size=6, line_color=RED)
            panel.keys = list({key.label: key for key in panel.keys}.values())  # one for all axes
        hovered = [(label, column, f"0.000 {unit}") for column, label, _ in columns]
        board.hover(panel, lines[0], [*hovered, ("gate", "high", "0.000"), ("test ratio", "ratio", "0.00")])
        found.panels.append(panel)
    return found


def _consistency(board: Board, gathered: Gathered) -> Panel:
    title, unit = "Squared innovations per axis, mean over the horizon", "in sigmas, 1 as expected"
    panel = board.panel("consistency", title, unit, wide=True, height=220, y_axis_type="log", fixed=True)
    panel.plot.add_layout(Span(location=1.0, dimension="width", line_color=GREY, line_dash="dashed", line_width=1.2))
    for number, (name, curves) in enumerate(sorted(gathered.consistencies.items())):
        data = curves.curves()
        source = board.source(f"consistency {name}", {**data, "nis": np.maximum(data["nis"], LEAST_NIS)})
        drawn = board.line(panel, source, "nis", name, SOURCE_COLOURS[number % len(SOURCE_COLOURS)])
        board.hover(panel, drawn, [(name, "nis", "0.00")])
    return panel


def _gated(data: dict[str, Array], axes: int) -> dict[str, Array]:
    """The columns that are drawn; the gate is that of the widest axis."""
    gates = np.stack([data[f"{name}_gate"] for name in INNOVATION[:axes]])
    wide = np.nan_to_num(np.fmax.reduce(gates)) if gates.size else np.empty(0)
    kept = {name: data[name] for name in ("t", *INNOVATION[:axes], "ratio")}
    return {**kept, "low": -wide, "high": wide}


# --- Latencies and clocks


def _latencies(board: Board, gathered: Gathered) -> Section:
    words = ["How long after its own instant each measurement was received, configured delays included."]
    found = Section("latencies", "Latencies and clocks", words)
    panel = board.panel("latency", "Receipt less the instant measured", "ms", wide=True, height=230)
    for number, (name, latencies) in enumerate(sorted(gathered.latencies.items())):
        source = board.source(f"latency {name}", latencies.curves())
        colour = SOURCE_COLOURS[number % len(SOURCE_COLOURS)]
        drawn = board.line(panel, source, "latency", name, colour, line_width=1.0)
        board.hover(panel, drawn, [(name, "latency", "0.0 ms")])
    found.panels.append(panel)
    for number, (name, clock) in enumerate(sorted(gathered.clocks.items())):
        data = clock.curves()
        if not np.nan_to_num(data["offset"]).any():
            continue  # sources without stamps: there is nothing to align
        known = np.flatnonzero(np.isfinite(data["offset"]))
        data["change"] = data["offset"] - (data["offset"][known[0]] if len(known) else 0.0)
        source = board.source(f"clock {name}", data)
        panel = board.panel(f"clock_{number}", f"Clock {name}", "ms", always=(0.0,))
        drawn = board.line(panel, source, "change", "offset since the start", BLUE)
        board.line(panel, source, "jitter", "jitter", ORANGE)
        shown = [("offset", "offset", "0.00 ms"), ("jitter", "jitter", "0.00 ms"), ("drift", "drift", "0.0 ppm")]
        board.hover(panel, drawn, shown)
        found.panels.append(panel)
    return found


# --- Calibration


def _calibration(board: Board, gathered: Gathered, begun: bool) -> Section:
    words = ["What was learnt of the installation, as a correction to the configuration, and of the IMU; band: two sigmas."]
    found = Section("calibration", "Calibration", words)
    for name, curves in gathered.calibrations.items():
        data = curves.curves()
        percent = name.split("_")[-1] not in UNITS
        factor, unit = (100.0, "%") if percent else (1.0, UNITS[name.split("_")[-1]])
        value, two = data["value"] * factor, 2 * factor * np.nan_to_num(data["sigma"])
        middle = np.nan_to_num(value)
        curve = {"t": data["t"], "value": value, "low": middle - two, "high": middle + two}
        source = board.source(f"calibration {name}", curve)
        panel = board.panel(f"calibration_{name}", _words(name), unit, height=150, always=(0.0,))
        board.band(panel, source, "low", "high", "± 2 sigma", PURPLE)
        drawn = board.line(panel, source, "value", "learnt", PURPLE)
        board.hover(panel, drawn, [("value", "value", f"0.000 {unit}"), ("from", "low", "0.000"), ("to", "high", "0.000")])
        found.panels.append(panel)
    for kind, title, unit in (("gyro", "Gyro bias", "deg/s"), ("accel", "Accelerometer bias", "m/s²")) if begun else ():
        panel = board.panel(f"{kind}_bias", title, unit, height=170)
        columns = [(f"{kind}_bias_{axis}", label) for axis, label in zip("xyz", ("forward", "right", "down"), strict=True)]
        lines = [
            board.line(panel, "state", column, label, shade)
            for (column, label), shade in zip(columns, AXIS_COLOURS, strict=True)
        ]
        sigma = ("largest sigma", f"{kind}_bias_sigma", f"0.0000 {unit}")
        board.hover(panel, lines[0], [*((label, column, f"0.0000 {unit}") for column, label in columns), sigma])
        found.panels.append(panel)
    return found


def _words(name: str) -> str:
    """A calibration's name for people, without its unit."""
    parts = name.split("_")
    kept = parts[:-1] if parts[-1] in UNITS else parts
    return " ".join(kept).removesuffix(" per").removesuffix(" deg").capitalize()
