"""The table of events: where one goes, and from which row on it changes results; which events only the interpreter takes."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.events import Measurement, WheelSpeed
from fusiond.filter.kernel.interpreted import make_kernel
from fusiond.filter.parameters import make_parameters
from fusiond.filter.rows import ROW, Outcome
from fusiond.filter.state import (
    ALIGNING,
    CHOOSING,
    EMPTY,
    GYRO_BIAS_B,
    PHASE,
    POSITION_E,
    RESETS,
    RUNNING,
    T_IMU,
    FilterState,
    T,
)
from fusiond.filter.step import can_step, first_changed, yaw_variance
from fusiond.maths.typed import Array
from fusiond.units import nanoseconds
from tests.helpers.streams import MS, SECOND, T0, config, drive, measurements, ramp, running_state

PARAMS = make_parameters(config(filter={"restart_gap_s": 30.0, "imu_gap_s": 0.2}))
IMU, POSITION, WHEEL = (PARAMS.sources.index(name) for name in ("imu0", "gps0.position", "front_left"))
Key = tuple[int, int, int]  # t_ns, source, sequence


def table(keys: list[Key], room: int = 0) -> np.ndarray:
    rows = np.zeros(len(keys) + room, dtype=ROW)
    for row, (t_ns, source, sequence) in zip(rows, keys, strict=False):
        row["t_ns"], row["source"], row["sequence"] = t_ns, source, sequence
    return rows


@pytest.mark.parametrize("seed", range(5))
def test_an_event_goes_where_its_key_belongs(compiled: bool, seed: int) -> None:
    """Keys of few stamps, sources and sequences, so that many meet; inserted one by one, and compared with a sorted set."""
    rng, kernel = np.random.default_rng(seed), make_kernel(PARAMS, compiled)
    begin, end, kept = 3, 3, set[Key]()  # the live part need not begin with the table
    rows, head = table([], 80), FilterState(len(PARAMS.sources))
    rows["t_ns"] = T0 + 5
    counts = np.zeros((len(PARAMS.sources), len(Outcome)), np.int64)
    kernel.attach(head, rows, counts, head.numbers[None].copy(), head.whole[None].copy(), np.zeros(1, np.int64))
    for _ in range(70):
        t_ns, source, sequence = key = T0 + int(rng.integers(5)), int(rng.integers(4)), int(rng.integers(4))
        place = kernel.place(begin, end, *key)
        if key in kept:
            assert ~place == sorted(kept).index(key)
            continue
        kept.add(key)
        assert place == sorted(kept).index(key)
        kernel.insert(begin + place, end, t_ns, source, sequence, 0, 0, ())
        end += 1
    found = [(int(row["t_ns"]), int(row["source"]), int(row["sequence"])) for row in rows[begin:end]]
    assert found == sorted(kept)
    assert counts.sum() == len(kept)


def test_an_imu_sample_changes_what_interpolates_to_it() -> None:
    """That is what lies between it and the sample before it, but for that sample's own instant; any other event changes what
    comes after it."""
    ms = [(0, IMU), (0, WHEEL), (3, WHEEL), (3, POSITION), (7, WHEEL), (10, IMU), (12, WHEEL)]
    rows = table([(T0 + t * MS, source, number) for number, (t, source) in enumerate(ms)])
    assert [first_changed(rows, 0, new, PARAMS) for new in range(len(rows))] == [0, 1, 2, 3, 4, 2, 6]
    assert first_changed(rows, 3, 2, PARAMS) == 0  # rows before the live part are out of reach
    assert first_changed(rows, 1, 4, PARAMS) == 0  # and without a sample in it, all its rows interpolate


@pytest.mark.parametrize(
    ("phase", "source", "after_s", "taken"),
    [
        (EMPTY, IMU, 0.01, False),  # the first event begins the alignment
        (ALIGNING, IMU, 0.01, True),
        (ALIGNING, WHEEL, 0.01, True),
        (ALIGNING, POSITION, 0.01, False),  # may start the filter
        (ALIGNING, IMU, 30.001, False),
        (CHOOSING, POSITION, 0.01, True),
        (CHOOSING, IMU, 30.0, True),
        (RUNNING, POSITION, 30.0, True),
        (RUNNING, POSITION, 30.001, False),  # a hole in the data
        (RUNNING, IMU, 0.2, True),
        (RUNNING, IMU, 29.0, False),  # back after so long that the heading may be lost
        (RUNNING, WHEEL, 29.0, True),
    ],
)
def test_what_only_the_interpreter_takes(phase: int, source: int, after_s: float, taken: bool) -> None:
    state = running_state(np.random.default_rng(1))
    state.covariance[6:9, 6:9] = 1e-6 * np.eye(3)
    state.stamps[[PHASE, T, T_IMU]] = phase, T0, T0
    row = table([(T0 + round(after_s * SECOND), source, 0)])[0]
    assert can_step(state, row, PARAMS) is taken


def test_yaw_variance_is_that_about_the_vertical() -> None:
    """A turn of so much variance about an axis that leans by 60 degrees shows with a quarter of it."""
    state = FilterState(1)
    state.nominal[:3] = 0.0, 0.0, 6.4e6
    axis = np.array([np.sin(np.radians(60.0)), 0.0, np.cos(np.radians(60.0))])
    state.covariance[6:9, 6:9] = 0.04 * np.outer(axis, axis)
    assert yaw_variance(state) == pytest.approx(0.01, rel=1e-12)


HALF_TRACK = 0.78  # m


@pytest.mark.parametrize("how", ["silent", "frozen"])
def test_the_wheels_of_an_axle_turn_a_state_without_inertial_sensor(how: str, compiled: bool) -> None:
    """Without GNSS and, for 2 s in a slalom, without an inertial sensor that is of use, two rear wheels are all there is.
    The published rate is true meanwhile, and the gyro bias is not touched by it."""
    pace = 0.5

    def yaw(t: Array) -> Array:
        return 0.7 + 0.6 * np.sin(pace * t) * ramp(t, 3.0, 6.0)

    truth = drive(40.0, lambda t: 12.0 * ramp(t, 3.0, 4.0), yaw)
    rate = np.gradient(yaw(truth.seconds), truth.seconds)
    events = [e for e in measurements(truth, ()) if e.t_ns < T0 + 24 * SECOND or not e.source.startswith("gps0")]
    silent = range(T0 + 25 * SECOND, T0 + 27 * SECOND)
    last = next(e.payload for e in events if e.source == "imu0" and e.t_ns >= silent.start)
    if how == "silent":
        events = [e for e in events if e.source != "imu0" or e.t_ns not in silent]
    else:
        stuck = [e for e in events if e.source == "imu0" and e.t_ns in silent]
        others = [e for e in events if e.source != "imu0" or e.t_ns not in silent]
        events = others + [msgspec.structs.replace(e, payload=last) for e in stuck]
    for name, y in (("rear_left", -HALF_TRACK), ("rear_right", HALF_TRACK)):
        for i, k in enumerate(range(0, len(truth.seconds), 5)):
            t_ns = T0 + nanoseconds(float(truth.seconds[k]))
            speed = WheelSpeed(float(truth.speed[k] - rate[k] * y))
            events.append(Measurement(t_ns, name, i, t_ns + 5_000_000, speed))
    settings = config(("rear_left", "rear_right"), wheel={"sigma_mps": 0.03})
    sides = {"rear_left": -HALF_TRACK, "rear_right": HALF_TRACK}
    placed = {n: msgspec.structs.replace(w, position_m=(0.0, sides[n], 0.0)) for n, w in settings.wheel.items()}
    fusion = Fusion(msgspec.structs.replace(settings, wheel=placed), compiled)
    bias = np.zeros(3)
    for event in sorted(events, key=lambda event: event.key):
        fusion.fuse(event)
        if event.source == "rear_right" and event.t_ns == T0 + 24_900_000_000:
            bias = fusion.history.head.nominal[GYRO_BIAS_B].copy()
        if event.source == "rear_right" and event.t_ns == T0 + 26_900_000_000:
            found = fusion.solution_at(event.t_ns).state
            assert found is not None
            assert abs(found.angular_rate_b[2] - rate[truth.at(26.9)]) < 0.06
            np.testing.assert_allclose(found.gyro_bias, bias, atol=1e-3)
    head = fusion.history.head
    assert head.stamps[RESETS] == 0
    heading = fusion.solution_at(int(head.stamps[T])).state
    assert heading is not None
    w, x, y, z = heading.quaternion_nb
    off = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - float(yaw(truth.seconds)[-1])
    assert abs(math.degrees(off)) < 2.0
    assert np.linalg.norm(head.nominal[POSITION_E] - truth.position_e[truth.at(40.0)]) < 12.0
