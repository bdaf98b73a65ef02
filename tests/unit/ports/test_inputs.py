"""The inbox of an input: what it keeps when its estimator cannot keep up."""

from __future__ import annotations

from itertools import pairwise

from fusiond.ports.inputs import Inbox


def test_an_empty_one_wakes_once_and_gives_all_in_order() -> None:
    woken: list[int] = []
    inbox: Inbox[int] = Inbox(16, lambda: woken.append(1), hash)
    for number in range(16):
        inbox.put(number, number)
    assert (inbox.received, inbox.dropped, len(woken)) == (16, 0, 1)
    assert inbox.take() == [(number, number) for number in range(16)]
    assert inbox.take() == []


def test_a_full_one_thins_what_comes_often_and_keeps_what_comes_seldom() -> None:
    """A hundred inertial samples for every fix, four times as many as there is room for: every fix is kept, no second
    is without samples, and nothing is lost without being counted."""
    inbox: Inbox[str] = Inbox(256, lambda: None, hash)
    for number in range(1024):
        inbox.put(number, "fix" if number % 100 == 0 else "sample")
    kept = inbox.take()
    assert inbox.received == 1024 == len(kept) + inbox.dropped
    assert len(kept) <= 256
    assert [t for t, item in kept if item == "fix"] == list(range(0, 1024, 100))
    samples = [t for t, item in kept if item == "sample"]
    assert max(later - sooner for sooner, later in pairwise(samples)) < 40
    assert samples[-1] == 1023


def test_thinning_does_not_make_a_rolling_counter_stand_still() -> None:
    """Of a wheel's frames with a counter of three bits, hardly any look as stale as the one before."""
    inbox: Inbox[int] = Inbox(512, lambda: None, lambda _: "wheel")
    for number in range(4096):
        inbox.put(number, number % 8)
    counters = [item for _, item in inbox.take()]
    assert sum(sooner == later for sooner, later in pairwise(counters)) < 0.2 * len(counters)


def test_kinds_without_number_drop_the_oldest() -> None:
    inbox: Inbox[int] = Inbox(18, lambda: None, hash)
    for number in range(19):
        inbox.put(number, number)
    assert [item for _, item in inbox.take()] == list(range(6, 19))
    assert inbox.dropped == 6
