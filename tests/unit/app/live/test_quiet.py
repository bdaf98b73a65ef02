"""What the daemon tells while it hears nothing."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from fusiond.app.live import quiet
from fusiond.app.live.quiet import Silences
from fusiond.estimator.solution import Mode
from fusiond.units import SECOND
from tests.helpers.live import configuration, running
from tests.helpers.network import free_port


def test_silence_is_told_after_5_s_and_then_rarely() -> None:
    silences, told = Silences(), []
    for second in range(7200):
        told += [(second, *one) for one in silences.told(float(second), {"mavlink.fc"}, {"mavlink.fc": 0})]
    assert told == [(second, "mavlink.fc", second) for second in (5, 50, 500, 5000)]


def test_frames_and_a_lost_input_begin_anew() -> None:
    silences = Silences()

    def told(now_s: float, frames: int, is_open: bool = True) -> list[float]:
        found = silences.told(now_s, {"can.car"} if is_open else set(), {"can.car": frames})
        return [silent_s for _, silent_s in found]

    assert told(0.0, 0, is_open=False) == told(60.0, 0, is_open=False) == []  # the supervisor tells why
    assert told(61.0, 0) == told(65.9, 0) == []
    assert told(66.0, 0) == [5.0]
    assert told(70.0, 1) == told(74.0, 1) == []  # a frame came
    assert told(75.0, 1) == [5.0]


def test_a_daemon_that_hears_nothing_says_so_and_publishes_its_health(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quiet, "CHECK_NS", SECOND // 20)
    monkeypatch.setattr(quiet, "SILENT_NS", SECOND // 10)
    monkeypatch.setattr(quiet, "FIRST_S", 0.2)
    port = free_port()
    with caplog.at_level(logging.WARNING), running(configuration(tmp_path, f"udpin:127.0.0.1:{port}")) as run:
        run.until(lambda: run.daemon.health is not None and "nothing heard for" in caplog.text)
        health = run.daemon.health
        assert health is not None and health.mode is Mode.ALIGNING and health.uptime_s == 0.0
        assert {key: one.received for key, one in health.inputs.items()} == {"mavlink.fc": 0, "can.car": 0}
        assert not any(source.present for source in health.sources.values())
        assert f"udpin:127.0.0.1:{port}" in caplog.text and not run.messages
