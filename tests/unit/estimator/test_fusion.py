"""Fusion: modes and ages of the solution, unusable payloads, unknown sources, what is stored, and the health of sources."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.estimator.fusion import LOST_IMU_NS, Fusion
from fusiond.estimator.solution import Mode
from fusiond.events import (
    HOST_CLOCK,
    ClockPair,
    GnssPosition,
    ImuSample,
    Invalid,
    Measurement,
    Payload,
    Received,
    WheelSpeed,
    boot_clock,
)
from fusiond.filter.rows import Outcome
from fusiond.filter.state import GYRO_BIAS_B, ResetReason
from fusiond.maths.wgs84 import geodetic
from tests.helpers.streams import MS, SECOND, T0, config, fuse, measurements, reset_by, same_bits, town

SETTINGS = config(filter={"heading_deg": 40.0})
TRUTH = town(4.0, rate=50.0)
EVENTS = measurements(TRUTH)
END = EVENTS[-1].t_ns


def event(source: str, payload: Payload | Invalid, t_ns: int = T0 + 2 * SECOND) -> Measurement:
    return Measurement(t_ns, source, 10**6, t_ns, payload)


def until(seconds: float) -> list[Measurement]:
    return [event for event in EVENTS if event.t_ns < T0 + round(seconds * SECOND)]


def test_no_solution_before_alignment(compiled: bool) -> None:
    fusion = Fusion(SETTINGS, compiled)
    before = fusion.solution_at(T0)
    assert (before.t_ns, before.mode, before.age_ns, before.resets, before.state) == (T0, Mode.ALIGNING, None, 0, None)
    assert fusion.to_store() is None
    sample = next(event for event in EVENTS if event.source == "imu0")
    fusion.fuse(sample)
    assert fusion.solution_at(sample.t_ns + 7 * MS).age_ns == 7 * MS


def test_the_solution_is_near_the_truth(compiled: bool) -> None:
    fusion = fuse(SETTINGS, EVENTS, compiled)
    found = fusion.solution_at(T0 + 4 * SECOND)
    assert found.state is not None
    assert (found.mode, found.resets) == (Mode.NOMINAL, 0)
    latitude, longitude, height = geodetic(TRUTH.position_e[-1])
    metres = 6.37e6 * np.array([found.state.latitude - latitude, found.state.longitude - longitude])
    np.testing.assert_allclose(metres, 0.0, atol=3.0)
    assert found.state.height == pytest.approx(height, abs=3.0)
    assert fusion.to_store() is not None


@pytest.mark.parametrize(
    ("after_ns", "mode"),
    [
        (1500 * MS, Mode.NOMINAL),
        (2500 * MS, Mode.DEAD_RECKONING),  # position_timeout_s is 2
        (LOST_IMU_NS, Mode.DEAD_RECKONING),
        (LOST_IMU_NS + 1, Mode.LOST),
    ],
)
def test_the_mode_when_nothing_arrives_any_more(compiled: bool, after_ns: int, mode: Mode) -> None:
    fusion = fuse(SETTINGS, EVENTS, compiled)
    newest_imu = max(event.t_ns for event in EVENTS if event.source == "imu0")
    found = fusion.solution_at(newest_imu + after_ns)
    assert (found.mode, found.age_ns) == (mode, after_ns)


def test_a_clock_pair_has_no_receipt() -> None:
    pair = Received("link.timesync", 0, boot_clock("link"), SECOND, T0, ClockPair(HOST_CLOCK, T0 - MS))
    fusion = Fusion(SETTINGS)
    assert fusion.feed(pair) is None
    assert sum(fusion.totals().values()) == 0


def test_what_is_received_is_aligned_and_then_fused() -> None:
    sample = ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0))
    receipt = Fusion(config(imu={"delay_ms": 5.0})).feed(Received("imu0", 3, "", None, T0, sample))
    assert receipt is not None
    assert receipt.measurement == Measurement(T0 - 5 * MS, "imu0", 3, T0, sample)


def test_the_health_of_every_source(compiled: bool) -> None:
    found = fuse(SETTINGS, EVENTS, compiled).health(END)
    assert set(found) == set(SETTINGS.sources())
    assert {source for source, health in found.items() if health.status == "nominal"} == set(found)
    later = fuse(SETTINGS, EVENTS, compiled).health(END + 60 * SECOND)
    assert {health.status for health in later.values()} == {"absent"}


def test_solutions_ahead_do_not_change_the_state(compiled: bool) -> None:
    events = until(3.0)
    fusion, plain = Fusion(SETTINGS, compiled), fuse(SETTINGS, events, compiled)
    for offered in events:
        fusion.fuse(offered)
        fusion.solution_at(offered.t_ns + 30 * MS)
        fusion.settled()
    same_bits(fusion, plain)


@pytest.mark.parametrize(
    ("payload", "source", "reason"),
    [
        (ImuSample((float("nan"), 0.0, -9.8), (0.0, 0.0, 0.0)), "imu0", "not finite"),
        (ImuSample((0.0, 0.0, -9.8), (0.0, float("inf"), 0.0)), "imu0", "not finite"),
        (ImuSample((0.0, 0.0, -161.0), (0.0, 0.0, 0.0)), "imu0", "range"),
        (ImuSample((0.0, 0.0, -9.8), (0.0, 36.0, 0.0)), "imu0", "range"),
        (GnssPosition(float("nan"), 0.2, 500.0), "gps0.position", "not finite"),
        (GnssPosition(0.8, 0.2, 500.0, float("nan")), "gps0.position", "not finite"),
        (GnssPosition(0.8, 0.2, 500.0, float("inf"), 1.0), "gps0.position", "not finite"),
        (GnssPosition(1.6, 0.2, 500.0), "gps0.position", "impossible position"),
        (GnssPosition(0.8, 0.2, 200_000.0), "gps0.position", "impossible position"),
        (WheelSpeed(float("-inf")), "rear_left", "not finite"),
        (WheelSpeed(1001.0), "rear_left", "impossible speed"),
        (Invalid("checksum"), "rear_left", "checksum"),
    ],
)
def test_bad_data_is_counted_with_its_reason(compiled: bool, payload: Payload | Invalid, source: str, reason: str) -> None:
    fusion = fuse(SETTINGS, until(2.0), compiled)
    before = fusion.history.head.numbers.copy()
    receipt = fusion.fuse(event(source, payload))
    assert receipt.outcome == Outcome.INVALID
    assert reason in receipt.reason
    assert fusion.invalid[source][receipt.reason] == fusion.outcomes()[source]["INVALID"] == 1
    np.testing.assert_array_equal(fusion.history.head.numbers, before)


def test_an_unknown_source_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"no source 'radar0'.*front_left"):
        Fusion(SETTINGS).fuse(event("radar0", WheelSpeed(1.0)))


def test_receipts_that_step_back_begin_a_new_session(compiled: bool) -> None:
    """Biases, calibrations and counts go on; an earlier receipt still has the history of its own session."""

    def received(events: list[Measurement], by_ns: int) -> list[Received]:
        return [Received(one.source, one.sequence, "", None, one.t_ns - by_ns, one.payload) for one in events]

    settings = config(filter={"heading_deg": 40.0, "restart_gap_s": 3.0})
    fusion, own = Fusion(settings, compiled), Fusion(settings, compiled)
    receipts = [fusion.feed(one) for one in received(EVENTS, 0)]
    first, before, history = fusion.totals(), fusion.history.head.copy(), fusion.history
    later = received(EVENTS, 60 * SECOND)
    fusion.feed(later[0])
    assert fusion.history is not history
    assert reset_by(fusion)[:2] == (1, ResetReason.TIME_STEPPED_BACK)
    aligning = fusion.history.head
    kept = slice(GYRO_BIAS_B.start, aligning.size + 1)
    assert aligning.nominal[kept].tobytes() == before.nominal[kept].tobytes()
    assert fusion.solution_at(END - 60 * SECOND).mode is Mode.ALIGNING
    for one in later[1:]:
        fusion.feed(one)
    for one in later:
        own.feed(one)
    assert receipts[-1] is not None and receipts[-1].outcome is not Outcome.TOO_OLD
    gained = {name: count - first[name] for name, count in fusion.totals().items()}
    own_counts = own.totals()
    assert gained["TOO_OLD"] == 0
    assert gained["FUSED"] + gained["GATHERED"] == own_counts["FUSED"] + own_counts["GATHERED"]
    assert gained["GATHERED"] > own_counts["GATHERED"]  # the given heading is that of the first start
    assert fusion.solution_at(END - 60 * SECOND).mode is Mode.NOMINAL
