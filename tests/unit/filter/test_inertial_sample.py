"""The judgement of inertial samples: what is rejected, how the gap is bridged, who wins the vote, which axis is frozen."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.events import ImuSample, Measurement, WheelSpeed
from fusiond.filter.rows import Outcome
from fusiond.filter.source_health import INERTIAL_AXES
from fusiond.filter.state import ATTITUDE, HELD_RATE_B, PHASE, RATE_B, RUNNING, T_IMU, VELOCITY
from fusiond.maths.rotation import matrix_from_euler
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import ecef
from tests.conftest import needs_compiled
from tests.helpers.streams import MS, SECOND, T0, Drive, config, drive, fuse, measurements, ramp, town, triple

Change = Callable[[Array, float, int], Array]  # a reading (6,) of force and rate, seconds since the begin, number
AT_S = 12.0  # in motion, aligned
UNIT = np.eye(6)  # of each axis
BAD = {
    "gyro x 5 rad/s": lambda z: np.array([*z[:3], 5.0, *z[4:]]),
    "gyro z 5 rad/s": lambda z: np.array([*z[:5], 5.0]),
    "gyro z -3 rad/s more": lambda z: z - 3.0 * UNIT[5],
    "all gyros 34.9": lambda z: np.array([*z[:3], 34.9, 34.9, 34.9]),
    "all accelerometers 159": lambda z: np.array([159.0, 159.0, 159.0, *z[3:]]),
    "accelerometer x 80 more": lambda z: z + 80.0 * UNIT[0],
}


def spoiled(events: list[Measurement], change: Change) -> list[Measurement]:
    """The events with other inertial readings."""
    made, number = [], 0
    for event in events:
        if isinstance(event.payload, ImuSample):
            reading = np.array([*event.payload.specific_force_b, *event.payload.angular_rate_b])
            found = change(reading, (event.t_ns - T0) / SECOND, number)
            made.append(msgspec.structs.replace(event, payload=ImuSample(triple(found[:3]), triple(found[3:]))))
            number += 1
        else:
            made.append(event)
    return made


def from_number(first: int, count: int, bad: Callable[[Array], Array]) -> Change:
    """Spoil so many readings from one on."""
    return lambda z, _t, number: bad(z) if first <= number < first + count else z


def weaving(duration: float, rate: float = 100.0) -> Drive:
    """Pulls away after 3 s, then weaves."""
    def yaw(t: Array) -> Array:
        return np.asarray(0.3 + 0.6 * np.sin(0.4 * t) * ramp(t, 4.0, 4.0))

    return drive(duration, lambda t: 12.0 * ramp(t, 3.0, 6.0), yaw, rate)


def place(fusion: Fusion, t_ns: int) -> Array:
    state = fusion.solution_at(t_ns).state
    assert state is not None
    return np.array(ecef(state.latitude, state.longitude, state.height))


@needs_compiled
@pytest.mark.parametrize("rate", [30.0, 100.0])
@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_bad_samples_change_nothing(rate: float, bad: Callable[[Array], Array], count: int) -> None:
    truth = weaving(AT_S + 4.0, rate)
    events = measurements(truth, seed=4)
    good, fusion = Fusion(config()), Fusion(config())
    worst = 0.0
    for event, other in zip(events, spoiled(events, from_number(round(AT_S * rate), count, bad)), strict=True):
        good.fuse(event)
        fusion.fuse(other)
        if isinstance(event.payload, ImuSample) and event.t_ns > T0 + AT_S * SECOND:
            worst = max(worst, float(np.linalg.norm(place(good, event.t_ns) - place(fusion, event.t_ns))))
    assert fusion.outcomes()["imu0"]["REJECTED"] == count
    assert worst < 0.25


@needs_compiled
@pytest.mark.parametrize("length_s", [0.3, 1.0])
def test_a_second_of_them_is_bridged(length_s: float) -> None:
    """Beyond `imu_gap` the state coasts on wheels and GNSS."""
    truth = weaving(AT_S + 6.0)
    events = measurements(truth, seed=4)
    number = round(length_s * 100)
    bad = fuse(config(), spoiled(events, from_number(1200, number, BAD["gyro z 5 rad/s"])))
    assert number <= bad.outcomes()["imu0"]["REJECTED"] <= number + 5
    end_ns = events[-1].t_ns
    assert np.linalg.norm(place(bad, end_ns) - place(fuse(config(), events), end_ns)) < 1.0


def test_a_rejected_sample_says_by_how_much(compiled: bool) -> None:
    events = [event for event in measurements(weaving(6.0, 50.0), seed=1) if event.t_ns <= T0 + 6 * SECOND]
    fusion = fuse(config(), spoiled(events, from_number(200, 1, lambda z: z + 7.0 * UNIT[4])), compiled)
    rows = fusion.history.rows
    (row,) = rows[(rows["source"] == fusion.params.imu_source) & (rows["outcome"] == Outcome.REJECTED)]
    assert row["t_ns"] == T0 + 4 * SECOND
    assert row["ratio"] > 5
    assert row["innovation"][1] == pytest.approx(7.0, abs=0.2)
    assert abs(row["innovation"][[0, 2]]).max() < 0.2
    assert (row["variance"] > 0).all()
    assert fusion.history.head.stamps[T_IMU] == T0 + 6 * SECOND


def test_nothing_is_interpolated_towards_a_bad_sample(compiled: bool) -> None:
    """A wheel's reading between the held sample and a bad one: the state goes on with the held one, less sure than usual."""
    events = [event for event in measurements(weaving(6.0, 50.0), seed=1) if event.t_ns <= T0 + 5 * SECOND]
    last = events[-1].t_ns
    late = [
        Measurement(last + 8 * MS, "rear_left", 10**6, last + 8 * MS, WheelSpeed(4.0)),
        Measurement(last + 20 * MS, "imu0", 10**6, last + 20 * MS, ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0))),
    ]
    good, bad = fuse(config(), events, compiled), fuse(config(), events, compiled)
    held = good.history.head.auxiliary[HELD_RATE_B].copy()
    for event in late:
        good.fuse(event)
    for event in spoiled(late, lambda z, _t, _n: np.array([159.0, 0, 0, 0, 0, 30.0])):
        bad.fuse(event)
    head = bad.history.head
    assert bad.outcomes()["imu0"]["REJECTED"] == 1
    np.testing.assert_array_equal(head.auxiliary[HELD_RATE_B], held)
    np.testing.assert_array_equal(head.auxiliary[RATE_B], held)
    assert head.stamps[T_IMU] == last
    for block in (ATTITUDE, VELOCITY):
        assert np.trace(head.covariance[block, block]) > 1.0001 * np.trace(good.history.head.covariance[block, block])
    off = np.linalg.norm(head.nominal[:3] - good.history.head.nominal[:3])
    assert off < 0.01


@needs_compiled
def test_a_change_that_lasts_is_believed_after_two_seconds() -> None:
    truth = weaving(AT_S + 4.0)
    events = spoiled(measurements(truth, seed=4), lambda z, t, _: z + 6.0 * (t >= AT_S) * UNIT[5])
    fusion = Fusion(config())
    believed = 0
    for event in events:
        fusion.fuse(event)
        imu = fusion.outcomes()["imu0"]["REJECTED"] if isinstance(event.payload, ImuSample) else 0
        believed = max(believed, imu)
    assert 195 <= believed <= 205


def test_a_bad_sample_after_a_silence_is_given_up_at_the_next(compiled: bool) -> None:
    """It is held, as there is nothing to judge it by; but nothing supports it either."""
    events = [
        event
        for event in measurements(weaving(6.0, 50.0), seed=1)
        if not (isinstance(event.payload, ImuSample) and T0 + 5 * SECOND <= event.t_ns < T0 + 5.4 * SECOND)
    ]
    events = spoiled(events, lambda z, t, _: z + 9.0 * (abs(t - 5.4) < 1e-6) * UNIT[5])
    fusion = fuse(config(), events, compiled)
    assert fusion.history.head.stamps[PHASE] == RUNNING
    assert fusion.outcomes()["imu0"]["REJECTED"] == 0
    assert abs(fusion.history.head.auxiliary[HELD_RATE_B][2]) < 0.5


@needs_compiled
@pytest.mark.parametrize("rate", [20.0, 100.0, 400.0])
def test_a_good_sensor_is_never_rejected(rate: float) -> None:
    """Neither while vibration sets in, nor on a blow of three times gravity within one sample."""
    rng = np.random.default_rng(5)

    def shaken(z: Array, t: float, _: int) -> Array:
        strength = 5.0 if t > 9.0 else 0.2
        blow = 30.0 * UNIT[2] + 0.3 * UNIT[4]
        return z + strength * rng.standard_normal(6) * [1, 1, 1, 0.04, 0.04, 0.04] + (abs(t - 12.0) < 1e-6) * blow

    fusion = fuse(config(imu={"accel_noise": 0.5}), spoiled(measurements(weaving(16.0, rate), seed=2), shaken))
    assert fusion.outcomes()["imu0"]["REJECTED"] == 0


def quantised(z: Array, steps: Array) -> Array:
    return np.asarray(np.rint(z / steps) * steps)


STEPS = np.array([0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3])  # of a MAVLink SCALED_IMU
MOUNTED = {"none": (0.0, 0.0, 0.0), "turned": (-179.2, 7.1, -175.0)}


@needs_compiled
@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("rotation_deg", MOUNTED.values(), ids=MOUNTED)
def test_a_frozen_axis_is_named(axis: int, rotation_deg: tuple[float, float, float]) -> None:
    turn = np.kron(np.eye(2), matrix_from_euler(*np.radians(rotation_deg)))
    kept = np.zeros(6)

    def frozen(z: Array, t: float, _: int) -> Array:
        sensed = quantised(turn.T @ z, STEPS)
        if t >= AT_S:
            sensed[axis] = kept[axis]
        kept[:] = sensed
        return np.asarray(turn @ sensed)

    fusion = Fusion(config(imu={"rotation_deg": rotation_deg}))
    named = None
    for event in spoiled(measurements(weaving(AT_S + 4.0), seed=6), frozen):
        fusion.fuse(event)
        health = fusion.health(event.t_ns)["imu0"]
        if event.t_ns < T0 + AT_S * SECOND:
            assert health.status == "nominal"
        elif health.status == "frozen" and named is None:
            named = (event.t_ns - T0) / SECOND - AT_S
            assert health.reason.startswith(f"{INERTIAL_AXES[axis]} repeats")
    assert named is not None
    assert named < 1.0
    assert fusion.outcomes()["imu0"]["REJECTED"] > 200  # and is not used


@needs_compiled
def test_a_saturated_axis_is_named_and_believed_again() -> None:
    def saturated(z: Array, t: float, _: int) -> Array:
        return np.array([*z[:5], 4.363]) if AT_S <= t < AT_S + 3.0 else quantised(z, STEPS)

    fusion = Fusion(config())
    reasons = set()
    for event in spoiled(measurements(weaving(AT_S + 8.0), seed=6), saturated):
        fusion.fuse(event)
        if 0.5 * SECOND < event.t_ns - T0 - AT_S * SECOND < 2.9 * SECOND:
            reasons.add(fusion.health(event.t_ns)["imu0"].reason)
    assert reasons == {"gyro z sits at its largest reading: saturated while the other axes move; not fused"}
    assert fusion.health(event.t_ns)["imu0"].status == "nominal"
    assert fusion.history.head.stamps[T_IMU] > T0 + (AT_S + 7.9) * SECOND


@needs_compiled
def test_a_quantised_sensor_at_rest_is_not_called_frozen() -> None:
    """Most of its readings repeat the one before, some axes for seconds."""
    rng = np.random.default_rng(3)

    def coarse(z: Array, _t: float, _n: int) -> Array:
        return quantised(z + 0.3 * STEPS * rng.standard_normal(6), STEPS)

    still = drive(120.0, lambda t: 0 * t, lambda t: 0 * t + 0.3)
    events = spoiled(measurements(still, seed=None), coarse)
    fusion = Fusion(config(filter={"heading_deg": 20.0}))
    for event in events:
        fusion.fuse(event)
        assert fusion.health(event.t_ns)["imu0"].status == "nominal"
    assert fusion.outcomes()["imu0"]["REJECTED"] == 0


@needs_compiled
def test_no_alarm_in_a_drive() -> None:
    for seed in range(3):
        fusion = fuse(config(), spoiled(measurements(town(40.0), seed=seed), lambda z, _t, _n: quantised(z, STEPS)))
        assert fusion.outcomes()["imu0"]["REJECTED"] == 0
        assert fusion.health(T0 + 40 * SECOND)["imu0"].probabilities[3] < 0.1


@needs_compiled
def test_a_coarse_sensor_that_repeats_itself_is_not_called_frozen() -> None:
    """SCALED_IMU, and an autopilot's filters have taken most of the noise away: on a straight road all axes repeat."""
    rng = np.random.default_rng(3)

    def coarse(z: Array, _t: float, _n: int) -> Array:
        return quantised(z + 0.2 * STEPS * rng.standard_normal(6), STEPS)

    straight = drive(60.0, lambda t: 12.0 * ramp(t, 3.0, 6.0), lambda t: 0 * t + 0.3)
    fusion = Fusion(config(filter={"heading_deg": 17.2}))
    for event in spoiled(measurements(straight, seed=None), coarse):
        fusion.fuse(event)
        assert fusion.health(event.t_ns)["imu0"].status != "frozen"
