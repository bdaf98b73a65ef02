"""The HTML file of a report: plots, tables and findings with all scripts and styles inside it. Needs bokeh."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from urllib.parse import urlsplit

from bokeh.embed import components
from bokeh.resources import Resources
from jinja2 import Environment

from fusiond.app.replay.summary import Latency, SourceReport, Summary
from fusiond.app.replay.trace import Trace
from fusiond.app.report.board import Board, Panel
from fusiond.app.report.figures import Section, sections
from fusiond.app.report.gathered import Gathered
from fusiond.app.report.track_map import track_map
from fusiond.config.schema import Config
from fusiond.messages.info import config_table
from fusiond.units import SECOND

UUID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}")
OUTCOMES = ("events", "fused", "rejected", "too_old", "duplicate", "invalid", "waiting", "gathered", "withheld")
HONEST = 0.95  # share of states inside their 95 % ellipse


@dataclass(frozen=True)
class Card:
    """One figure of the head of the page."""

    label: str
    value: str
    unit: str = ""
    note: str = ""
    tone: str = ""  # good, bad or neither


@dataclass(frozen=True)
class Table:
    """A table of text; the first column is aligned left."""

    title: str
    header: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Report:
    """What a report is made of."""

    config: Config
    summary: Summary
    gathered: Gathered
    trace: Trace
    tiles: str | None = None  # address of a tile server


def html(report: Report) -> str:
    """The page. The same replay gives the same page."""
    summary, gathered = report.summary, report.gathered
    stretches = summary.dead_reckoning.stretches if summary.dead_reckoning else []
    board = Board(summary.span.seconds, [(stretch.start_s, stretch.stop_s) for stretch in stretches])
    parts = list(_placed(report, board))
    panels = [panel for part in parts for panel in part.panels]
    script, divs = components({panel.name: panel.plot for panel in panels}, wrap_script=False) if panels else ("", {})
    folder = resources.files(__package__)
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((folder / "page.html").read_text(encoding="utf-8"))
    text = template.render(
        title=f"{summary.vehicle}: {_clock(summary.span.seconds)} on {_first(summary):%Y-%m-%d}",
        summary=summary,
        first=f"{_first(summary):%Y-%m-%d %H:%M:%S} UTC",
        cards=list(_cards(summary, gathered)),
        warnings=summary.warnings,
        parts=parts,
        divs=divs,
        tables={table_of: list(made) for table_of, made in _tables(summary, gathered).items()},
        events=[(f"{second:.1f}", event) for second, event in gathered.events],
        further_events=gathered.further_events,
        config=json.dumps(config_table(report.config), indent=2, default=str),
        style=(folder / "page.css").read_text(encoding="utf-8"),
        code=(folder / "page.js").read_text(encoding="utf-8"),
        bokeh=Resources(mode="inline", components=["bokeh"]).render_js(),
        script=script,
        fits=json.dumps({panel.name: _fit(panel) for panel in board.panels}).replace("<", "\\u003c"),
        policy=_policy(report.tiles),
    )
    return _with_plain_ids(text)


def _placed(report: Report, board: Board) -> Iterator[Section]:
    """The map, then all other sections; a section without plots stays where it says why."""
    words = ["Drag to move, Ctrl and wheel to zoom. Point at a plot over time to see the place here."]
    if report.trace.origin is None:
        yield Section("track", "Track", ["There was neither a state nor a fix to draw."])
    else:
        yield Section("track", "Track", words, [track_map(report.trace, report.tiles)])
    yield from sections(board, report.gathered, report.summary)


def _fit(panel: Panel) -> dict[str, object]:
    return {"curves": panel.fits, "always": panel.always, "fixed": panel.fixed}


def _policy(tiles: str | None) -> str:
    """The content security policy: nothing is loaded but tiles, where they were asked for."""
    images = "data: blob:"
    if tiles:
        place = urlsplit(tiles.replace("{", "").replace("}", ""))
        images += f" {place.scheme}://{place.netloc}"
    return f"default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; font-src data:; img-src {images}"


def _with_plain_ids(text: str) -> str:
    """Numbers in place of random identifiers, so that the same replay gives the same bytes."""
    names: dict[str, str] = {}
    return UUID.sub(lambda found: names.setdefault(found[0], f"id-{len(names) + 1}"), text)


# --- Head


def _first(summary: Summary) -> datetime:
    return datetime.fromtimestamp(summary.span.first_ns // SECOND, UTC)


def _clock(seconds: float) -> str:
    """A duration for people."""
    whole = round(seconds)
    if whole < 120:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min {rest:02d} s"


def _length(metres: float) -> tuple[str, str]:
    return (f"{metres / 1e3:.2f}", "km") if metres >= 1000 else (f"{metres:.0f}", "m")


def _cards(summary: Summary, gathered: Gathered) -> Iterator[Card]:
    note = f"{summary.published.rows} states at {summary.published.rate_hz:g} Hz" if summary.published else ""
    yield Card("Duration", _clock(summary.span.seconds), note=note)
    value, unit = _length(summary.truth.distance_m if summary.truth else gathered.distance_m)
    yield Card("Distance", value, unit, "by the truth" if summary.truth else "by the published speed")
    if truth := summary.truth:
        position = truth.position
        yield Card("Position error", f"{position.rmse_m:.2f}", "m", f"RMSE; 95 % below {position.p95_m:.2f} m")
        yield Card("Heading error", f"{truth.heading.rmse_deg:.2f}", "deg", "RMSE, mean offset removed")
        inside = position.inside_95
        yield Card("In 95 % ellipse", f"{100 * inside:.0f}", "%", "95 or more is honest", _tone(inside >= HONEST))
    elif state := summary.final.state:
        yield Card("Position sigma", f"{math.hypot(*state.sigma_position_ned_m[:2]):.2f}", "m", "horizontal, at the end")
        yield Card("Heading sigma", f"{state.sigma_yaw_deg:.2f}", "deg", "at the end")
    if reckoning := summary.dead_reckoning:
        note = f"{reckoning.count} stretch{'' if reckoning.count == 1 else 'es'} without a fix"
        yield Card("Dead reckoning", _clock(reckoning.seconds), "", note)
    offered = sum(source.events for source in summary.sources.values())
    rejected = sum(source.rejected for source in summary.sources.values())
    yield Card("Measurements", f"{offered:,}".replace(",", "\u202f"), "", f"{rejected} rejected")
    if summary.published:
        nominal = summary.published.modes.get("nominal", 0) / max(1, summary.published.rows)
        yield Card("Nominal", f"{100 * nominal:.0f}", "%", "of the published states", "" if nominal else "bad")


def _tone(good: bool) -> str:
    return "good" if good else "bad"


# --- Tables


def _tables(summary: Summary, gathered: Gathered) -> Mapping[str, Iterator[Table]]:
    return {
        "health": _outcomes(summary),
        "latencies": _late(summary, gathered),
        "calibration": _learnt(gathered),
        "errors": _reckoned(summary),
    }


def _outcomes(summary: Summary) -> Iterator[Table]:
    sources = summary.sources
    shown = [name for name in OUTCOMES if name in OUTCOMES[:3] or any(getattr(one, name) for one in sources.values())]
    rows = [[name, *(str(getattr(one, column)) for column in shown), *_late_and_odd(one)] for name, one in sources.items()]
    header = ["source", *(name.replace("_", " ") for name in shown), "median lateness [ms]", "remarks"]
    if not any(row[-1] for row in rows):
        header, rows = header[:-1], [row[:-1] for row in rows]
    yield Table("What became of the measurements", header, rows)


def _late_and_odd(source: SourceReport) -> list[str]:
    invalid = [f"{count} invalid: {reason}" for reason, count in source.invalid_reasons.items()]
    late = f"{source.latency_ms.p50:.1f}" if source.latency_ms else "-"
    return [late, "; ".join([*([source.remark] if source.remark else []), *invalid])]


def _late(summary: Summary, gathered: Gathered) -> Iterator[Table]:
    rows = [[name, *_quantiles(one.latency_ms)] for name, one in summary.sources.items()]
    yield Table("Latencies [ms]", ["source", "least", "median", "90 %", "99 %", "most"], rows)
    clocks = [
        [name, clock.method.replace("_", " "), f"{clock.drift_ppm:.1f}", f"{clock.jitter_ns / 1e6:.2f}", str(clock.resets),
         str(clock.strays), clock.note]
        for name, clock in summary.clocks.items()
    ]  # fmt: skip
    header = ["clock", "aligned by", "drift [ppm]", "jitter [ms]", "jumps", "strays", "why no better way"]
    yield Table("Clocks", header, clocks)


def _quantiles(late: Latency | None) -> list[str]:
    return [f"{value:.1f}" for value in (late.min, late.p50, late.p90, late.p99, late.max)] if late else ["-"] * 5


def _learnt(gathered: Gathered) -> Iterator[Table]:
    learnt = gathered.health.calibration if gathered.health else {}
    rows = [[name, f"{one.value:+.4g}", f"{one.sigma:.2g}"] for name, one in learnt.items()]
    if rows:
        yield Table("At the end", ["correction to the configured value", "learnt", "sigma"], rows)


def _reckoned(summary: Summary) -> Iterator[Table]:
    found = summary.dead_reckoning
    if not found or not found.stretches:
        return
    rows = []
    for one in found.stretches:
        share = "-" if one.error_m is None or not one.distance_m else f"{100 * one.error_m / one.distance_m:.2f}"
        error = "-" if one.error_m is None else f"{one.error_m:.2f}"
        rows.append([f"{one.start_s:.1f} to {one.stop_s:.1f}", f"{one.distance_m:.0f}", f"{one.sigma_m:.2f}", error, share])
    further = f", the first {len(rows)} of {found.count}" if found.count > len(rows) else ""
    header = ["seconds", "distance [m]", "sigma at the end [m]", "error at the end [m]", "% of distance"]
    yield Table(f"Dead reckoning{further}", header, rows)
