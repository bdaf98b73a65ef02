"""The local frame that an autopilot is sent positions in: its origin from run to run, and the counter of jumps."""

from __future__ import annotations

import pytest

from fusiond.ports.outputs import KeptFrame
from fusiond.units import SECOND
from fusiond_adapters.mavlink.outgoing import CONVENTIONS, Origin
from fusiond_adapters.mavlink.shared_frame import SharedFrame
from tests.helpers.mavlink_peers import state_at, state_of

PROJECT = CONVENTIONS["px4"].project
HERE = state_of(state_at(0))


def test_the_first_state_then_the_reported_origin_for_good() -> None:
    kept = KeptFrame()
    frame = SharedFrame(kept, PROJECT, 0)
    assert frame.origin is None and not frame.is_reported
    first = frame.at(HERE, None, 0.0)
    assert first == Origin.of(HERE) == kept.origin
    assert frame.at(state_of(state_at(0, 5)), None, 0.0) == first
    theirs = Origin(HERE.lat_deg + 0.01, HERE.lon_deg, 500.0)
    before = frame.count(0)
    assert frame.at(HERE, theirs, 47.5) == (theirs.latitude_deg, theirs.longitude_deg, 547.5) == kept.origin
    assert frame.is_reported and frame.count(0) == before + 1
    assert frame.at(HERE, theirs, 48.0).height_m == 547.5  # the geoid is another further on, the origin is not
    assert frame.count(3) == before + 4 == kept.reset_counter


def test_an_origin_that_is_ours_but_for_rounding_is_no_jump() -> None:
    frame = SharedFrame(KeptFrame(), PROJECT, 0)
    ours = frame.at(HERE, None, 0.0)
    before = frame.count(0)
    rounded = Origin(round(ours.latitude_deg, 7), round(ours.longitude_deg, 7), round(ours.height_m, 2))
    assert frame.at(HERE, rounded, 0.0) == ours
    assert frame.count(0) == before


@pytest.mark.parametrize(("north_deg", "used"), [(0.1, True), (1.0, False)])
def test_the_last_run_s_origin_is_used_if_it_is_not_far_away(north_deg: float, used: bool) -> None:
    last = Origin(HERE.lat_deg + north_deg, HERE.lon_deg, 0.0)
    assert SharedFrame(KeptFrame(last, 7), PROJECT, 0).at(HERE, None, 0.0) == (last if used else Origin.of(HERE))


@pytest.mark.parametrize("last", [0, 7, 127, 128, 255])
def test_the_counter_begins_half_way_round(last: int) -> None:
    """Unlike the last run's, whatever that counted after it was kept."""
    kept = KeptFrame(None, last)
    begin = SharedFrame(kept, PROJECT, 0).count(0)
    assert begin == kept.reset_counter
    assert begin not in {(last + since) % 256 for since in range(100)}


def test_without_a_last_run_the_counter_begins_with_the_time() -> None:
    counters = {SharedFrame(KeptFrame(), PROJECT, start_ns * SECOND // 10).count(0) for start_ns in range(1000, 1256)}
    assert counters == set(range(256))
