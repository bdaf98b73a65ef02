"""The fuzzers' runner: what it tells of a case that fails, and that each target runs a case."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import pytest

from tests.fuzz import __main__ as runner
from tests.fuzz.targets import TARGETS, Case, Target, Unaccounted, check


def test_a_frame_that_is_in_no_count_fails_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def case(dice: random.Random, _folder: Path) -> Case:
        check("frames", 10, 10 - (dice.random() < 0.5))
        return Case(10, Counter(read=10))

    monkeypatch.setattr(runner, "TARGETS", {"lines": Target(case, "lines", 200)})
    monkeypatch.setattr(runner.resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(runner.signal, "signal", lambda *_: None)
    monkeypatch.setattr(runner.logging, "disable", lambda: None)
    assert runner.main(["--seed", "3"]) == 1
    said = capsys.readouterr().out
    assert "seed 3" in said
    number = said.partition("FAILED: python -m tests.fuzz lines --seed 3 --case ")[2].partition("\n")[0]
    assert "Unaccounted: frames: 10 received, 9 counted" in said
    assert runner.main(["--seed", "3", "--case", number]) == 1
    with pytest.raises(Unaccounted):
        case(random.Random(f"3 lines {number}"), Path())


@pytest.mark.parametrize("name", ["can", "dbc", "toml"])
def test_a_case_is_made_by_its_dice_alone(name: str, tmp_path: Path) -> None:
    run = TARGETS[name].run
    assert run(random.Random("1"), tmp_path) == run(random.Random("1"), tmp_path)
