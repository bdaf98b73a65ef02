"""Quantiles of the latest latencies."""

from __future__ import annotations

from fusiond.messages.latency import RecentLatencies
from fusiond.messages.types import Quantiles
from fusiond.units import MILLISECOND


def test_there_are_no_quantiles_before_the_first() -> None:
    assert RecentLatencies().report() is None


def test_quantiles_are_of_the_latest_in_milliseconds() -> None:
    latencies = RecentLatencies(kept=101)
    for latency in (900, *reversed(range(101))):
        latencies.add(latency * MILLISECOND)
    assert latencies.report() == Quantiles(
        p50=50.0, p90=90.0, p99=99.0, max=100.0, count=102, sum=900.0 + sum(range(101))
    )
