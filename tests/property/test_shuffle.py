"""The order of arrival never changes a bit: any shuffle inside the horizon gives the same state, outcomes and counts.

A case is a few seconds of a drive with everything that makes arrival matter: duplicates, outliers at the gate's edge,
invalid samples, IMU samples that are nonsense, or missing for longer than it may be silent, events stamped after the
newest IMU sample. It is fused in the order of the stamps, and again in a random order of arrival in which no event is later
than the horizon. Hypothesis draws a seed and the shape of the case, and prints them when a case fails.
"""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Invalid, Measurement, Payload, WheelSpeed
from fusiond.filter.state import ALIVE, PHASE, RESET_REASON, RUNNING, ResetReason, T
from tests.conftest import needs_compiled
from tests.helpers.streams import MS, SECOND, T0, config, fuse, measurements, same_bits, same_state, town

PREFIX_S, LENGTH_S = 2.0, 2.5  # of a case: first in order, so that the filter aligns; then shuffled
QUIET = settings(deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))

CASES = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32 - 1),
        "begin_s": st.sampled_from([0.0, 2.0, 9.0, 20.0, 29.0, 33.5, 38.5]),
        "horizon_s": st.sampled_from([0.3, 0.6, 1.0]),
        "snapshot_interval_s": st.sampled_from([0.0, 0.01, 0.05, 0.3]),
        "imu_hole": st.booleans(),
        "imu_lies": st.booleans(),  # some of its samples are far off, and some in a row
        "correlation_s": st.sampled_from([0.0, 0.5]),
        "heading": st.booleans(),  # given, or found by the bank of hypotheses
        "learns": st.booleans(),  # delays, lever arm, scale of each wheel; fixes weighted as a mixture
        "read_every": st.sampled_from([1, 1, 1, 10, 10**6]),  # events: reading the state runs them
    }
)
Case = dict[str, float]


@cache
def drive_events() -> tuple[Measurement, ...]:
    """The whole drive in the order of the stamps: pulls away, weaves, stands, pulls away again."""
    return tuple(measurements(town(45.0), seed=3))


def configuration(case: Case) -> Config:
    given = {"heading_deg": 40.0} if case.get("heading", True) else {}
    learns = case.get("learns", False)
    gnss = {"delay_sigma_ms": 50.0, "velocity_delay_sigma_ms": 50.0, "lever_arm_sigma_m": 0.5, "outliers": "mixture"}
    return config(
        filter=given
        | {
            "wheel_scale_by": "wheel" if learns else "vehicle",
            "horizon_s": case["horizon_s"],
            "snapshot_interval_s": case["snapshot_interval_s"],
            "imu_gap_s": 0.1,
        },
        gnss=(gnss if learns else {})
        | {"position_correlation_s": case["correlation_s"], "velocity_correlation_s": case["correlation_s"]},
    )


def stretch(case: Case) -> tuple[list[Measurement], list[Measurement]]:
    """The events of a case in the order of their stamps: before the shuffle, and in it."""
    begin = T0 + round(case["begin_s"] * SECOND)
    middle, end = begin + round(PREFIX_S * SECOND), begin + round((PREFIX_S + LENGTH_S) * SECOND)
    events = [event for event in drive_events() if begin <= event.t_ns < end]
    prefix = [event for event in events if event.t_ns < middle]
    return prefix, spoiled([event for event in events if event.t_ns >= middle], case)


def spoiled(events: list[Measurement], case: Case) -> list[Measurement]:
    """The events with lost IMU samples, outliers, invalid samples and duplicates, all from the case's seed."""
    random = np.random.default_rng(int(case["seed"]))
    hole = events[0].t_ns + round(random.uniform(0.2, 1.5) * SECOND)
    held: list[Measurement] = []
    for event in events:
        imu = isinstance(event.payload, ImuSample)
        if imu and (random.random() < 0.02 or (case["imu_hole"] and hole <= event.t_ns < hole + 250 * MS)):
            continue
        chance = random.random()
        payload: Payload | Invalid = event.payload
        if imu and case.get("imu_lies") and (chance < 0.05 or event.sequence % 40 < 3):
            payload = nonsense(random)
        elif chance < 0.1:
            payload = off(payload, random)
        elif chance < 0.12:
            payload = Invalid("fault")
        held.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, payload))
        if chance > 0.97:  # the same event again
            held.append(held[-1])
        elif chance > 0.95:  # another event of the source with the same stamp
            other = off(event.payload, random)
            held.append(Measurement(event.t_ns, event.source, event.sequence + 10**6, event.t_receive_ns, other))
    return held


def off(payload: Payload | Invalid, random: np.random.Generator) -> Payload | Invalid:
    """A measurement that is wrong by about as much as the gate lets through."""
    if isinstance(payload, GnssPosition):
        return GnssPosition(payload.latitude + random.normal(0, 6.0) / 6.4e6, payload.longitude, payload.height, 1.0, 1.0)
    if isinstance(payload, GnssVelocity):
        return GnssVelocity(payload.north + random.normal(0, 0.5), payload.east, None, 0.1)
    if isinstance(payload, WheelSpeed):
        return WheelSpeed(payload.speed + random.normal(0, 0.4))
    return payload


def nonsense(random: np.random.Generator) -> ImuSample:
    """An inertial sample that no vehicle explains."""
    x, y, z, *rate = (float(number) for number in random.uniform(-1.0, 1.0, 6))
    return ImuSample((150 * x, 150 * y, 150 * z), (30 * rate[0], 30 * rate[1], 30 * rate[2]))


def arrival(events: list[Measurement], case: Case) -> list[Measurement]:
    """The events as they arrive with random delays, none as long as the horizon."""
    random = np.random.default_rng([int(case["seed"]), 1])
    longest = (case["horizon_s"] * SECOND - 1) * random.choice([0.2, 1.0])
    arrivals = [event.t_ns + int(longest * random.random() ** 2) for event in events]
    return [events[i] for i in np.argsort(arrivals, kind="stable")]


def runs(fusion: Fusion) -> bool:
    """Whether the filter runs, or did until a velocity contradicted the given heading, after an IMU that lied."""
    stamps = fusion.history.head.stamps
    return bool(stamps[PHASE] == RUNNING or stamps[RESET_REASON] == ResetReason.HEADING_DECIDED)


def check(case: Case, compiled: bool) -> None:
    prefix, events = stretch(case)
    settings_ = configuration(case)
    in_order = fuse(settings_, prefix + events, compiled)
    shuffled = Fusion(settings_, compiled)
    for number, event in enumerate(prefix + arrival(events, case)):
        shuffled.fuse(event)
        if number % case["read_every"] == 0:
            assert shuffled.history.head.stamps[T] <= shuffled.history.applied_ns
    assert runs(in_order) or not case["heading"]
    assert sum(in_order.totals().values()) == len(prefix) + len(events)
    assert in_order.totals()["TOO_OLD"] == 0
    assert shuffled.history.rerun > 0 or case["read_every"] > 10
    same_bits(in_order, shuffled)


@needs_compiled
@given(CASES)
@settings(QUIET, max_examples=1000)
def test_shuffled_arrivals(case: Case) -> None:
    check(case, compiled=True)


@given(CASES)
@settings(QUIET, max_examples=2)
def test_shuffled_arrivals_in_the_interpreted_kernel(case: Case) -> None:
    check(case, compiled=False)


@pytest.mark.slow
@needs_compiled
@given(CASES)
@settings(QUIET, max_examples=20_000)
def test_shuffled_arrivals_for_long(case: Case) -> None:
    check(case, compiled=True)


@given(st.integers(0, 2**32 - 1))
@settings(QUIET, max_examples=8)
def test_shuffled_while_aligning(seed: int) -> None:
    """The start itself does not depend on the order of arrival: the first 2.5 s are shuffled."""
    case: Case = {"seed": seed, "begin_s": 9.0, "horizon_s": 0.6, "snapshot_interval_s": 0.05, "imu_hole": False}
    events = [event for event in drive_events() if 0 <= event.t_ns - T0 - 9 * SECOND < 2.5 * SECOND]
    random = np.random.default_rng(seed)
    for i in random.integers(100, len(events), 5):
        if isinstance(events[i].payload, ImuSample):
            events[i] = msgspec.structs.replace(events[i], payload=nonsense(random))
    settings_ = configuration(case | {"correlation_s": 0.0})
    in_order, shuffled = fuse(settings_, events), fuse(settings_, arrival(events, case))
    assert in_order.history.head.stamps[PHASE] == RUNNING
    same_bits(in_order, shuffled)


@needs_compiled
def test_bad_samples_are_rejected_in_any_order() -> None:
    """What the shuffled cases are about: some are rejected, a late one that is good makes others believed."""
    case: Case = {"seed": 2, "begin_s": 20.0, "horizon_s": 0.6, "snapshot_interval_s": 0.05, "imu_hole": False}
    case |= {"correlation_s": 0.0, "imu_lies": True, "read_every": 1}
    prefix, events = stretch(case)
    fusion = fuse(configuration(case), prefix + arrival(events, case), True)
    assert 10 < fusion.outcomes()["imu0"]["REJECTED"] < 60
    check(case, compiled=True)


def lies(events: list[Measurement], liar: str) -> list[Measurement]:
    """The events with a receiver that jumps by 30 m, or a gyro that lies for half a second, 0.3 s after the first event."""
    begin = events[0].t_ns + 300 * MS
    held = []
    for event in events:
        payload: Payload | Invalid = event.payload
        if liar == "receiver" and isinstance(payload, GnssPosition) and event.t_ns >= begin:
            payload = msgspec.structs.replace(payload, latitude=payload.latitude + 30.0 / 6.4e6)
        if liar == "gyro" and isinstance(payload, ImuSample) and begin <= event.t_ns < begin + SECOND // 2:
            x, y, z = payload.angular_rate_b
            payload = msgspec.structs.replace(payload, angular_rate_b=(x + 0.4, y, z))
        held.append(msgspec.structs.replace(event, payload=payload))
    return held


@needs_compiled
@pytest.mark.parametrize("liar", ["receiver", "gyro"])
@pytest.mark.parametrize("interval_s", [0.0, 0.05])
def test_shuffled_while_rivals_are_alive(liar: str, interval_s: float) -> None:
    """Rivals begin, are weighed and lead in the middle of what is shuffled."""
    case: Case = {"begin_s": 9.0, "horizon_s": 0.6, "snapshot_interval_s": interval_s, "imu_hole": False}
    case |= {"correlation_s": 0.0}
    alive = 0
    for seed in range(20):
        begin = T0 + 9 * SECOND
        middle, end = begin + 4 * SECOND, begin + 7 * SECOND
        prefix = [event for event in drive_events() if begin <= event.t_ns < middle]
        events = lies([event for event in drive_events() if middle <= event.t_ns < end], liar)
        in_order, shuffled = Fusion(configuration(case), True), Fusion(configuration(case), True)
        for event in prefix + events:
            in_order.fuse(event)
            alive += int(in_order.history.head.stamps[ALIVE] > 0)
        for number, event in enumerate(prefix + arrival(events, case | {"seed": seed})):
            shuffled.fuse(event)
            if number % (1 + seed % 3) == 0:
                assert shuffled.history.head.stamps[T] <= shuffled.history.applied_ns
        assert shuffled.history.rerun > 0
        same_bits(in_order, shuffled)
        for fusion in (in_order, shuffled):
            assert fusion.solution_at(end).state is not None
        same_state(in_order._predicted, shuffled._predicted)
    assert alive > 100


@needs_compiled
@pytest.mark.parametrize("interval_s", [0.01, 0.05, 0.5])
def test_snapshots_at_any_spacing(interval_s: float) -> None:
    case: Case = {"seed": 5, "begin_s": 20.0, "horizon_s": 1.0, "imu_hole": True, "imu_lies": True, "correlation_s": 0.5}
    every: Fusion | None = None
    for spacing in (0.0, interval_s):
        prefix, events = stretch(case)
        fusion = fuse(configuration(case | {"snapshot_interval_s": spacing}), prefix + arrival(events, case), True)
        if every is not None:
            same_bits(every, fusion)
        every = fusion
