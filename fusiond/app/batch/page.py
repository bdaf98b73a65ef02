"""The summary of a batch as one HTML file that opens without a network: tables, distributions, links to the worst drives."""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from fusiond.app.batch.findings import Findings
from fusiond.app.batch.summary import ABOUT, COLUMNS, HEADS, VERDICTS, cells, paired

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 68rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.1rem; margin-top: 2rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #ddd }
th:first-child, td:first-child { text-align: left }
.worse, .failed { color: #b3400c; font-weight: 600 } .better, .ok { color: #00734f; font-weight: 600 }
figure { display: inline-block; margin: 0 1rem 1rem 0 } p.verdict { font-size: 1.15rem }
"""
CLASS = {"worse": "worse", "better": "better", "no difference": ""}
BLUE, GREY = "#0072B2", "#808080"
SIZE = (4.6, 3.0)  # inches


def page(found: Findings, title: str, links: Mapping[str, str]) -> str:
    """The file. `links` are those to the reports of the worst drives, by drive."""
    body = "\n".join(_body(found, title, links))
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _body(found: Findings, title: str, links: Mapping[str, str]) -> Iterator[str]:
    yield f"<h1>{html.escape(title)}</h1>"
    yield f"<p>{found.drives} drives, {found.seconds / 3600:.1f} h, {found.kilometres:.0f} km</p>"
    if found.comparison is not None:
        verdict = found.comparison.verdict
        yield f'<p class="verdict {CLASS[verdict]}">{VERDICTS[verdict]}</p>'
    yield "<h2>What became of the drives</h2>"
    yield from _table(["", "drives"], ([status, str(count)] for status, count in sorted(found.statuses.items())))
    if found.reasons:
        yield from _table(["reason", "drives"], ([reason, str(count)] for reason, count in found.reasons.most_common()))
    if found.comparison is not None:
        yield "<h2>Both configurations</h2>"
        yield from _table(["median over drives", *COLUMNS], (list(paired(one)) for one in found.comparison.figures))
        only = found.comparison
        yield f"<p>{only.only_baseline} drives are ok by the baseline only, {only.only_new} by the new one only;"
        yield f" {found.unpaired} have no row in the baseline.</p>"
    if found.worst:
        yield "<h2>Worst drives</h2>"
        yield from _table(HEADS, (list(cells(one)) for one in found.worst), links)
    if found.values:
        yield "<h2>Distributions over the drives</h2>"
        yield from _pictures(found)


def _table(heads: Iterable[str], rows: Iterable[list[str]], links: Mapping[str, str] | None = None) -> Iterator[str]:
    """A table; the first cell of a row is a link if there is one for it."""
    yield "<table><tr>" + "".join(f"<th>{html.escape(head)}</th>" for head in heads) + "</tr>"
    for first, *others in rows:
        name, where = html.escape(first.strip()), (links or {}).get(first.strip())
        first_cell = f'<a href="{html.escape(where)}">{name}</a>' if where else name
        rest = "".join(f'<td class="{CLASS.get(cell, "")}">{html.escape(cell)}</td>' for cell in others)
        yield f"<tr><td>{first_cell}</td>{rest}</tr>"
    yield "</table>"


def _pictures(found: Findings) -> Iterator[str]:
    """The share of drives below each value, as SVG. Needs the extra `plot`."""
    try:
        import matplotlib as mpl  # noqa: PLC0415 - slow to import
        from matplotlib.backends.backend_svg import FigureCanvasSVG  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ModuleNotFoundError:
        yield "<p>Plots need the extra plot: pip install 'fusiond[plot]'</p>"
        return
    with mpl.rc_context({"svg.hashsalt": "fusiond", "font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        for name, roles in found.values.items():
            figure = Figure(figsize=SIZE, layout="constrained")
            FigureCanvasSVG(figure)
            axes: Any = figure.add_subplot()
            for role, colour in (("baseline", GREY), ("new", BLUE)):
                if values := roles.get(role):
                    axes.ecdf(values, label=role, color=colour)
            about = ABOUT[name]
            positive = min(min(values) for values in roles.values() if values) > 0
            axes.set(xlabel=f"{about.about} [{about.unit or '1'}]", ylabel="share of drives", ylim=(0, 1))
            axes.set_xscale("log" if positive else "linear")
            axes.legend(frameon=False)
            axes.grid(alpha=0.3)
            file = io.StringIO()
            figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
            svg = file.getvalue()
            yield f"<figure>{svg[svg.index('<svg') :]}</figure>"
