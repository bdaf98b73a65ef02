"""The host's time line when the wall clock is set, and stamps of other clocks."""

from __future__ import annotations

import pytest

from fusiond.units import MILLISECOND as MS
from fusiond.units import SECOND
from fusiond_adapters.host.clock import HostClock


def test_kernel_stamps_on_the_time_line_through_a_clock_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monotonic, wall = 5 * SECOND, 1_700_000_000 * SECOND
    monkeypatch.setattr("time.monotonic_ns", lambda: monotonic)
    monkeypatch.setattr("time.time_ns", lambda: wall)
    clock = HostClock()
    assert clock.now_ns() == wall
    assert clock.from_wall_ns(wall - 3 * MS) == wall - 3 * MS
    before = clock.now_ns()
    wall += 3600 * SECOND  # the clock is set forward
    assert clock.now_ns() == before
    assert clock.from_wall_ns(wall - 3 * MS) == before - 3 * MS
    assert clock.from_wall_ns(wall - 3600 * SECOND) == before  # stamped before the step
    assert clock.from_wall_ns(12_345) == before  # of another clock
    wall -= 7200 * SECOND  # and back
    assert clock.now_ns() == before
    assert clock.from_wall_ns(wall - 3 * MS) == before - 3 * MS
