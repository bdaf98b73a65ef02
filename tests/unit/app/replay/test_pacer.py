"""The pace of a replay, and the clock that goes with it."""

from __future__ import annotations

from fusiond.app.replay.pacer import Pacer, ReplayClock

SECOND = 1_000_000_000  # ns


def test_pacer_sleeps_only_when_ahead() -> None:
    now, slept = [0], []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += round(seconds * SECOND)

    pace = Pacer(2.0, lambda: now[0], sleep)
    pace(0)
    pace(4 * SECOND)  # due after 2 s
    now[0] += 5 * SECOND  # the work took longer than the drive
    pace(6 * SECOND)
    assert slept == [2.0]


def test_the_clock_shows_how_far_the_drive_should_have_come() -> None:
    now = [100 * SECOND]
    pace = Pacer(4.0, lambda: now[0], lambda _: None)
    clock = ReplayClock(lambda: 1_000 * SECOND, lambda: 1_005 * SECOND, pace)
    assert clock.now_ns() == 1_000 * SECOND  # it has not begun
    pace(0)
    now[0] += 3 * SECOND
    assert clock.now_ns() == clock.from_wall_ns(7) == 1_012 * SECOND


def test_without_a_pace_the_clock_shows_how_far_the_replay_has_come() -> None:
    reached = [5 * SECOND]
    clock = ReplayClock(lambda: 0, lambda: reached[0], None)
    reached[0] += SECOND
    assert clock.now_ns() == 6 * SECOND
