"""The test of a module is found by its name: tests/unit/a/test_b.py tests fusiond/a/b.py. Exceptions are listed here."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

UNIT = ROOT / "tests" / "unit"
FOLDERS = {"adapters": ROOT / "adapters", "oracles": ROOT / "tests" / "oracles", "tools": ROOT / "tools"}  # else fusiond
SCENARIOS = {  # tests of several modules together, and which
    "adapters/can/test_car.py": "the car's own sensors, and a direction out of another frame, by way of the decoder",
    "adapters/can/test_presets.py": "the sample configurations of cars, by way of decoder and check",
    "adapters/logs/test_captured_logs.py": "real recordings through readers and decoders",
    "adapters/mavlink/test_peers.py": "an autopilot made of pymavlink against the daemon",
    "adapters/test_outputs.py": "outputs under the daemon: supervision, isolation, and what is published",
    "config/test_autopilots.py": "the configurations for autopilots, and the autopilots' parameters beside them",
    "app/report/test_in_a_browser.py": "a whole report in a headless browser",
    "adapters/zenoh/test_security.py": "the sample configurations for TLS and access control",
    "adapters/zenoh/test_yard.py": "the sample configuration of a router for many vehicles",
    "app/commands/test_command_line.py": "all commands, by their command lines",
    "app/commands/test_commands.py": "what every command has in common",
    "app/commands/test_inspecting.py": "the commands that look at logs and begin a configuration",
    "app/live/test_hostile.py": "the daemon among hostile processes: UDP, signing, network namespace",
    "filter/observations/test_observations.py": "every observation model of the table",
    "filter/test_closed_forms.py": "decisions of the filter against the closed forms of tests/oracles",
    "filter/kernel/test_generated.py": "what tools/translate_kernel made, against what it would make",
    "filter/kernel/test_whole_drives.py": "both kernels over whole drives",
    "timeline/test_clock_jumps.py": "timeline/clock.py and aligner.py when clocks jump, stray, stall and reboot",
}
FILES = sorted(path for path in UNIT.rglob("test_*.py") if path.parent.name != "project")


def relative(path: Path) -> str:
    return path.relative_to(UNIT).as_posix()


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_a_test_is_named_after_its_module(path: Path) -> None:
    first, *rest = path.relative_to(UNIT).parts
    folder = FOLDERS[first].joinpath(*rest[:-1]) if first in FOLDERS else (ROOT / "fusiond" / relative(path)).parent
    name = path.stem.removeprefix("test_")
    exists = (folder / ("__init__.py" if name == "init" else f"{name}.py")).is_file()
    assert exists != (relative(path) in SCENARIOS), f"{folder.name}/{name}.py"


def test_every_scenario_exists_and_says_what_it_is() -> None:
    for name in SCENARIOS:
        assert ast.get_docstring(ast.parse((UNIT / name).read_text(encoding="utf-8"))), name


@pytest.mark.parametrize("path", [*FILES, *(ROOT / "tests" / "helpers").glob("*.py")], ids=lambda path: path.stem)
def test_helpers_come_from_the_folder_of_helpers(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert not node.module.startswith("tests.unit"), f"imports {node.module}"
