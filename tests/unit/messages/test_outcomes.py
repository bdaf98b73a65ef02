"""The names of outcomes."""

from __future__ import annotations

from fusiond.filter.rows import Outcome
from fusiond.messages.outcomes import NAMES


def test_outcomes_all_have_names() -> None:
    assert set(NAMES) == set(Outcome)
