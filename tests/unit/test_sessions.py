"""Steps back of receipt stamps, told from sources that overtake each other."""

from __future__ import annotations

from fusiond.sessions import DISORDER_NS, STEP_BACK_NS, Receipts
from fusiond.units import SECOND

T0 = 1_700_000_000 * SECOND


def received(*known: tuple[str, int]) -> Receipts:
    receipts = Receipts()
    for source, t_ns in known:
        assert not receipts.steps_back(source, t_ns)
        receipts.add(source, t_ns)
    return receipts


def test_a_source_steps_back_by_more_than_it_can_be_out_of_order() -> None:
    receipts = received(("imu0", T0))
    assert not receipts.steps_back("imu0", T0 - STEP_BACK_NS)
    assert receipts.steps_back("imu0", T0 - STEP_BACK_NS - 1)


def test_sources_overtake_each_other() -> None:
    receipts = received(("rear_left", T0 - SECOND), ("imu0", T0), ("rear_left", T0 - SECOND // 2))
    assert not receipts.steps_back("rear_left", T0 - SECOND // 2)
    assert receipts.steps_back("imu0", T0 - SECOND // 2)


def test_a_source_heard_for_the_first_time_may_be_behind_by_a_second() -> None:
    receipts = received(("imu0", T0))
    assert not receipts.steps_back("gps0.position", T0 - DISORDER_NS)
    assert receipts.steps_back("gps0.position", T0 - DISORDER_NS - 1)


def test_small_steps_add_up() -> None:
    receipts = received(("imu0", T0), ("imu0", T0 - STEP_BACK_NS // 2), ("imu0", T0 - STEP_BACK_NS))
    assert receipts.steps_back("imu0", T0 - 2 * STEP_BACK_NS)


def test_nothing_steps_back_at_the_begin_of_a_session() -> None:
    receipts = received(("imu0", T0))
    receipts.clear()
    assert not receipts.steps_back("imu0", 0)
