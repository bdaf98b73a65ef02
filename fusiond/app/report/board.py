"""The plots of a report: figures of one time axis, each with its keys, and the data that they share. Needs bokeh."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from bokeh.models import BoxZoomTool, ColumnDataSource, CrosshairTool, HoverTool, Range1d, Span, WheelZoomTool
from bokeh.plotting import figure
from numpy.typing import NDArray

# they stand out from white and from black, and colour-blind readers can distinguish the first three
BLUE, ORANGE, GREEN, PURPLE, RED, GREY = "#3b82d6", "#dd7a1c", "#1f9e7d", "#9a6fd8", "#d8434e", "#858d99"
AXIS_COLOURS = (BLUE, ORANGE, GREEN)
SOURCE_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, "#c2569b", "#8a9a23", "#2fa3b5", "#b0713f", "#6577c9", GREY)
HEIGHT = 190  # pixels
LEFT = 62  # pixels for the labels of the y axis, the same in all, so that equal times are below each other
ALL_FITS = 1.08  # an axis is this much longer than its curves
USUAL = 0.985  # share of the samples that the axis shows at first: the start of a drive must not flatten the rest

Array = NDArray[np.float64]


@dataclass
class Key:
    """One curve of a panel, and its entry in the legend."""

    name: str  # of the renderer
    label: str
    colour: str
    kind: str = "line"  # line, band, dots, marks or shade


@dataclass
class Panel:
    """One plot."""

    name: str
    title: str
    unit: str
    plot: Any  # bokeh's figure
    keys: list[Key] = field(default_factory=list)
    fits: list[tuple[str, str]] = field(default_factory=list)  # source and column of each curve that the y axis follows
    note: str = ""
    wide: bool = False
    always: tuple[float, ...] = ()  # values that the axis always shows
    fixed: bool = False  # the y axis does not follow the curves


class Board:
    """Figures with one time axis of `seconds`."""

    def __init__(self, seconds: float, reckoned: Sequence[tuple[float, float]]) -> None:
        margin = max(0.1, 0.005 * seconds)
        self.x_range = Range1d(-margin, seconds + margin, bounds=(-margin, seconds + margin), name="time", min_interval=0.05)
        self.panels: list[Panel] = []
        self._sources: dict[str, ColumnDataSource] = {}
        self._reckoned = list(reckoned)
        self._cross = Span(dimension="height", line_width=1, line_alpha=0.6, line_color=GREY, line_dash="dotted")

    def source(self, name: str, data: dict[str, Any]) -> str:
        """Data that several figures may show, by its name."""
        self._sources[name] = ColumnDataSource(name=name, data={column: compact(values) for column, values in data.items()})
        return name

    def panel(self, name: str, title: str, unit: str = "", height: int = HEIGHT, **how: Any) -> Panel:
        """A new plot over time."""
        axis = {key: how.pop(key) for key in ("y_axis_type", "y_range") if key in how}
        plot = figure(
            name=name, height=height, sizing_mode="stretch_width", x_range=self.x_range, toolbar_location=None,
            tools=[], min_border_left=LEFT, min_border_right=12, min_border_top=4, min_border_bottom=4, **axis,
        )  # fmt: skip
        drag = BoxZoomTool(dimensions="width")
        wheel = WheelZoomTool(dimensions="width", modifiers="ctrl")
        plot.add_tools(drag, wheel, CrosshairTool(overlay=self._cross))
        plot.toolbar.active_drag, plot.toolbar.active_scroll = drag, wheel
        dress(plot)
        made = Panel(name, title, unit, plot, **how)
        if self._reckoned:
            if "reckoned" not in self._sources:
                start, stop = zip(*self._reckoned, strict=True)
                self.source("reckoned", {"start": np.array(start), "stop": np.array(stop)})
            shade = {"fill_color": PURPLE, "fill_alpha": 0.12, "line_color": None}
            plot.vstrip("start", "stop", source=self._sources["reckoned"], **shade)
        self.panels.append(made)
        return made

    def line(self, panel: Panel, source: str, column: str, label: str, colour: str, **style: Any) -> Any:
        """A curve over `t`."""
        name = f"{panel.name}.{column}"
        drawn = panel.plot.line(
            "t", column, source=self._sources[source], color=colour, name=name,
            **{"line_width": 1.3, "line_join": "round", **style},
        )  # fmt: skip
        self._key(panel, Key(name, label, colour), source, column)
        return drawn

    def dots(self, panel: Panel, source: str, column: str, label: str, colour: str, **style: Any) -> Any:
        """Points over `t`."""
        name = f"{panel.name}.{source}.{column}"
        drawn = panel.plot.scatter(
            "t", column, source=self._sources[source], color=colour, name=name, **{"size": 2.5, "line_color": None, **style}
        )
        self._key(panel, Key(name, label, colour, "marks" if style else "dots"), source, column)
        return drawn

    def band(
        self, panel: Panel, source: str, low: str, high: str, label: str, colour: str, *, fitted: bool = True
    ) -> None:
        """The area between two curves over `t`; with `fitted` the y axis follows them."""
        name = f"{panel.name}.{low}"
        panel.plot.varea(
            "t", low, high, source=self._sources[source], fill_color=colour, fill_alpha=0.17, name=name, level="underlay"
        )
        panel.keys.append(Key(name, label, colour, "band"))
        if fitted:
            panel.fits += [(source, low), (source, high)]

    def hover(self, panel: Panel, drawn: Any, columns: Sequence[tuple[str, str, str]]) -> None:
        """Show the values at the pointer: label, column and format of each, with its unit."""
        rows = [("time", "@t{0.00} s")]
        for label, column, how in columns:
            digits, _, unit = how.partition(" ")
            rows.append((label, f"@{{{column}}}{{{digits}}} {unit}"))
        panel.plot.add_tools(HoverTool(renderers=[drawn], tooltips=rows, mode="vline", point_policy="follow_mouse"))

    def settle(self, panel: Panel) -> None:
        """Limit the y axis to the usual values of the curves."""
        if panel.fixed:
            return
        columns = [self._sources[source].data[column] for source, column in panel.fits]
        known = [values[np.isfinite(values)] for values in columns]
        known = [values for values in known if len(values)]
        low = min([*(float(np.quantile(values, 1 - USUAL)) for values in known), *panel.always], default=0.0)
        high = max([*(float(np.quantile(values, USUAL)) for values in known), *panel.always], default=1.0)
        panel.plot.y_range = Range1d(*stretched(low, high), name=f"{panel.name}.y")

    def _key(self, panel: Panel, key: Key, source: str, column: str) -> None:
        panel.keys.append(key)
        panel.fits.append((source, column))


def stretched(low: float, high: float) -> tuple[float, float]:
    """Limits of an axis around values."""
    middle, half = (low + high) / 2, (high - low) / 2
    half = max(half * ALL_FITS, 1e-9 * abs(middle), 1e-6)
    return middle - half, middle + half


def compact(values: Any) -> Any:
    """Numbers in half the bytes: more digits than a picture shows."""
    if isinstance(values, np.ndarray) and values.dtype == np.float64:
        with np.errstate(over="ignore"):
            return np.where(np.abs(values) < 3e38, values, math.nan).astype(np.float32)
    return values


def dress(plot: Any) -> None:
    """The style that all figures share. Colours of text and lines follow the page, which sets them."""
    plot.background_fill_color = plot.border_fill_color = plot.outline_line_color = None
    plot.axis.axis_label_text_font = plot.axis.major_label_text_font = "system-ui, sans-serif"
    plot.axis.major_label_text_font_size = plot.axis.axis_label_text_font_size = "11px"
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.minor_tick_line_color = None
    plot.axis.major_tick_in, plot.axis.major_tick_out = 0, 3
    plot.axis.axis_line_color = None
    plot.grid.grid_line_width = 1
