"""One clock's alignment: how fast the shift moves, stamps that do not fit, and a boot clock that aligns the Unix clock."""

from __future__ import annotations

from itertools import pairwise

import pytest

from fusiond.timeline.aligner import Aligner
from tests.helpers.clocks import MS, SECOND, T0, YEAR

SOURCE = "imu0"


def boot_aligner() -> Aligner:
    """One that knows nothing of Unix time: the least offset alone."""
    return Aligner(Aligner(None))


def test_the_shift_slews_by_a_twentieth_of_the_elapsed_time() -> None:
    aligner = boot_aligner()
    shifts = []
    for k in range(400):
        stamp = 100 * SECOND + k * 10 * MS
        latency = 45 * MS if k < 200 else 5 * MS  # the link becomes 40 ms faster
        placed = aligner.place(SOURCE, stamp, T0 + stamp + latency)
        assert isinstance(placed, int)
        shifts.append(placed - stamp - T0)
    assert set(shifts[:200]) == {45 * MS}
    steps = [before - after for before, after in pairwise(shifts)]
    assert max(steps) <= 10 * MS // 20
    assert shifts[240] == pytest.approx(25 * MS, abs=4 * MS)  # half of it after 0.4 s
    assert shifts[-1] == pytest.approx(5 * MS, abs=1000)
    assert aligner.resets == 0


def test_peek_learns_nothing() -> None:
    aligner = boot_aligner()
    assert aligner.peek(SECOND, T0) == T0  # nothing is known
    assert not aligner.begun
    aligner.place(SOURCE, SECOND, T0 + SECOND + 5 * MS)
    before = aligner.report()
    assert aligner.peek(2 * SECOND, T0 + 2 * SECOND + 90 * MS) == T0 + 2 * SECOND + 5 * MS
    assert aligner.peek(YEAR, T0 + 2 * SECOND) == T0 + 2 * SECOND  # it does not fit
    assert aligner.report() == before


def test_a_stamp_that_does_not_fit_is_counted_with_its_reason() -> None:
    aligner = boot_aligner()
    aligner.place(SOURCE, 100 * SECOND, T0)
    assert aligner.place(SOURCE, 200 * SECOND, T0 + SECOND) == "stamped in the future"
    assert aligner.place("gps0.position", SECOND, T0 + 3 * SECOND) == "clock jump"
    assert (aligner.report().strays, aligner.report().samples, aligner.report().resets) == (2, 3, 0)


def test_a_boot_clock_with_trips_and_pairs_gives_the_offset_of_unix_time() -> None:
    wrong = 5 * SECOND  # the host is ahead of Unix time
    unix = Aligner(None)
    boot = Aligner(unix)
    for k in range(10):
        stamp = SECOND + k * SECOND
        host = T0 + stamp + wrong
        boot.place(SOURCE, stamp, host + 30 * MS)
        unix.place("gps0.position", T0 + stamp, host + 80 * MS)
        boot.learn_pair(T0, host + 30 * MS)
        boot.learn_trip(stamp + MS, host, host + 2 * MS)
        boot.bridge_to(unix, host + 2 * MS)
    assert boot.synchronised
    assert unix.bridge == pytest.approx(wrong, abs=1000)
    assert (boot.report().method, unix.report().method) == ("timesync", "timesync")
