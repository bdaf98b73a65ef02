"""What a part of the study gives: Markdown tables and small pictures, gathered into docs/study.md."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

TITLE = "# The study\n"
WIDTH_IN, HEIGHT_IN, DPI = 7.2, 2.6, 80
COLUMNS = 120  # of a paragraph


@dataclass
class Section:
    """One part's result."""

    title: str
    lines: list[str] = field(default_factory=list)
    pictures: dict[str, Any] = field(default_factory=dict)  # name: matplotlib Figure

    def say(self, text: str) -> None:
        self.lines += [textwrap.fill(text, COLUMNS, break_long_words=False, break_on_hyphens=False), ""]

    def table(self, head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        self.lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        self.lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
        self.lines.append("")

    def picture(self, name: str, about: str, figure: Any) -> None:
        self.pictures[name] = figure
        self.lines += [f"![{about}](images/study/{name}.png)", ""]

    def text(self) -> str:
        return "\n".join([f"## {self.title}", "", *self.lines])


def figure(columns: int = 1) -> tuple[Any, Any]:
    """A small matplotlib figure and its axes (an array of them for several columns)."""
    import matplotlib as mpl  # noqa: PLC0415

    mpl.use("Agg")
    import matplotlib.pyplot as plt  # noqa: PLC0415

    made, axes = plt.subplots(1, columns, figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, layout="constrained")
    for one in axes if columns > 1 else [axes]:
        one.grid(alpha=0.3)
        one.tick_params(labelsize=7)
    return made, axes


def save(sections: dict[str, Section], order: Sequence[str], folder: Path) -> None:
    """Write the sections into study.md and images/study/*.png below a folder. What stands before the first section, and the
    sections that are not in this run, stay."""
    page = folder / "study.md"
    head, *pieces = re.split(r"<!-- part: (\w+) -->\n", page.read_text(encoding="utf-8") if page.is_file() else TITLE)
    parts = dict(zip(pieces[::2], pieces[1::2], strict=True))
    parts |= {name: section.text() for name, section in sections.items()}
    body = "\n".join(f"<!-- part: {name} -->\n{parts[name].rstrip()}\n" for name in order if name in parts)
    folder.mkdir(parents=True, exist_ok=True)
    page.write_text(f"{head.rstrip()}\n\n{body}", encoding="utf-8")
    for section in sections.values():
        for name, made in section.pictures.items():
            target = folder / "images" / "study" / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            made.savefig(target)
