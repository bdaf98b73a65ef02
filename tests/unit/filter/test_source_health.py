"""What the filter believes of its sources: Bayes' rule by hand, and the faults that a vehicle meets."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, Measurement, Payload, WheelSpeed
from fusiond.filter import source_health as health
from fusiond.filter.measurement_update import detection
from fusiond.filter.state import (
    BELIEF,
    BIAS,
    BIASED,
    FROZEN,
    INTERVAL,
    MEAN_NIS,
    MEMORY_SIZE,
    NEVER,
    NOISE_EXCESS,
    NOISY,
    NOMINAL,
    SOURCE_STAMPS_SIZE,
    VELOCITY_E,
    WHEEL_SCALE,
    T,
)
from fusiond.maths.wgs84 import ecef, geodetic, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import SECOND, T0, Drive, config, drive, fuse, measurements, town

Change = Callable[[Measurement, float], Payload | None]  # by the seconds since the begin; None: it is missing
FAULT_S = 15.0  # from here on


def blank() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(MEMORY_SIZE), np.full(SOURCE_STAMPS_SIZE, NEVER, dtype=np.int64)


def gaussian(square: float, variance: float, m: int) -> float:
    return math.exp(-square / (2 * variance)) / variance ** (m / 2)


def test_bayes_by_hand() -> None:
    """Three looks at a source of one axis, the posterior of each worked out here."""
    memory, stamps = blank()
    expected, bias, spread, last = np.array(health.PRIOR), 0.0, health.FIRST_BIAS_VARIANCE, None
    for k, (e, same) in enumerate([(0.5, False), (4.0, False), (4.2, True)]):
        t_ns = T0 + k * SECOND // 10
        health.judge(memory, stamps, np.array([e]), 1, same, t_ns)
        blurred = 1 - math.exp(-(health.MEAN_STATUS_TIME if last is None else 0.1) / health.MEAN_STATUS_TIME)
        last = t_ns
        if gaussian(e * e, 1 + health.FIRST_BIAS_VARIANCE, 1) > gaussian((e - bias) ** 2, 1 + spread, 1):
            bias, spread = 0.0, health.FIRST_BIAS_VARIANCE
        stretch = health.MIN_BIAS / abs(bias) if spread < 1 and 0 < abs(bias) < health.MIN_BIAS else 1.0
        outlier = gaussian(e * e, health.OUTLIER_VARIANCE, 1)
        alike = [health.SAME_IF_NOMINAL, health.SAME_IF_FAULTY, health.SAME_IF_FAULTY] if same else [1.0] * 3
        off = (e - bias * stretch) ** 2
        densities = [gaussian(e * e, 1.0, 1), gaussian(e * e, health.NOISY_VARIANCE, 1), gaussian(off, 1 + spread, 1)]
        likelihood = [a * (0.99 * density + 0.01 * outlier) for a, density in zip(alike, densities, strict=True)]
        likelihood.append(outlier * (1.0 if same else health.OTHER_IF_FROZEN))
        expected = (expected + blurred * (np.array(health.PRIOR) - expected)) * likelihood
        expected /= expected.sum()
        gain = (spread + health.BIAS_WALK) / (spread + health.BIAS_WALK + 1)
        bias, spread = bias + gain * (e - bias), (1 - gain) * (spread + health.BIAS_WALK)
        np.testing.assert_allclose(memory[BELIEF], expected, rtol=1e-12)
        assert memory[BIAS][0] == pytest.approx(bias, rel=1e-12)
    assert memory[NOMINAL] < 0.9


def test_a_distrusted_source_that_repeats_itself_stays_distrusted() -> None:
    """It is frozen rather than biased if it is wrong; that it is right proves nothing."""
    memory, stamps = blank()
    for k in range(20):
        health.judge(memory, stamps, np.array([8.0, 0.0, 0.0]), 1, False, T0 + k * SECOND // 10)
    assert memory[BIASED] > 0.9
    before, distrusted = memory.copy(), memory[BIASED] + memory[FROZEN]
    for _ in range(100):
        health.judge_repeated(memory, np.array([0.1, 0.0, 0.0]), 1)
    np.testing.assert_array_equal(memory, before)
    for _ in range(20):
        health.judge_repeated(memory, np.array([5.0, 0.0, 0.0]), 1)
    assert memory[FROZEN] > 0.9
    assert memory[BIASED] + memory[FROZEN] == pytest.approx(distrusted, abs=1e-15)


def test_absence_by_hand() -> None:
    """After k missed readings the odds of absence are prior odds over (1 - P_D)^k; a miss changes nothing else."""
    memory, stamps = blank()
    memory[BELIEF], memory[INTERVAL], stamps[0] = (0.9, 0.1, 0.0, 0.0), 0.1, T0
    for misses in range(6):
        found = health.belief(memory, stamps, T0 + misses * SECOND // 10 + SECOND // 100, T0)
        odds = health.ABSENT / (1 - health.ABSENT) / (1 - health.DETECTION) ** misses
        assert found.probabilities[4] == pytest.approx(odds / (1 + odds), rel=1e-9)
        assert sum(found.probabilities) == pytest.approx(1.0, rel=1e-12)
        assert found.probabilities[0] == pytest.approx(9 * found.probabilities[1], rel=1e-12)
    assert found.status == "absent"
    assert "not received" in found.reason


@pytest.mark.parametrize("ratio", [0.25, 4.0])
def test_noise_is_learnt_from_innovations(ratio: float) -> None:
    """C3: from four times too small and four times too large."""
    rng, (memory, _) = np.random.default_rng(3), blank()
    given, predicted = np.full(2, 0.5), np.diag([0.2, 0.2])
    for _ in range(20_000):
        innovation = rng.normal(0.0, math.sqrt(ratio * 0.5 + 0.2), 2)
        health.learn(memory, innovation, given, predicted, 2, 0.1)
    assert 1 + memory[NOISE_EXCESS] == pytest.approx(ratio, rel=0.25)
    assert health.noise_factor(memory, 0.5, 2.0) == (0.5 if ratio < 1 else 2.0)
    assert memory[MEAN_NIS] == pytest.approx((ratio * 0.5 + 0.2) / 0.7, rel=0.5)


def test_mixture_with_clutter_by_hand() -> None:
    """D3: P_D N against (1 - P_D) rho; all of it the target's at P_D = 1."""
    weight = 0.95 * math.exp(-2.0)
    clutter = 0.05 * (math.sqrt(2 * math.pi) / 100.0) ** 3
    assert detection(4.0, 3, 0.05) == pytest.approx(weight / (weight + clutter), rel=1e-12)
    assert detection(4.0, 3, 0.0) == 1.0
    assert detection(2000.0, 3, 0.05) == 0.0


# --- faults on a drive


def faulty(truth: Drive, change: Change, seed: int = 1) -> list[Measurement]:
    events = []
    for event in measurements(truth, seed=seed):
        payload = change(event, (event.t_ns - T0) / SECOND)
        if payload is not None:
            events.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, payload))
    return events


def named(fusion: Fusion, events: list[Measurement], source: str) -> tuple[float | None, str, set[str]]:
    """When a source is first called something else than nominal, what, and what the others are called meanwhile."""
    when, what, others, look_ns = None, "nominal", set(), 0
    for event in events:
        fusion.fuse(event)
        if event.t_ns < look_ns:
            continue
        look_ns = event.t_ns + SECOND // 20
        found = {name: belief.status for name, belief in fusion.health(event.t_ns).items()}
        if found[source] != "nominal" and when is None and event.t_ns >= T0 + FAULT_S * SECOND:
            when, what = (event.t_ns - T0) / SECOND - FAULT_S, found[source]
        others |= {f"{name} {status}" for name, status in found.items() if status != "nominal" and name != source}
    return when, what, others


def slips(event: Measurement, t: float) -> Payload:
    if event.source == "rear_left" and t >= FAULT_S and isinstance(event.payload, WheelSpeed):
        return WheelSpeed(1.3 * event.payload.speed)
    return event.payload


def freezes(event: Measurement, t: float, held: dict[str, Payload]) -> Payload:
    if event.source == "front_right":
        if t >= FAULT_S:
            return held["last"]
        held["last"] = event.payload
    return event.payload


def shifted(event: Measurement, north: float, speed: float) -> Payload:
    payload = event.payload
    if isinstance(payload, GnssPosition):
        place = ecef(payload.latitude, payload.longitude, payload.height)
        moved = geodetic(place + mat_ne(place).T @ np.array([north, 0.0, 0.0]))
        return msgspec.structs.replace(payload, latitude=moved[0], longitude=moved[1])
    if isinstance(payload, GnssVelocity):
        return msgspec.structs.replace(payload, north=payload.north + speed)
    return payload


def miss(fusion: Fusion, truth: Drive) -> float:
    """Horizontal error at the end [m]."""
    found = fusion.solution_at(T0 + round(truth.seconds[-1] * SECOND)).state
    assert found is not None
    off = ecef(found.latitude, found.longitude, found.height) - truth.position_e[-1]
    return float(np.linalg.norm((mat_ne(truth.position_e[-1]) @ off)[:2]))


@needs_compiled
@pytest.mark.parametrize("seed", range(1, 6))
def test_a_slipping_wheel_is_named_within_a_second(seed: int) -> None:
    truth = town(25.0, rate=50.0)
    fusion = Fusion(config())
    when, what, others = named(fusion, faulty(truth, slips, seed), "rear_left")
    assert (what, others) == ("biased", set())
    assert when is not None
    assert when < 1.0
    assert miss(fusion, truth) < 3.0


@needs_compiled
@pytest.mark.parametrize("seed", range(1, 4))
def test_a_frozen_wheel(seed: int) -> None:
    held: dict[str, Payload] = {}
    truth = town(28.0, rate=50.0)
    events = faulty(truth, lambda event, t: freezes(event, t, held), seed)
    when, what, others = named(Fusion(config()), events, "front_right")
    assert (what, others) == ("frozen", set())
    assert when is not None
    assert when < 8.0  # once the vehicle's speed has changed


@needs_compiled
def test_an_absent_receiver() -> None:
    truth = town(20.0, rate=50.0)
    events = faulty(truth, lambda event, t: None if event.source == "gps0.velocity" and t >= FAULT_S else event.payload)
    when, what, others = named(Fusion(config()), events, "gps0.velocity")
    assert (what, others) == ("absent", set())
    assert when is not None
    assert when < 1.5


@needs_compiled
def test_a_jump_of_twenty_metres_is_rejected() -> None:
    truth = town(28.0, rate=50.0)
    events = faulty(truth, lambda event, t: shifted(event, 20.0, 0.0) if t >= FAULT_S else event.payload)
    fusion = Fusion(config())
    when, what, _ = named(fusion, events, "gps0.position")
    assert what == "biased"
    assert when is not None
    assert when < 2.0
    assert miss(fusion, truth) < 5.0
    assert fusion.solution_at(events[-1].t_ns).resets == 0


@needs_compiled
def test_a_drift_of_a_metre_a_second_is_named_within_twenty_seconds() -> None:
    truth = town(34.0, rate=50.0)
    events = faulty(truth, lambda event, t: shifted(event, max(0.0, t - FAULT_S), 0.0))
    fusion = Fusion(config())
    when, what, _ = named(fusion, events, "gps0.position")
    assert what == "biased"
    assert when is not None
    assert when < 20.0


@needs_compiled
def test_no_fault_no_alarm() -> None:
    for seed in range(1, 9):
        events = measurements(town(50.0, rate=50.0), seed=seed)
        _, _, others = named(Fusion(config()), events, "imu0")
        assert others == set()


@needs_compiled
def test_after_an_outage_it_is_believed_again() -> None:
    """Ten minutes without GNSS, then fixes that lie outside what the filter expected: not at once, but in 5 s."""
    truth = drive(70.0, lambda t: 10.0 + np.sin(0.3 * t), lambda t: 0.02 * t, rate=50.0)

    def fixes(event: Measurement, t: float) -> Payload | None:
        if event.source.startswith("gps") and 15.0 <= t < 50.0:
            return None
        return shifted(event, 18.0 if t >= 50.0 else 0.0, 0.0)

    fusion, shared = Fusion(config()), []
    for event in faulty(truth, fixes):
        fusion.fuse(event)
        if event.t_ns > T0 + 55 * SECOND and event.source == "gps0.position":
            shared.append(fusion.outcomes()["gps0.position"]["REJECTED"])
    assert shared[-1] == shared[0] > 0  # at first not, and from 5 s on always
    found = fusion.solution_at(T0 + 70 * SECOND).state
    assert found is not None
    off_n = mat_ne(truth.position_e[-1]) @ (ecef(found.latitude, found.longitude, found.height) - truth.position_e[-1])
    assert np.linalg.norm(off_n[:2] - (18.0, 0.0)) < 2.0


SLOWLY = pytest.param(40.0, marks=pytest.mark.xfail(strict=True, reason="zero velocity holds the state back too long"))


@pytest.mark.parametrize("gets_under_way_s", [8.0, SLOWLY])
def test_a_ferry_carries_the_car(compiled: bool, gets_under_way_s: float) -> None:
    """Wheels at rest, GNSS at 5 m/s: the wheels are not believed, nor that the vehicle stands. While the ferry is slow it
    is not the receiver that is to blame for that."""
    speed = lambda t: 5.0 * np.clip((t - 10.0) / gets_under_way_s, 0.0, 1.0)  # noqa: E731
    truth = drive(20.0 + gets_under_way_s, speed, lambda t: 0.3 + 0 * t, rate=50.0)
    events = []
    for event in measurements(truth):
        payload = WheelSpeed(0.0) if isinstance(event.payload, WheelSpeed) else event.payload
        events.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, payload))
    settings = config(filter={"heading_deg": math.degrees(0.3), "heading_sigma_deg": 2.0})
    fusion = fuse(settings, events, compiled)
    assert np.linalg.norm(fusion.history.head.nominal[VELOCITY_E] - truth.velocity_e[-1]) < 1.0
    assert miss(fusion, truth) < 4.0
    beliefs = fusion.health(int(fusion.history.head.stamps[T]))
    assert {beliefs[source].status for source in ("gps0.position", "gps0.velocity")} == {"nominal"}


def test_sources_that_were_never_heard(compiled: bool) -> None:
    events = [event for event in measurements(town(6.0, rate=50.0)) if event.source != "rear_right"]
    fusion = fuse(config(), events, compiled)
    assert fusion.health(T0 + 6 * SECOND)["rear_right"].status == "absent"
    assert fusion.history.head.memory[:, [NOISY, BIASED, FROZEN]].max() < 0.5


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (3.6, "it reads 3.60 times the vehicle's speed: is the unit km/h?"),
        (0.0, "it reads 0 while the vehicle moves"),
        (1.5, "it reads 1.50 times the vehicle's speed"),
    ],
)
def test_a_wheel_that_is_wrong_for_good_is_named(factor: float, words: str) -> None:
    memory = np.zeros(MEMORY_SIZE)
    assert health.misreading(memory) == ""
    for speed in (0.5, 1.9, -1.0):
        health.note_rejected(memory, factor * speed, factor * speed - speed)  # too slow to tell
    assert health.misreading(memory) == ""
    for speed in np.linspace(-20.0, 20.0, 50):
        health.note_rejected(memory, factor * speed, factor * speed - speed)
    assert health.misreading(memory) == words


@pytest.mark.parametrize(("factor", "words"), [(3.6, "is the unit km/h?"), (0.0, "it reads 0 while the vehicle moves")])
def test_wheels_of_no_use_do_not_harm_the_others(factor: float, words: str, compiled: bool) -> None:
    """Two wheels of four, from the begin: the health says what they read, and the scale is that of the others."""

    def read(event: Measurement) -> Measurement:
        if event.source.startswith("front") and isinstance(event.payload, WheelSpeed):
            return msgspec.structs.replace(event, payload=WheelSpeed(factor * event.payload.speed))
        return event

    fusion = fuse(config(), [read(event) for event in measurements(town(30.0))], compiled)
    head = fusion.history.head
    for wheel, belief in fusion.health(int(head.stamps[T])).items():
        if wheel.startswith("front"):
            assert belief.status in ("biased", "frozen")
            assert words in belief.reason
        elif wheel.startswith("rear"):
            assert belief.status == "nominal"
            assert fusion.outcomes()[wheel]["REJECTED"] < 0.05 * fusion.outcomes()[wheel]["FUSED"]
    assert abs(head.nominal[WHEEL_SCALE.start]) < 0.01
