"""Write the table of layers and the listing of files into docs/architecture.md: python docs/make_architecture.py"""

from __future__ import annotations

import ast
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
WIDTH = 120
sys.path.insert(0, str(ROOT))

from tests.helpers.paths import ROOTS  # noqa: E402
from tests.unit.project.test_layers import ACROSS, LAYERS, NEVER  # noqa: E402 - the table is that test's

SOURCES = {".py", ".pyx", ".pxi", ".pxd"}


def page(text: str) -> str:
    """The text of architecture.md, with its generated parts renewed."""
    for name, body in (("layers", layers()), ("files", files())):
        part = re.compile(rf"(<!-- {name}, generated -->\n).*?(<!-- end -->)", re.DOTALL)
        text = part.sub(lambda found, body=body: f"{found[1]}\n{body}\n{found[2]}", text)  # type: ignore[misc]
    return text


def layers() -> str:
    """The layers as a numbered list, and the exceptions."""
    lines = []
    for number, entries in enumerate(LAYERS, 1):
        if len(entries) > 1:
            lines.append(f"{number}. do not import each other:")
        for entry in entries:
            bullet = f"{number}." if len(entries) == 1 else "   -"
            lines += _wrapped(f"{bullet} `{entry}`: {said(source(entry))}", " " * (len(bullet) + 1))
    lines += ["", "Folders of one protocol that import another's:", ""]
    lines += [f"- `{one}` imports `{other}`: {why}." for (one, other), why in ACROSS.items()]
    lines += ["", "Forbidden although the order would allow it:", ""]
    lines += [f"- `{one}` imports `{other}`: {why}." for (one, other), why in NEVER.items()]
    return "\n".join((*lines, ""))


def files() -> str:
    """Every source file, in the order of the layers; in a layer by folder and name."""
    lines: list[str] = []
    for entries in LAYERS:
        for entry in entries:
            path = source(entry)
            if path.name != "__init__.py" or entry == "fusiond":
                lines += _item(path)
                continue
            for folder in sorted({path.parent, *(found.parent for found in path.parent.rglob("*") if _is_source(found))}):
                marker = folder / "__init__.py"
                lines += ["", *_wrapped(f"**{_named(folder)}/** {said(marker)}", ""), ""]
                found = sorted(each for each in folder.iterdir() if _is_source(each) and each != marker)
                lines += [line for each in found for line in _item(each)]
                lines.append("")
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip() + "\n"


def source(entry: str) -> Path:
    """The file of a module, or of a package its __init__."""
    first, *rest = entry.split(".")
    path = ROOTS[first].joinpath(*rest)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def said(path: Path) -> str:
    """The first sentence of a file's docstring."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        about = ast.get_docstring(ast.parse(text)) or ""
    else:
        found = re.match(r'(?:#[^\n]*\n)*\s*"""(.*?)"""', text, re.DOTALL)
        about = found[1] if found else "\n".join(line.removeprefix("#") for line in _leading_comment(text))
    first = " ".join(about.split("\n\n")[0].split())
    sentence = re.split(r"(?<=[.!?])\s", first)[0]
    return sentence if sentence.endswith((".", "?")) else f"{sentence.rstrip(':;')}."


def _leading_comment(text: str) -> Iterator[str]:
    for line in text.splitlines():
        if not line.startswith("#"):
            return
        if not line.startswith(("# cython:", "# distutils:")):
            yield line


def _is_source(path: Path) -> bool:
    return path.suffix in SOURCES and path.is_file()


def _named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _item(path: Path) -> list[str]:
    return _wrapped(f"- `{_named(path) if path.parent == ROOTS['fusiond'] else path.name}`: {said(path)}", "  ")


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
