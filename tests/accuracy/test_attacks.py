"""The worst of the study's attacks, each in one drive: what it may cost, and GNSS trusted again soon after it."""

from __future__ import annotations

import pytest

from benchmarks.study.attacks import ATTACKS, BACK_S, attacked, kept
from tests.conftest import needs_compiled

RUNS = {  # of the study, with seed 1
    "one sample: gyro x 5 rad/s": 1,
    "one sample: gyro z 5 rad/s": 1,
    "one sample: all gyros 34.9 rad/s": 0,
    "one sample: all accelerometers 159 m/s2": 0,
    "five samples: all gyros 5 rad/s": 0,
    "gyro x +0.2 rad/s for 1 s": 0,
    "gyro z +0.2 rad/s for 1 s": 0,
    "gyro z bias step 0.02 rad/s": 1,
    "accelerometer x +2 m/s2 for 1 s": 0,
    "spoof, position only, 0.2 m/s": 1,
    "spoof, position only, 2.0 m/s": 0,
    "spoof, velocity too, 0.5 m/s": 1,
    "spoof, step of 3 m, then 0.3 m/s, velocity too": 1,
    "jump of 100 m held for 180 s": 0,
    "forged wheel frames for 8 s": 2,
}


@needs_compiled
@pytest.mark.parametrize("name", RUNS)
def test_worst_attacks(name: str) -> None:
    _, found = attacked(name, 1, RUNS[name])
    assert kept(ATTACKS[name], found) and found.back < BACK_S, found
