"""The documentation: generated tables are up to date, links resolve, pictures are small, examples are what they say."""

import argparse
import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from fusiond.__main__ import parser
from fusiond.config import load as config
from fusiond.config import schema as sections
from fusiond.simulation import scenario
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
LARGEST_PICTURE = 150_000  # bytes
COLUMNS = 120  # of a line that is not of a table


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def anchors(page: Path) -> set[str]:
    """The anchors that a page's headings get on a code forge."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def examples(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return [body for kind, body in FENCE.findall(text) if kind == language]


@pytest.mark.parametrize("name", ["configuration.md", "simulator.md"])
def test_tables_of_keys_are_up_to_date(name: str) -> None:
    text = (DOCS / name).read_text(encoding="utf-8")
    assert load("make_configuration").page(name, text) == text, "run: python docs/make_configuration.py"


def test_the_architecture_is_up_to_date() -> None:
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    assert load("make_architecture").page(text) == text, "run: python docs/make_architecture.py"


def test_every_key_is_in_the_tables() -> None:
    text = (DOCS / "configuration.md").read_text(encoding="utf-8")
    for section in (sections.Filter, sections.Motion, sections.Gnss, sections.Wheel, sections.Record):
        assert all(f"\n| `{key}` |" in text for key in section.__struct_fields__)
    assert "`directory`" not in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_resolve(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for target in LINK.findall(text):
        if target.startswith(("http://", "https://")):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_lines_are_short(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if len(line) > COLUMNS and not line.lstrip().startswith("|")] == []


def test_every_page_is_linked_from_the_readme() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert all(f"(docs/{page.name})" in text for page in DOCS.glob("*.md"))


def test_every_command_is_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (commands,) = (action for action in parser()._actions if isinstance(action, argparse._SubParsersAction))
    assert all(f"\n| `fusiond {command}` |" in text for command in commands.choices)


def test_pictures_are_used_and_small() -> None:
    texts = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in (DOCS / "images").rglob("*.png"):
        assert f"{picture.relative_to(DOCS).as_posix()})" in texts
        assert picture.stat().st_size <= LARGEST_PICTURE


def test_the_smallest_configuration_is_valid(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").touch()
    (example,) = examples("configuration.md", "toml")
    parsed = config.parse(example, tmp_path / "car.toml")
    assert parsed.sources() == ("gps0.position", "gps0.velocity", "imu0", "rear_left")


def test_the_examples_of_the_workshop_guide_are_valid(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").touch()
    parsed = config.parse("\n".join(examples("tuning.md", "toml")), tmp_path / "car.toml")
    assert parsed.wheel["rear_left"].counter_signal == "COUNTER"
    assert parsed.parked["gear"].values == [32]


def test_the_code_of_the_walk_through_is_that_of_the_tree() -> None:
    """Each block names its file in the first line; what stands between lines of dots is in it, word for word."""
    blocks = examples("adding.md", "python")
    assert len(blocks) >= 4
    for block in blocks:
        first, *lines = block.splitlines()
        text = (ROOT / first.removeprefix("# ")).read_text(encoding="utf-8")
        for part in re.split(r"^ *\.\.\.$", "\n".join(lines), flags=re.MULTILINE):
            assert part.strip("\n") in text, f"{first}: {part}"


def test_the_walk_through_names_files_of_the_tree() -> None:
    text = (DOCS / "adding.md").read_text(encoding="utf-8")
    walk = text[text.index("## A sensor") : text.index("## An input protocol")]
    places = re.findall(r"^### (\d)\. .*, `([\w/.]+)`$", walk, re.MULTILINE)
    assert [number for number, _ in places] == ["1", "2", "3", "4", "5"]
    named = {name for _, name in places} | set(re.findall(r"`(\w[\w/]+\.py)`", walk))
    assert all((ROOT / name).is_file() for name in named)


def test_the_example_of_a_scenario_is_valid() -> None:
    (example,) = examples("simulator.md", "toml")
    assert scenario.parse(example).duration_s == 90


def test_examples_are_toml() -> None:
    for page in PAGES:
        for kind, body in FENCE.findall(page.read_text(encoding="utf-8")):
            if kind == "toml":
                assert tomllib.loads(re.sub(r"^ {3}", "", body, flags=re.MULTILINE))
