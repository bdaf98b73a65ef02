"""Events out of order: outcomes at their limits, waiting, coasting, bounded memory, and the same bits in any order."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, ImuSample, Invalid, Measurement, Payload, WheelSpeed
from fusiond.filter.rows import Outcome
from fusiond.filter.state import NEVER, T_IMU, T_START, T
from tests.conftest import needs_compiled
from tests.helpers.streams import MS, SECOND, T0, config, fuse, measurements, same_bits, town

GIVEN = {"heading_deg": 40.0}
EVENTS = measurements(town(12.0, rate=50.0))
IMU = ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0))


LONG = pytest.mark.parametrize("compiled", [pytest.param(True, id="compiled", marks=needs_compiled)])


def settings(**changes: float) -> Config:
    return config(filter=GIVEN | changes)


def event(source: str, t_ns: int, payload: Payload | Invalid, sequence: int = 10**6) -> Measurement:
    return Measurement(t_ns, source, sequence, t_ns, payload)


def until(seconds: float) -> list[Measurement]:
    return [event for event in EVENTS if event.t_ns < T0 + round(seconds * SECOND)]


def delayed(late: Iterable[Measurement], by_ns: int, events: list[Measurement] = EVENTS) -> list[Measurement]:
    """The events in an order of arrival in which some are late."""
    held = {id(event) for event in late}
    return sorted(events, key=lambda event: (event.t_ns + (by_ns if id(event) in held else 0), event.key))


def run_one_by_one(configuration: Config, events: list[Measurement], compiled: bool) -> Fusion:
    """A fusion that has fused the events in the order given, and applied each before the next one."""
    fusion = Fusion(configuration, compiled)
    for offered in events:
        fusion.fuse(offered)
        assert fusion.history.head.stamps[T] <= fusion.history.applied_ns
    return fusion


def outcomes(fusion: Fusion, source: str) -> dict[str, int]:
    return {name: count for name, count in fusion.outcomes()[source].items() if count}


def sources(*names: str, events: list[Measurement] = EVENTS) -> list[Measurement]:
    return [event for event in events if event.source in names]


@LONG
@pytest.mark.parametrize("late", [["gps0.position"], ["gps0.position", "gps0.velocity"], ["imu0"], ["rear_left"]])
def test_late_events_give_the_result_of_the_right_order(compiled: bool, late: list[str]) -> None:
    fusion = fuse(settings(), delayed(sources(*late), 350 * MS), compiled)
    same_bits(fusion, fuse(settings(), EVENTS, compiled))
    totals = fusion.totals()
    assert totals["FUSED"] + totals["GATHERED"] == sum(totals.values()) == len(EVENTS)
    assert totals["GATHERED"] == len([event for event in EVENTS if event.t_ns < fusion.history.head.stamps[T_START]])


def test_late_events_in_the_interpreted_kernel() -> None:
    late = delayed(sources("gps0.position", "imu0", events=until(2.0)), 100 * MS, until(2.0))
    same_bits(fuse(settings(), late, False), fuse(settings(), until(2.0), False))


@LONG
def test_one_late_event_reruns_the_rows_after_it(compiled: bool) -> None:
    fix = next(event for event in EVENTS if event.source == "gps0.position" and event.t_ns > T0 + 8 * SECOND)
    before = [event for event in EVENTS if event.t_ns <= fix.t_ns + 400 * MS]
    fusion = run_one_by_one(settings(), [event for event in before if event is not fix], compiled)
    assert fusion.history.rerun == 0
    assert fusion.fuse(fix).outcome is Outcome.FUSED
    rows = len([event for event in before if event.t_ns > fix.t_ns - 50 * MS])
    assert 0.8 * rows < fusion.history.rerun <= rows
    same_bits(fusion, fuse(settings(), before, compiled))


@LONG
def test_events_that_come_late_together_are_run_once(compiled: bool) -> None:
    late = [event for event in EVENTS if "gps0" in event.source and T0 + 8 * SECOND < event.t_ns < T0 + 8.3 * SECOND]
    before = [event for event in EVENTS if event.t_ns <= T0 + 8.5 * SECOND]
    fusion = run_one_by_one(settings(), [event for event in before if event not in late], compiled)
    receipts = [fusion.fuse(event) for event in late]
    assert len(receipts) > 2
    assert {receipt.outcome for receipt in receipts} == {Outcome.FUSED}
    assert 0 < fusion.history.rerun <= len([event for event in before if event.t_ns > late[0].t_ns - 50 * MS])
    same_bits(fusion, fuse(settings(), before, compiled))


@LONG
def test_events_in_order_are_run_once(compiled: bool) -> None:
    """Wheels stamped with the IMU's own instants too."""
    fusion = run_one_by_one(settings(), EVENTS, compiled)
    assert any(row["t_ns"] in fusion.history.rows["t_ns"][i + 1 :] for i, row in enumerate(fusion.history.rows))
    assert fusion.history.rerun == 0


def test_too_old_begins_below_the_horizon(compiled: bool) -> None:
    for offset, too_old in ((0, False), (-1, True)):
        fusion = fuse(settings(), until(2.5), compiled)
        horizon = fusion.history.settled_ns
        assert horizon == sources("imu0", events=until(2.5))[-1].t_ns - SECOND
        before = fusion.history.head.numbers.copy()
        outcome = fusion.fuse(event("front_right", horizon + offset, WheelSpeed(0.05))).outcome
        assert outcome == (Outcome.TOO_OLD if too_old else Outcome.FUSED)
        assert fusion.outcomes()["front_right"]["TOO_OLD"] == too_old
        assert bool((fusion.history.head.numbers == before).all()) is too_old


def test_duplicates(compiled: bool) -> None:
    """The same event again, and another one of its source with the same stamp: the lower sequence is kept in any order."""
    fusion = fuse(settings(), until(6.0), compiled)
    fix = sources("gps0.position", events=until(5.9))[-1]
    assert fusion.fuse(fix).outcome == Outcome.DUPLICATE
    same_bits_but_counts(fusion, fuse(settings(), until(6.0), compiled))
    other = GnssPosition(fix.payload.latitude, fix.payload.longitude, fix.payload.height + 1.0)
    above, below = (msgspec.structs.replace(fix, sequence=fix.sequence + s, payload=other) for s in (100, -100))
    assert fusion.fuse(above).outcome == Outcome.DUPLICATE
    same_bits_but_counts(fusion, fuse(settings(), until(6.0), compiled))
    assert fusion.fuse(below).outcome == Outcome.FUSED
    counts = outcomes(fusion, "gps0.position")
    assert counts["DUPLICATE"] == 3 and counts["FUSED"] + counts["GATHERED"] == 30
    replaced = sorted([e for e in until(6.0) if e is not fix] + [below], key=lambda e: e.key)
    same_bits_but_counts(fusion, fuse(settings(), replaced, compiled))


def same_bits_but_counts(a: Fusion, b: Fusion) -> None:
    np.testing.assert_array_equal(a.history.head.numbers, b.history.head.numbers)
    np.testing.assert_array_equal(a.history.head.whole, b.history.head.whole)


def test_a_duplicate_stays_one_after_rows_are_dropped(compiled: bool) -> None:
    """The first of two IMU samples at one instant is in the base snapshot, the second the first row behind it, and a late
    event makes it run again from there."""
    imu = next(event for event in EVENTS if event.source == "imu0" and event.t_ns == T0 + 6 * SECOND)
    second = msgspec.structs.replace(imu, sequence=10**6, payload=IMU)
    events = sorted([*until(6.33), second], key=lambda event: event.key)
    briefly = settings(horizon_s=0.3, snapshot_interval_s=0.01)
    fusion = fuse(briefly, events, compiled)
    assert fusion.settled().t_ns == imu.t_ns  # drops what it can
    assert fusion.history.rows[0]["sequence"] == second.sequence
    late = event("front_right", imu.t_ns + 20 * MS, WheelSpeed(4.0))
    assert fusion.fuse(late).outcome in (Outcome.FUSED, Outcome.REJECTED)
    assert outcomes(fusion, "imu0")["DUPLICATE"] == 1
    same_bits(fusion, fuse(briefly, sorted([*events, late], key=lambda event: event.key), compiled))


def test_waits_for_the_imu(compiled: bool) -> None:
    fusion = fuse(settings(), until(6.0), compiled)
    newest = fusion.history.applied_ns
    assert fusion.fuse(event("rear_left", newest + 15 * MS, WheelSpeed(10.0))).outcome == Outcome.WAITING
    assert fusion.outcomes()["rear_left"]["WAITING"] == 1
    assert fusion.history.head.stamps[T] == newest
    rest = [event for event in EVENTS if event.t_ns >= T0 + 6 * SECOND]
    for following in rest[:20]:
        fusion.fuse(following)
    assert fusion.outcomes()["rear_left"]["WAITING"] == 0
    assert fusion.history.head.stamps[T] > newest


@LONG
def test_a_silent_imu_does_not_stop_the_others(compiled: bool) -> None:
    """After `imu_gap` the filter coasts with the other sensors. When the IMU samples arrive late, they are inserted."""
    silent = [event for event in sources("imu0") if T0 + 6 * SECOND <= event.t_ns < T0 + 7 * SECOND]
    fusion = Fusion(settings(), compiled)
    for offered in delayed(silent, 900 * MS, until(6.9)):
        if offered not in silent:
            fusion.fuse(offered)
    head = fusion.history.head
    assert head.stamps[T_IMU] == T0 + 6 * SECOND - 20 * MS
    assert head.stamps[T] > T0 + 6.5 * SECOND
    assert fusion.history.applied_ns == until(6.9)[-1].t_ns - 200 * MS
    assert outcomes(fusion, "rear_left")["FUSED"] > 130
    assert np.sqrt(head.covariance[3, 3]) < 1.0  # the wheels and GNSS hold it
    for sample in silent:
        fusion.fuse(sample)
    for following in EVENTS:
        if following.t_ns >= until(6.9)[-1].t_ns and following not in silent:
            fusion.fuse(following)
    np.testing.assert_array_equal(fusion.history.head.numbers, fuse(settings(), EVENTS, compiled).history.head.numbers)


@LONG
def test_an_imu_hole_that_is_never_filled(compiled: bool) -> None:
    hole = [e for e in EVENTS if e.source != "imu0" or not T0 + 6 * SECOND <= e.t_ns < T0 + 6.5 * SECOND]
    fusion = fuse(settings(), hole, compiled)
    fixes = sources("gps0.position", "gps0.velocity", events=hole)
    same_bits(fusion, fuse(settings(), delayed(fixes, 250 * MS, hole), compiled))
    truth = town(12.0, rate=50.0)
    np.testing.assert_allclose(fusion.history.head.nominal[:3], truth.position_e[-1], atol=2.0)


def test_a_stamp_from_the_future_only_waits(compiled: bool) -> None:
    fusion = fuse(settings(), until(6.0), compiled)
    before = fusion.history.head.numbers.copy()
    assert fusion.fuse(event("rear_left", T0 + 6 * SECOND + 150 * MS, WheelSpeed(10.0))).outcome == Outcome.WAITING
    np.testing.assert_array_equal(fusion.history.head.numbers, before)


def test_a_dropped_event_has_no_outcome(compiled: bool) -> None:
    fusion, first = Fusion(settings(), compiled), until(2.5)[0]
    receipt = fusion.fuse(first)
    assert receipt.outcome in (Outcome.FUSED, Outcome.WAITING)
    for following in until(2.5)[1:]:
        fusion.fuse(following)
    fusion.settled()  # drops what it can
    with pytest.raises(LookupError, match=rf"no event of {first.source} at {first.t_ns} is kept"):
        _ = receipt.outcome


@LONG
def test_counts_sum_to_the_events_offered(compiled: bool) -> None:
    rng = np.random.default_rng(1)
    fusion, offered = Fusion(settings(horizon_s=0.4), compiled), 0
    by_source = dict.fromkeys(fusion.params.sources, 0)
    arrivals = [e.t_ns + round(rng.exponential(0.15) * SECOND) for e in EVENTS]
    for i in np.argsort(arrivals, kind="stable")[:2000]:
        original = EVENTS[i]
        bad = msgspec.structs.replace(original, payload=Invalid("fault"))
        for one in (original, bad) if i % 7 == 0 else (original, original) if i % 11 == 0 else (original,):
            fusion.fuse(one)
            offered += 1
            by_source[one.source] += 1
            assert sum(fusion.totals().values()) == offered
    assert {name: sum(counts.values()) for name, counts in fusion.outcomes().items()} == by_source
    assert all(fusion.totals()[name] > 0 for name in ("FUSED", "TOO_OLD", "DUPLICATE", "INVALID"))
    assert (fusion.history.counts >= 0).all()


@LONG
@pytest.mark.parametrize("interval_s", [0.0, 0.01, 0.05, 0.5])
def test_snapshots_at_any_spacing(compiled: bool, interval_s: float) -> None:
    late = delayed(sources("gps0.position"), 333 * MS, until(6.0))
    fusion = fuse(settings(snapshot_interval_s=interval_s), late, compiled)
    same_bits(fusion, fuse(settings(), late, compiled))


@LONG
def test_the_horizon_changes_nothing_but_what_is_too_old(compiled: bool) -> None:
    fusions = [fuse(settings(horizon_s=horizon), until(6.0), compiled) for horizon in (0.25, 1.0, 30.0)]
    same_bits(fusions[0], fusions[1])
    same_bits(fusions[1], fusions[2])


@needs_compiled
def test_memory_is_bounded() -> None:
    """Ten minutes, and no more rows or snapshots than a horizon needs; the tables do not grow after the first seconds."""
    fusion, sizes, live = Fusion(settings(), True), [], []
    stretch = until(10.0)
    for k in range(60):
        for original in stretch:
            shift = k * 10 * SECOND
            fusion.fuse(
                msgspec.structs.replace(original, t_ns=original.t_ns + shift, sequence=original.sequence + k * 10**6)
            )
        history = fusion.history
        sizes.append((len(history._table), len(history._snapshots.applied)))
        live.append((len(history.rows), history._snapshots.end - history._snapshots.begin))
    assert len(set(sizes[2:])) == 1
    assert max(rows for rows, _ in live) < 2 * len(until(1.0)) + 256
    assert max(snapshots for _, snapshots in live) < 80
    assert sum(fusion.totals().values()) == 60 * len(stretch)


@LONG
def test_settled_state(compiled: bool) -> None:
    """It is at most a snapshot interval before the horizon, and equals the head of that instant whatever comes later."""
    fusion = fuse(settings(), until(8.0), compiled)
    settled = fusion.settled()
    horizon = fusion.history.settled_ns
    assert horizon - 50 * MS - 20 * MS <= settled.t_ns < horizon
    then = fuse(settings(), [event for event in EVENTS if event.t_ns <= settled.t_ns], compiled)
    assert settled.state is not None
    expected = then.solution_at(settled.t_ns).state
    assert expected is not None
    assert (settled.state.latitude, settled.state.velocity_n) == (expected.latitude, expected.velocity_n)
    np.testing.assert_array_equal(settled.state.covariance, expected.covariance)
    shuffled = fuse(settings(), delayed(sources("gps0.position", "imu0"), 300 * MS, until(8.0)), compiled)
    np.testing.assert_array_equal(shuffled.history.settled().numbers, fusion.history.settled().numbers)


def test_settled_before_the_first_event(compiled: bool) -> None:
    fusion = Fusion(settings(), compiled)
    assert fusion.settled().state is None
    assert fusion.history.head.stamps[T] == NEVER
