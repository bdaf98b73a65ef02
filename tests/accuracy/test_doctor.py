"""The doctor names deliberate mistakes, and says nothing against right configurations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from fusiond.app.diagnosis.finding import CONTRADICTED, NO_STATE, Finding, exit_code
from fusiond.app.replay.examination import examine
from fusiond.app.replay.job import Options, replay
from fusiond.config import load as config
from tests.helpers.mistakes import CAR, RAV4, RIGHT, RIGHT_CAPTURED, SIMULATED, Case, Mistake, captured, edited

QUICK = ("a DBC without the offset", "the sensor upside down", "another system", "left and right swapped", "a gyro in deg/s")
FEW_RIGHT = 2
needs_captured = pytest.mark.skipif(not RAV4.is_dir(), reason=f"the captured drives are not in {RAV4.parent}")


def mistakes() -> list[object]:
    marks = {True: [], False: [pytest.mark.slow]}
    own = [pytest.param(one, id=one.name, marks=[needs_captured, *marks[one.name in QUICK]]) for one in CAR]
    return own + [pytest.param(one, id=one.name, marks=marks[one.name in QUICK]) for one in SIMULATED]


def right() -> list[object]:
    own = [pytest.param(make, id=name, marks=[needs_captured, *([pytest.mark.slow] * (i > 0))])
           for i, (name, make) in enumerate(RIGHT_CAPTURED)]  # fmt: skip
    return own + [
        pytest.param(make, id=name, marks=[pytest.mark.slow] * (i >= FEW_RIGHT)) for i, (name, make) in enumerate(RIGHT)
    ]


def examined(case: Case) -> list[Finding]:
    return examine(config.load(case.config), case.config.name, case.logs).findings


def test_there_are_enough_of_both() -> None:
    assert len(CAR) + len(SIMULATED) >= 20
    assert len(RIGHT) + len(RIGHT_CAPTURED) >= 20


@pytest.mark.parametrize("mistake", mistakes())
def test_a_mistake_is_named(mistake: Mistake, tmp_path: Path) -> None:
    case = mistake.make(tmp_path)
    findings = examined(case)
    assert findings, "nothing was found"
    first = findings[0]
    assert first.kind in mistake.kinds and mistake.key in first.key
    if first.weight != "note":
        assert exit_code(findings) in (NO_STATE, CONTRADICTED)
    if first.key:
        number = int(first.place.rpartition(":")[2])
        line = case.config.read_text().splitlines()[number - 1]
        table, _, key = first.key.rpartition(".")
        assert line.startswith((key, f"[{table}]", f"[{table.partition('.')[0]}"))


@pytest.mark.parametrize("make", right())
def test_nothing_is_said_of_a_right_configuration(make: Callable[[Path], Case], tmp_path: Path) -> None:
    assert examined(make(tmp_path)) == []


@needs_captured
def test_a_replay_has_the_same_findings(tmp_path: Path) -> None:
    case = edited(captured(tmp_path), ('^unit = "km/h"', 'unit = "m/s"'))
    loaded = config.load(case.config)
    assert replay(Options(loaded, case.config.name, case.logs)).findings == examined(case)
