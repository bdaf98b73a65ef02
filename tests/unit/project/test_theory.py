"""docs/theory.md: it has every row that the code cites, and every module, function and test that it names exists."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

TEXT = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| ([A-E]\d?) \|", TEXT, re.MULTILINE)
NAMES = re.findall(r"`([^` ]+)`", TEXT)
TESTS = sorted({name for name in NAMES if re.fullmatch(r"test_\w+", name)})
FUNCTIONS = sorted({name for name in NAMES if re.fullmatch(r"\w+(\.\w+){2,}", name)})
EVERY_ROW = [*(f"A{n}" for n in range(1, 8)), *(f"B{n}" for n in range(1, 8)), "C1", "C2", "C3"]
EVERY_ROW += [*(f"D{n}" for n in range(1, 6)), "E"]


def defined(file: Path) -> set[str]:
    """The functions and classes of a module."""
    kinds = ast.FunctionDef | ast.ClassDef
    return {node.name for node in ast.parse(file.read_text(encoding="utf-8")).body if isinstance(node, kinds)}


def test_each_row_is_there_once() -> None:
    assert ROWS == EVERY_ROW


def test_every_row_that_the_code_cites_is_there() -> None:
    files = [file for folder in ("fusiond", "adapters", "tests") for file in (ROOT / folder).rglob("*.p*")]
    texts = [file.read_text(encoding="utf-8") for file in files if file.suffix in {".py", ".pyx", ".pxi"}]
    lists = [found for text in texts for found in re.findall(r"THEORY ([A-E]\d?(?:, [A-E]\d?)*)", text)]
    cited = {row for found in lists for row in found.split(", ")}
    assert {"B5", "D1", "D2"} <= cited <= set(ROWS)


def test_every_test_that_is_named_exists() -> None:
    assert set(TESTS) <= {name for file in (ROOT / "tests").rglob("test_*.py") for name in defined(file)}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_that_is_named_exists(name: str) -> None:
    module, _, function = name.rpartition(".")
    assert function in defined((ROOT / "fusiond" / module.replace(".", "/")).with_suffix(".py"))


def test_names_were_found() -> None:
    assert len(TESTS) > 30
    assert len(FUNCTIONS) > 15
