"""Rules of the project: packages are listed, every module says what it is for, the bundled drive is up to date."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusiond.app.demo import demo
from fusiond.simulation import matching, scenario
from fusiond.units import nanoseconds
from tests.helpers.paths import ROOT, ROOTS

MODULES = sorted(path for root in ROOTS.values() for path in root.rglob("*.py"))


def packages() -> Iterator[str]:
    for name, root in ROOTS.items():
        for marker in root.rglob("__init__.py"):
            yield ".".join([name, *marker.parent.relative_to(root).parts])


def test_every_package_on_disk_is_installed() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert sorted(settings["tool"]["setuptools"]["packages"]) == sorted(packages())


def test_every_folder_with_code_is_a_package() -> None:
    assert {path.parent for path in MODULES} == {path.parent for path in MODULES if path.name == "__init__.py"}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_says_what_it_is_for(path: Path) -> None:
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    assert text, f"{path.name} has no docstring"
    assert text.split("\n\n")[0].rstrip().endswith((".", ":")) or len(text.splitlines()[0]) > 20


def test_the_bundled_drive_is_complete_small_and_up_to_date() -> None:
    names = {*demo.LOGS, "wheels.dbc", "fusiond.toml", "truth.csv.gz"}
    files = {path.name: path for path in demo.DRIVE.iterdir()}
    assert set(files) == names
    assert sum(path.stat().st_size for path in files.values()) < 700_000
    drive = scenario.load(ROOT / "configs" / "simulate-demo.toml")
    again = "; run `make demo-data` again"
    assert files["fusiond.toml"].read_text(encoding="utf-8") == matching.configuration(drive, "wheels.dbc"), again
    assert files["wheels.dbc"].read_text(encoding="utf-8") == matching.dbc(drive), again
    assert nanoseconds(drive.duration_s) == demo.LENGTH_NS
