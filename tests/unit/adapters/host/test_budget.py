"""The budget of a thread that works for readers."""

from __future__ import annotations

import pytest

from fusiond_adapters.host.budget import Budget


def test_it_rests_for_many_times_its_work() -> None:
    worked = [7.0]
    rested: list[float] = []
    budget = Budget(share=0.05, worked_s=lambda: worked[0], sleep=rested.append)
    budget.rest()
    worked[0] += 0.001
    budget.rest()
    budget.rest()
    assert rested == pytest.approx([0.0, 0.019, 0.0])
