"""The smoother against the filter on simulated drives with an outage of a minute: seeded Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.study.smoothing import BEFORE_S, BLOCKS, OUTAGE_S, one
from tests.conftest import needs_compiled

RUNS = 4
TIMES_BETTER = 3.0  # root mean square errors in the outage
INDEPENDENT = 12  # instants of a drive whose errors are not alike: they last for some 15 s


@needs_compiled
@pytest.mark.slow
def test_an_outage_of_a_minute() -> None:
    """A third of the filter's error at most, and a covariance that holds it."""
    runs = [one([11, run]) for run in range(RUNS)]
    inside = (runs[0].t >= BEFORE_S) & (runs[0].t < BEFORE_S + OUTAGE_S)
    filtered, smoothed = (
        float(np.sqrt(np.mean([getattr(run, kind)[inside] ** 2 for run in runs]))) for kind in ("filtered", "smoothed")
    )
    assert smoothed * TIMES_BETTER < filtered
    assert np.mean([run.smoothed[~inside] for run in runs]) < np.mean([run.filtered[~inside] for run in runs])
    for name, block in BLOCKS.items():
        freedom = len(range(*block.indices(9)))
        band = 3 * np.sqrt(2 / (freedom * RUNS * INDEPENDENT))  # three sigmas of a mean of chi squares
        assert np.mean([run.nees[name] for run in runs]) == pytest.approx(freedom, rel=band), name
