"""What the installed service is made of: lock files with hashes, a manual page, the licences of all libraries."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib

import pytest

from fusiond.app.commands import COMMANDS
from tests.helpers.paths import ROOT

PACKAGING = ROOT / "packaging"
ENTRY = re.compile(r"([a-z0-9-]+)==([0-9.]+)((?: ;[^\\]*)?) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)")
LOCKS = {"requirements.txt": "dependencies", "build-requirements.txt": "requires"}


def wanted(lock: str) -> list[str]:
    """What pyproject.toml asks for; the service has the library of its Prometheus output, too."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    section = project["project"] if lock == "requirements.txt" else project["build-system"]
    outputs = project["project"]["optional-dependencies"]["prometheus"] if lock == "requirements.txt" else []
    return [*section[LOCKS[lock]], *outputs]


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_names_everything_with_hashes_and_no_host(lock: str) -> None:
    text = (PACKAGING / lock).read_text(encoding="utf-8")
    assert ENTRY.sub("", text) == ""
    versions = {name: version for name, version, *_ in ENTRY.findall(text)}
    for requirement in wanted(lock):
        name, _, least = requirement.partition(">=")
        found = versions[name.lower()]
        assert tuple(map(int, found.split("."))) >= tuple(map(int, least.split("."))), requirement


def test_every_configuration_is_installed_with_the_files_that_it_names() -> None:
    """The autopilot's parameters and the DBC file beside it."""
    script = (PACKAGING / "stage.sh").read_text(encoding="utf-8")
    patterns = re.findall(r"configs/\*\.\w+", script)
    installed = {path.name for pattern in patterns for path in ROOT.glob(pattern)}
    assert installed == {path.name for path in (ROOT / "configs").iterdir() if path.is_file()}


def printed(script: str, *arguments: str) -> str:
    command = [sys.executable, str(PACKAGING / script), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_the_manual_page_has_every_command_and_its_options() -> None:
    page = printed("man_page.py")
    for name in COMMANDS:
        assert f".SS fusiond {name}\n" in page
    assert "\\-\\-config C.toml" in page
    requests = {line.split()[0] for line in page.splitlines() if line.startswith((".", "'"))}
    assert requests == {".TH", ".SH", ".SS", ".TP", ".B", ".I", ".RI", ".BR", ".br"}


def test_every_library_has_its_licence() -> None:
    import numpy  # noqa: PLC0415 - for where the libraries lie

    text = printed("licences.py", str(next(iter(numpy.__path__)).rpartition("/")[0]))
    paragraphs = {}
    for part in text.split("\n\n"):
        if found := re.search(r"Comment:\n ([\w.-]+) [\d.]+", part):
            paragraphs[re.sub("[-_.]+", "-", found[1]).lower()] = part
    for name, *_ in ENTRY.findall((PACKAGING / "requirements.txt").read_text(encoding="utf-8")):
        assert re.search(r"^License: (?!see).+", paragraphs[name], re.MULTILINE), name
    assert "left out of this copy" in paragraphs["pymavlink"]


def test_links_and_pictures_work_on_a_package_index() -> None:
    """All of them lead to the repository; what they name is there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    repository = project["urls"]["Repository"]
    page = re.sub(r"^ *```.*?^ *```$", "", printed("readme.py"), flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"(!?)\[(?:[^\]\\]|\\.|\](?!\())*\]\(([^)\s]+)\)", page)
    own = [(picture, target) for picture, target in links if target.startswith(f"{repository}/")]
    assert len(own) > 50 and all("://" in target for _, target in links)
    for picture, target in own:
        kind, branch, file = target.removeprefix(f"{repository}/").split("/", 2)
        assert (kind, branch) == ("raw" if picture else "blob", "main")
        assert (ROOT / file.partition("#")[0]).exists(), target
    assert {picture for picture, _ in own} == {"!", ""}


def test_the_project_says_where_it_is_and_which_pythons_it_runs_on() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert {"Homepage", "Repository", "Documentation", "Changelog", "Issues"} == set(project["project"]["urls"])
    built = {f"{name[2]}.{name[3:5]}" for name in project["tool"]["cibuildwheel"]["build"]}
    named = {name.rpartition(" :: ")[2] for name in project["project"]["classifiers"] if ":: 3." in name}
    assert named == built
