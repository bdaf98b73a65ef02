"""The map of a report: the track in metres on a plain grid with a scale bar, or over tiles from a server. Needs bokeh."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    HoverTool,
    MetricLength,
    PanTool,
    ResetTool,
    ScaleBar,
    WheelZoomTool,
    WMTSTileSource,
)
from bokeh.models.annotations.dimensional import CustomDimensional
from bokeh.plotting import figure
from numpy.typing import NDArray

from fusiond.app.replay.trace import FixSample, Trace
from fusiond.app.report.board import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Key, Panel, compact, dress
from fusiond.maths.wgs84 import SEMI_MAJOR, radii
from fusiond.units import SECOND

HEIGHT = 520  # pixels
LEAST_M = 40.0  # the map is at least so wide and high

Array = NDArray[np.float64]
Points = tuple[Array, Array]  # east, north [m]


class Projection:
    """From metres east and north of an origin (lat, lon [deg], height [m]) to the map: the same metres, or those of web
    maps, which are longer by 1 / cos(latitude)."""

    def __init__(self, origin: tuple[float, float, float], mercator: bool) -> None:
        self._mercator = mercator
        self._latitude, self._longitude, self._height = math.radians(origin[0]), math.radians(origin[1]), origin[2]

    @property
    def stretch(self) -> float:
        """Units of the map to a metre."""
        return 1 / math.cos(self._latitude) if self._mercator else 1.0

    def __call__(self, points: Points) -> Points:
        east, north = points
        if not self._mercator:
            return east, north
        meridian, transverse = radii(self._latitude)
        latitude = self._latitude + north / (meridian + self._height)
        longitude = self._longitude + east / ((transverse + self._height) * math.cos(self._latitude))
        return SEMI_MAJOR * longitude, SEMI_MAJOR * np.log(np.tan(math.pi / 4 + latitude / 2))


def track_map(trace: Trace, tiles: str | None) -> Panel:
    """The map. `tiles` is the address of a tile server with {x}, {y}, {z}. There must have been a state or a fix."""
    assert trace.origin is not None
    projection = Projection(trace.origin, tiles is not None)
    plot = figure(
        name="map", height=HEIGHT, sizing_mode="stretch_width", match_aspect=True, tools=[], toolbar_location="right",
        min_border_left=62, min_border_right=12,
    )  # fmt: skip
    panel = Panel("map", "Track", "m" if tiles is None else "", plot, wide=True, fixed=True)
    drawing = _Drawing(panel, projection)
    pan, wheel = PanTool(), WheelZoomTool(modifiers="ctrl", zoom_on_axis=False)
    plot.add_tools(pan, wheel, BoxZoomTool(match_aspect=True), ResetTool())
    plot.toolbar.active_drag, plot.toolbar.active_scroll, plot.toolbar.logo = pan, wheel, None
    if tiles:
        plot.add_tile(WMTSTileSource(url=tiles, attribution=""))
        plot.axis.visible = plot.grid.visible = False
    _draw(drawing, trace)
    dress(plot)
    plot.xaxis.axis_label, plot.yaxis.axis_label = "m east", "m north"
    plot.x_range.range_padding = plot.y_range.range_padding = 0.08
    plot.add_layout(_scale_bar(projection.stretch))
    return panel


class _Drawing:
    """Draws points given in metres."""

    def __init__(self, panel: Panel, projection: Projection) -> None:
        self._panel, self._projection = panel, projection

    def source(self, points: Points, name: str, **columns: Array) -> ColumnDataSource:
        x, y = self._projection(points)
        if self._projection.stretch == 1.0:  # the others are so large that they need all digits
            x, y = compact(x), compact(y)
        return ColumnDataSource({"x": x, "y": y, **{key: compact(values) for key, values in columns.items()}}, name=name)

    def line(self, source: ColumnDataSource, label: str, colour: str, **style: Any) -> Any:
        return self._keyed(self._panel.plot.line("x", "y", source=source, color=colour, **style), label, colour, "line")

    def dots(self, source: ColumnDataSource, label: str, colour: str, kind: str = "dots", **style: Any) -> Any:
        return self._keyed(self._panel.plot.scatter("x", "y", source=source, color=colour, **style), label, colour, kind)

    def _keyed(self, drawn: Any, label: str, colour: str, kind: str) -> Any:
        drawn.name = f"map.{label}"
        if label:
            self._panel.keys.append(Key(drawn.name, label, colour, kind))
        return drawn


def _draw(drawing: _Drawing, trace: Trace) -> None:
    ticks = trace.ticks.items
    t = np.array([tick.since_ns / SECOND for tick in ticks])
    east, north = np.array([tick.east_m for tick in ticks]), np.array([tick.north_m for tick in ticks])
    true = np.array([tick.true_east_m for tick in ticks]), np.array([tick.true_north_m for tick in ticks])
    _widen(drawing, trace, (east, north))
    if np.isfinite(true[0]).any():
        drawing.line(drawing.source(true, "truth"), "truth", GREY, line_width=5, line_alpha=0.45)
    if trace.fixes.items:
        drawing.dots(_fixes(drawing, trace.fixes.items, "fixes"), "fixes", ORANGE, size=3.5, line_color=None, alpha=0.75)
    if len(ticks):
        track = drawing.source((east, north), "track", t=t)
        drawn = drawing.line(track, "fused", BLUE, line_width=2, line_join="round")
        reckoned = np.where([tick.reckoned for tick in ticks], 0.0, np.nan)
        if np.isfinite(reckoned).any():
            gone = drawing.source((east + reckoned, north + reckoned), "reckoned track")
            drawing.line(gone, "dead reckoning", PURPLE, line_width=4, line_alpha=0.9)
        drawing.line(drawing.source((east[:0], north[:0]), "window"), "", BLUE, line_width=6, line_alpha=0.35)
        hover = HoverTool(renderers=[drawn], tooltips=[("time", "@t{0.00} s"), ("east", "@x{0.0}"), ("north", "@y{0.0}")])
        drawing._panel.plot.add_tools(hover)
        start = drawing.source((east[:1], north[:1]), "start")
        drawing.dots(start, "start", GREEN, size=11, line_color="white", line_width=1.5)
        stop = drawing.source((east[-1:], north[-1:]), "end")
        drawing.dots(stop, "end", RED, size=11, marker="square", line_color="white", line_width=1.5)
    if trace.rejected.items:
        source = _fixes(drawing, trace.rejected.items, "rejected fixes")
        drawing.dots(source, "rejected", RED, "marks", marker="x", size=7, line_width=1.5)
    marker = drawing.source((east[:0], north[:0]), "marker")
    drawing.dots(marker, "", BLUE, size=15, line_color="white", line_width=2.5)


def _fixes(drawing: _Drawing, fixes: Sequence[FixSample], name: str) -> ColumnDataSource:
    points = np.array([fix.east_m for fix in fixes]), np.array([fix.north_m for fix in fixes])
    return drawing.source(points, name)


def _widen(drawing: _Drawing, trace: Trace, points: Points) -> None:
    """Let the map of a vehicle that stands not be all noise."""
    east, north = points if len(points[0]) else (np.zeros(1), np.zeros(1))
    centre = (float(east.min() + east.max()) / 2, float(north.min() + north.max()) / 2)
    corners = np.array([-LEAST_M / 2, LEAST_M / 2])
    drawing.dots(drawing.source((centre[0] + corners, centre[1] + corners), "corners"), "", GREY, alpha=0.0)


def _scale_bar(stretch: float) -> ScaleBar:
    unit: dict[str, Any] = {"dimensional": MetricLength(), "unit": "m"}
    if stretch != 1.0:
        basis: Any = {"map": (1 / stretch, "map"), "m": (1.0, "m"), "km": (1000.0, "km")}
        unit = {"dimensional": CustomDimensional(basis=basis, ticks=[1, 2, 5, 10, 20, 50, 100, 200, 500]), "unit": "map"}
    return ScaleBar(
        range="auto", orientation="horizontal", location="bottom_left", length_sizing="adaptive", bar_length=0.15,
        background_fill_alpha=0.0, border_line_color=None, bar_line_width=2, bar_line_color=GREY,
        label_text_font="system-ui, sans-serif", **unit,
    )  # fmt: skip
