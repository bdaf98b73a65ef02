"""The way of messages to the receiver: loss, jitter, reordering."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.simulation.drive import simulate
from tests.helpers.simulated import scenario


# transport
def test_loss_jitter_and_reordering() -> None:
    link = "[imu.transport]\nlatency_ms = 5.0\njitter_ms = 8.0\nloss = 0.1\nreorder = {}\n"
    mixed, ordered = (simulate(scenario(imu=link.format(word))) for word in ("true", "false"))
    for drive in (mixed, ordered):
        assert (np.diff(drive.imu.t_receive_us) >= 0).all()
        assert len(drive.imu.time_us) == pytest.approx(6001 * 0.9, rel=0.02)
    assert (np.diff(mixed.imu.time_us) < 0).mean() > 0.05 and (np.diff(ordered.imu.time_us) > 0).all()
    late_ms = (mixed.imu.t_receive_us - (mixed.imu.time_us + mixed.scenario.start_ns // 1000 - 60_000_000)) / 1e3
    assert late_ms.min() == pytest.approx(5, abs=0.1) and late_ms.mean() == pytest.approx(13, rel=0.05)
    missing = (np.diff(ordered.imu.counter) - 1) % 256
    assert (missing > 0).sum() > 400  # the link's frame counter shows the gaps
