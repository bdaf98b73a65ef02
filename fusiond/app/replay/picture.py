"""Draws a replay: the track, and the errors inside their covariance band. Needs matplotlib (the extra `plot`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from fusiond.app.replay.summary import Summary
from fusiond.app.replay.trace import FixSample, TickSample, Trace
from fusiond.app.replay.truth import wrapped
from fusiond.units import SECOND, nanoseconds

Array = NDArray[np.float64]

# Okabe and Ito's colours, which colour-blind readers can distinguish too
BLUE, VERMILION, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#E69F00", "#009E73", "#808080"
STYLE: Any = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 10}
SIZE, DPI = (13.0, 6.8), 110  # inches, dots per inch
MIN_AXIS_SIGMAS = 4.0  # an error axis extends at least to this many median sigmas
CLOSE_UP_M = 25.0  # half the width of the close-up
MAX_MARKS = 400  # rejected fixes marked one by one on the error axes


def draw(trace: Trace, summary: Summary, path: Path) -> None:
    """Write the picture as PNG. Raises OSError."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.3))
        ticks, fixes, rejected = trace.ticks.items, trace.fixes.items, trace.rejected.items
        left, right = grid[0].subgridspec(2, 1), grid[1].subgridspec(3, 1)
        over, close = figure.add_subplot(left[0]), figure.add_subplot(left[1])
        for axes in (over, close):
            _track(axes, ticks, fixes, rejected)
        over.set(title="Track", aspect="equal", adjustable="datalim")
        _close_up(close, ticks, summary)
        figure.legend(*over.get_legend_handles_labels(), loc="outside lower left", ncols=5, frameon=False)
        top = figure.add_subplot(right[0])
        others = (figure.add_subplot(right[place], sharex=top) for place in (1, 2))
        _errors([top, *others], ticks, rejected, summary)
        figure.suptitle(_title(summary), fontsize=11, x=0.01, ha="left", fontweight="bold")
        figure.savefig(path, format="png", metadata={"Software": "fusiond"})


def _title(summary: Summary) -> str:
    words = f"{summary.vehicle}: {summary.span.seconds:.0f} s"
    if summary.truth:
        truth = summary.truth
        words += f", {truth.distance_m / 1e3:.2f} km, horizontal position error {truth.position.rmse_m:.2f} m RMSE"
        words += f", {100 * truth.position.inside_95:.0f} % inside the 95 % ellipse"
    return words


def _track(axes: Axes, ticks: Sequence[TickSample], fixes: Sequence[FixSample], rejected: Sequence[FixSample]) -> None:
    east = np.array([tick.east_m for tick in ticks])
    north = np.array([tick.north_m for tick in ticks])
    reckoned = np.array([tick.reckoned for tick in ticks], dtype=bool)
    if any(tick.errors for tick in ticks):
        true = np.array([(tick.true_east_m, tick.true_north_m) for tick in ticks])
        axes.plot(true[:, 0], true[:, 1], color="black", linewidth=4.5, alpha=0.25, label="truth", zorder=1)
    axes.plot(*_places(fixes), ".", color=ORANGE, markersize=4, label="GNSS fixes", zorder=2)
    if rejected:
        axes.plot(*_places(rejected), "x", color=VERMILION, markersize=5, label="rejected", zorder=4)
    axes.plot(east, north, color=BLUE, linewidth=1.4, label="fused", zorder=3)
    if reckoned.any():
        gap = np.where(reckoned, 0.0, np.nan)
        axes.plot(east + gap, north + gap, color=GREEN, linewidth=2.4, label="fused, dead reckoning", zorder=3)
    if len(ticks):
        axes.plot(east[0], north[0], "o", color="black", markersize=6, zorder=5)
        axes.annotate("start", (east[0], north[0]), textcoords="offset points", xytext=(7, 5), annotation_clip=True)
    axes.set(xlabel="east [m]", ylabel="north [m]")
    axes.grid(alpha=0.25)


def _close_up(axes: Axes, ticks: Sequence[TickSample], summary: Summary) -> None:
    """Limit the axes to the end of the longest dead reckoning, or of the track if there was none."""
    stretches = summary.dead_reckoning.stretches if summary.dead_reckoning else []
    longest = max(stretches, key=lambda stretch: stretch.stop_s - stretch.start_s, default=None)
    axes.set(title="Close-up: the end of the longest dead reckoning" if longest else "Close-up: the end", aspect="equal")
    if not ticks:
        return
    stop_ns = nanoseconds(longest.stop_s) if longest else ticks[-1].since_ns
    centre = min(ticks, key=lambda tick: abs(tick.since_ns - stop_ns))
    axes.set_box_aspect(0.5)
    axes.set_xlim(centre.east_m - CLOSE_UP_M, centre.east_m + CLOSE_UP_M)
    axes.set_ylim(centre.north_m - CLOSE_UP_M / 2, centre.north_m + CLOSE_UP_M / 2)


def _places(fixes: Sequence[FixSample]) -> tuple[list[float], list[float]]:
    return [fix.east_m for fix in fixes], [fix.north_m for fix in fixes]


def _errors(axes: Sequence[Axes], ticks: Sequence[TickSample], rejected: Sequence[FixSample], summary: Summary) -> None:
    """Errors and their band of two sigma; without a truth only the band."""
    second = np.array([tick.since_ns / SECOND for tick in ticks])
    offset = summary.truth.heading.offset_deg if summary.truth else 0.0
    errors = [tick.errors for tick in ticks]
    none = float("nan")
    curves: list[tuple[str, list[float], list[float]]] = [
        ("north error [m]", [e.north_m if e else none for e in errors], [tick.sigma_north_m for tick in ticks]),
        ("east error [m]", [e.east_m if e else none for e in errors], [tick.sigma_east_m for tick in ticks]),
        (
            "heading error [deg]",
            [wrapped(e.yaw_deg - offset) if e else none for e in errors],
            [tick.sigma_yaw_deg for tick in ticks],
        ),
    ]
    for ax, (label, values, sigmas) in zip(axes, curves, strict=True):
        _band(ax, second, np.array(values), np.array(sigmas))
        ax.set_ylabel(label)
        for stretch in summary.dead_reckoning.stretches if summary.dead_reckoning else ():
            ax.axvspan(stretch.start_s, stretch.stop_s, color=GREEN, alpha=0.15, linewidth=0)
        for fix in rejected[:MAX_MARKS]:
            ax.axvline(fix.since_ns / SECOND, color=VERMILION, alpha=0.25, linewidth=1.0)
    for ax in axes[:-1]:
        ax.tick_params(labelbottom=False)
    axes[-1].set_xlabel("time from the first event [s]")
    if summary.truth and abs(offset) > 0.005:
        axes[-1].set_title(f"constant offset of {offset:+.2f} deg removed", loc="right", fontsize=8, color=GREY)
    axes[0].set_title("Errors inside their published covariance" if summary.truth else "Published covariance")
    axes[0].legend(handles=_keys(bool(summary.truth), bool(rejected), summary), loc="upper right", ncols=4, fontsize=8)


def _band(ax: Axes, second: Array, values: Array, sigmas: Array) -> None:
    ax.fill_between(second, -2 * sigmas, 2 * sigmas, color=BLUE, alpha=0.2, linewidth=0)
    ax.plot(second, values, color=BLUE, linewidth=1.0)
    ax.axhline(0.0, color=GREY, linewidth=0.6)
    ax.grid(alpha=0.25)
    if len(sigmas):
        # the large values at the start must not flatten the rest
        typical = max(float(np.quantile(2 * sigmas, 0.98)), MIN_AXIS_SIGMAS * float(np.median(sigmas)))
        known = np.abs(values[np.isfinite(values)])
        limit = 1.15 * max(typical, float(np.quantile(known, 0.99)) if len(known) else 0.0)
        if limit > 0:
            ax.set_ylim(-limit, limit)


def _keys(compared: bool, rejected: bool, summary: Summary) -> list[Patch | Line2D]:
    keys: list[Patch | Line2D] = [Line2D([], [], color=BLUE, linewidth=1.0, label="error")] if compared else []
    keys.append(Patch(color=BLUE, alpha=0.2, label="+- 2 sigma"))
    if summary.dead_reckoning and summary.dead_reckoning.count:
        keys.append(Patch(color=GREEN, alpha=0.15, label="dead reckoning"))
    if rejected:
        keys.append(Line2D([], [], color=VERMILION, alpha=0.5, label="fix rejected"))
    return keys
