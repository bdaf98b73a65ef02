"""What a report gathers of a drive: gates, rejections, latencies, calibration, modes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.app.report.gathered import Gathered
from fusiond.messages.types import InnovationMessage
from fusiond.units import MILLISECOND
from tests.helpers import drive

CHI_SQUARE_2 = 13.8155  # 0.999, two degrees of freedom: tables
CHI_SQUARE_1 = 10.8276


def innovation(t_ms: int, innovation: tuple[float, ...], variance: tuple[float, ...], outcome: str) -> InnovationMessage:
    return InnovationMessage(
        vehicle="v", source="one", t_ns=t_ms * MILLISECOND, t_receive_ns=t_ms * MILLISECOND, outcome=outcome,
        test_ratio=0.5, innovation=innovation, variance=variance,
    )  # fmt: skip


def test_a_gate_is_the_half_width_of_what_passes() -> None:
    gathered = Gathered(drive.settings(), lambda: 1000 * MILLISECOND)
    gathered.add_message(innovation(1500, (0.1, -0.2), (4.0, 9.0), "fused"))
    gathered.add_message(innovation(1600, (0.1,), (0.25,), "rejected"))
    curves = gathered.innovations["one"].curves()
    assert curves["t"].tolist() == [0.5, 0.6]
    assert curves["first_gate"] == pytest.approx([2 * math.sqrt(CHI_SQUARE_2), 0.5 * math.sqrt(CHI_SQUARE_1)], rel=1e-5)
    assert curves["second_gate"][0] == pytest.approx(3 * math.sqrt(CHI_SQUARE_2), rel=1e-5)
    assert np.isnan(curves["third"]).all() and np.isnan(curves["second"][1])
    assert gathered.rejected["one"].curves()["t"].tolist() == [0.6]


def test_all_of_a_drive_is_there() -> None:
    messages = drive.messages()
    gathered = Gathered(drive.settings(), lambda: messages[0].t_ns)  # type: ignore[attr-defined]
    for message in messages:
        gathered.add_message(message)
    tested = {message.source for message in messages if isinstance(message, InnovationMessage) and message.innovation}
    assert set(gathered.innovations) == tested and "rear_left" in tested
    assert "wheel_scale" in gathered.calibrations and len(gathered.calibrations["wheel_scale"]) >= 8
    assert [span.value for span in gathered.statuses["gps0.position"].items][-1] == "absent"  # its outage
    assert gathered.events and gathered.health is not None
