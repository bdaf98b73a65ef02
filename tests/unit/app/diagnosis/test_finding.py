"""A finding has its line in the configuration, its weight decides on the exit code, and it is documented."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fusiond.app.diagnosis.finding import CONTRADICTED, NO_STATE, Finding, Weight, exit_code, lines, located
from tests.helpers.paths import ROOT


def finding(weight: Weight = "contradiction", key: str = "wheel.left.unit") -> Finding:
    return Finding(kind="wheel_unit", weight=weight, text="left reads 3.6 times too much", key=key, value='"km/h"')


@pytest.mark.parametrize(
    ("weights", "code"),
    [([], 0), (["note"], 0), (["note", "contradiction"], CONTRADICTED), (["contradiction", "no_state"], NO_STATE)],
)
def test_exit_codes(weights: list[Weight], code: int) -> None:
    assert exit_code([finding(weight) for weight in weights]) == code


def test_the_line_of_a_key(tmp_path: Path) -> None:
    file = tmp_path / "car.toml"
    file.write_text('[vehicle]\n\n[wheel.left]\nbus = "body"\nunit = "m/s"\n[wheel.right]\n')
    given, not_given, none = located([finding(), finding(key="wheel.right.unit"), finding(key="")], file)
    assert (given.place, not_given.place, none.place) == ("car.toml:5", "car.toml:6", "")
    assert list(lines([given])) == ["found: left reads 3.6 times too much", '       car.toml:5: wheel.left.unit = "km/h"']
    assert list(lines([finding("note", "")])) == ["note: left reads 3.6 times too much"]


def test_every_kind_is_documented() -> None:
    sources = "".join(path.read_text() for path in sorted((ROOT / "fusiond/app/diagnosis").glob("*.py")))
    kinds = set(re.findall(r'(?:kind=|_told\(|_none\()"(\w+)"', sources))
    documented = set(re.findall(r"`(\w+)`", (ROOT / "docs/doctor.md").read_text()))
    assert len(kinds) > 20
    assert kinds <= documented, kinds - documented
