"""The summary of a batch as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median

from fusiond.app.batch.findings import SOME, Findings, Worst
from fusiond.app.batch.significance import FIGURES, RISK, Comparison, Paired
from fusiond.app.replay.summary import table

ABOUT = {figure.name: figure for figure in FIGURES}
VERDICTS = {
    "worse": "NEW is significantly worse",
    "better": "NEW is significantly better",
    "no difference": "no significant difference",
}


def text(found: Findings) -> str:
    """The whole summary."""
    return "\n".join(_lines(found))


def _lines(found: Findings) -> Iterator[str]:
    counts = ", ".join(f"{count} {status}" for status, count in sorted(found.statuses.items(), key=lambda one: -one[1]))
    yield f"{found.drives} drives: {counts or 'none'}; {found.seconds / 3600:.1f} h, {found.kilometres:.0f} km"
    for reason, count in sorted(found.reasons.items(), key=lambda one: (-one[1], one[0]))[:SOME]:
        yield f"  {count} x {reason}"
    if found.examples:
        yield f"  such as {', '.join(drive for drive, _ in found.examples)}"
    if found.comparison is not None:
        yield ""
        yield from _comparison(found.comparison, found.unpaired)
    elif found.values:
        yield ""
        yield from table([["median", "", "unit", "drives"], *map(list, _medians(found))])
    if found.worst:
        yield ""
        yield "worst drives" if found.comparison is None else "worst drives, by NEW over the baseline"
        yield from table([HEADS, *(list(cells(one)) for one in found.worst)])


HEADS = ["drive", "figure", "baseline", "new", "ratio"]


def compared(found: Findings) -> str:
    """Only the comparison."""
    return "\n".join(_comparison(found.comparison, found.unpaired)) if found.comparison else ""


def _medians(found: Findings) -> Iterator[tuple[str, str, str, str]]:
    for name, values in found.values.items():
        yield f"  {ABOUT[name].about}", number(median(values["new"])), ABOUT[name].unit, str(len(values["new"]))


def _comparison(compared: Comparison, unpaired: int) -> Iterator[str]:
    yield from table([["median over drives", *COLUMNS], *(list(paired(one)) for one in compared.figures)])
    if compared.only_baseline or compared.only_new:
        yield (
            f"  {compared.only_baseline} drives are ok by the baseline only, {compared.only_new} by NEW only"
            f" (p {compared.p_fails:.2g})"
        )
    if unpaired:
        yield f"  {unpaired} drives have no row in the baseline"
    yield f"{VERDICTS[compared.verdict]} (signed-rank tests of pairs of drives, risk {100 * RISK:g} % over all figures)"


COLUMNS = ["baseline", "new", "change", "drives", "better", "worse", "p worse", "verdict"]


def paired(one: Paired) -> Iterator[str]:
    """The cells of one figure, for COLUMNS."""
    figure = ABOUT[one.figure]
    yield f"  {figure.about}{f' [{figure.unit}]' if figure.unit else ''}"
    yield from (number(one.baseline), number(one.new))
    yield "-" if one.change is None else f"{100 * one.change:+.2f} %"
    yield from (str(one.pairs), str(one.better), str(one.worse), f"{one.p_worse:.2g}", one.verdict)


def cells(one: Worst) -> Iterator[str]:
    """The cells of one of the worst drives, for HEADS."""
    about = ABOUT[one.figure].about if one.figure in ABOUT else one.figure
    ratio = f"{one.badness:.2f}" if one.baseline else "-"
    yield from (f"  {one.drive}", about, number(one.baseline), number(one.new), ratio)


def number(value: float | None) -> str:
    """Four digits."""
    return "-" if value is None else f"{value:.4g}"
