"""The data of a picture: thinned samples, fixes by their outcome, and the cost of reading it."""

from __future__ import annotations

import pytest

from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.app.replay.trace import Thinned, Trace
from fusiond.estimator.fusion import Receipt
from fusiond.events import GnssPosition, Received
from fusiond.filter.rows import Outcome
from fusiond_adapters.logs.merge import open_logs
from tests.helpers.drive import LOGS, folder, settings


@pytest.fixture(scope="module")
def events() -> list[Received]:
    """The drive, with two fixes far off."""
    found = list(open_logs([str(folder() / log) for log in LOGS], settings()))
    fixes = [n for n, event in enumerate(found) if event.source == "gps0.position"]
    for n in fixes[-6:-4]:
        fix = found[n].payload
        assert isinstance(fix, GnssPosition)
        payload = GnssPosition(fix.latitude + 1e-4, fix.longitude, fix.height, fix.sigma_horizontal, fix.sigma_vertical)
        event = found[n]
        found[n] = Received(
            event.source, event.sequence, event.clock, event.t_sensor_ns, event.t_receive_ns, payload
        )
    return found


@pytest.mark.parametrize("rate_hz", [50.0, 0.5])
def test_every_fix_is_drawn_by_its_outcome(events: list[Received], rate_hz: float) -> None:
    trace = Trace(lambda: events[0].t_receive_ns)
    receipts: list[Receipt] = []
    task = ReplayTask(rate_hz, on_tick=[trace.add_tick], on_receipt=[trace.add_receipt, receipts.append])
    replay = Replay(settings(), task)
    replay.run(events)
    trace.read_outcomes()
    outcomes = replay.fusion.outcomes()["gps0.position"]
    assert outcomes["REJECTED"] == 2
    assert len(trace.rejected.items) == 2
    assert len(trace.fixes.items) + 2 == sum(outcomes.values()) == sum(
        receipt.measurement.source == "gps0.position" and receipt.refusal is not Outcome.INVALID for receipt in receipts
    )


def test_it_causes_no_rewind(events: list[Received]) -> None:
    rerun = []
    for traced in (False, True):
        trace = Trace(lambda: events[0].t_receive_ns)
        task = ReplayTask(50.0, on_tick=[trace.add_tick], on_receipt=[trace.add_receipt] if traced else [])
        replay = Replay(settings(), task)
        replay.run(events)
        rerun.append(replay.fusion.history.rerun)
    assert rerun[0] == rerun[1] > 0


def test_thinning_keeps_every_nth() -> None:
    thinned: Thinned[int] = Thinned(8)
    for number in range(100):
        thinned.add(number)
    assert thinned.items == list(range(0, 100, 16))
