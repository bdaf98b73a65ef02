"""The README for a package index: its links lead to the repository, since files and pictures are not beside it there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
BRANCH = "main"
LINK = re.compile(r"(!?)\[((?:[^\]\\]|\\.|\](?!\())*)\]\(([^)\s]+)\)")  # picture or link, text, target
FENCED = re.compile(r"(^ *```.*?^ *```$)", re.MULTILINE | re.DOTALL)


def index_page(text: str, repository: str) -> str:
    """The text with absolute targets; blocks of code stay as they are."""

    def absolute(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if "://" in target or target.startswith(("#", "mailto:")):
            return found[0]
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/{BRANCH}/{target})"

    parts = FENCED.split(text)
    return "".join(part if FENCED.fullmatch(part) else LINK.sub(absolute, part) for part in parts)


def long_description() -> str:
    """The README of this tree, for its package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return index_page((ROOT / "README.md").read_text(encoding="utf-8"), project["urls"]["Repository"])


if __name__ == "__main__":
    print(long_description(), end="")
