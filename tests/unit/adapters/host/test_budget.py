"""The budget of a thread that works for readers."""

from __future__ import annotations

import pytest

from fusiond_adapters.host.budget import Budget


def test_it_rests_for_many_times_its_work() -> None:
    worked = [7.0]
    budget = Budget(share=0.05, worked_s=lambda: worked[0])
    assert budget.rest_s() == 0.0
    worked[0] += 0.001
    assert budget.rest_s() == pytest.approx(0.019)
    assert budget.rest_s() == 0.0
