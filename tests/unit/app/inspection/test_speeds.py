"""CAN frames that look like speeds: by the presets, and by how they follow the speed of GNSS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusiond.app.inspection.speeds import speeds
from fusiond_adapters.logs.survey import survey

T0 = 1_700_000_000


def speed(t_s: float) -> float:
    return float(10 + 6 * np.sin(t_s / 5))  # m/s


def test_a_preset_and_a_field_that_is_in_none(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    lines = []
    for n in range(600):
        t_s = n / 10
        toyota = round((speed(t_s) * 3.6 + 67.67) * 100)
        lines.append(f"({T0 + t_s:.6f}) can0 0AA#{f'{toyota:04X}' * 4}")
        lines.append(f"({T0 + t_s + 0.001:.6f}) can0 321#{random.integers(256):02X}{round(speed(t_s) * 500):04X}")
        lines.append(f"({T0 + t_s + 0.002:.6f}) can0 400#{random.bytes(8).hex()}")
    path = tmp_path / "drive.log"
    path.write_text("\n".join(lines) + "\n")
    t = np.arange(0, 60, 0.2)
    gnss = np.stack([T0 + t, [speed(one) for one in t]], 1)
    first, second = speeds(survey(path), gnss, [])
    assert (first.preset, first.name, first.channel) == ("toyota", "0x0AA", "can0")
    assert first.factor == pytest.approx(1.0, abs=0.005)
    assert (second.preset, second.name, second.what) == ("", "0x321", "bytes 1-2 big-endian")
    assert [one.preset for one in speeds(survey(path), gnss, [(0x321, False)])] == ["toyota"]
    without = speeds(survey(path), np.zeros((0, 2)), [])
    assert [(one.preset, one.correlation) for one in without] == [("toyota", None)]
    wrong = np.stack([gnss[:, 0], gnss[::-1, 1] ** 2], 1)
    assert speeds(survey(path), wrong, []) == []
