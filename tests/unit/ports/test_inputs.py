"""The inbox of an input: which frames it keeps if the estimator is too slow."""

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


def test_a_full_one_thins_frequent_kinds_and_keeps_rare_ones() -> None:
    """A hundred inertial samples for every fix, four times as many as there is room for: every fix is kept, no second
    is without samples, and every loss is counted."""
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


def test_thinning_does_not_make_a_rolling_counter_look_stale() -> None:
    """Of a wheel's frames with a counter of three bits, hardly any look like a repeat of the previous one."""
    inbox: Inbox[int] = Inbox(512, lambda: None, lambda _: "wheel")
    for number in range(4096):
        inbox.put(number, number % 8)
    counters = [item for _, item in inbox.take()]
    assert sum(sooner == later for sooner, later in pairwise(counters)) < 0.2 * len(counters)


def test_if_there_are_too_many_kinds_the_oldest_are_dropped() -> None:
    inbox: Inbox[int] = Inbox(18, lambda: None, hash)
    for number in range(19):
        inbox.put(number, number)
    assert [item for _, item in inbox.take()] == list(range(6, 19))
    assert inbox.dropped == 6
