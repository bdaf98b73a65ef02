"""The standstill detector and the constraints: when they hold, when they must not, and what they are worth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np
import pytest
from msgspec.structs import replace

from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.filter.motion_constraints import doubt_turn
from fusiond.filter.observations.model import mat_eb
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    ATTITUDE,
    CONSTRAINT_FUSED,
    GYRO_BIAS,
    GYRO_BIAS_B,
    LAST_SPEED,
    NEVER,
    POSITION_E,
    T_LAST,
    T_STILL,
    VELOCITY_E,
    T,
)
from fusiond.maths.wgs84 import EARTH_RATE, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import SECOND, T0, WHEELS, Drive, config, drive, fuse, measurements, running_state

BIAS = (0.004, -0.003, 0.005)  # rad/s
FACING = {"heading_deg": math.degrees(0.4), "heading_sigma_deg": 1.0}


def parked(seconds: float = 6.0) -> Drive:
    return drive(seconds, lambda t: 0 * t, lambda t: 0.4 + 0 * t, rate=50.0)


def stands(fusion: Fusion) -> bool:
    return bool(fusion.history.head.stamps[T_STILL] != NEVER)


def counts(fusion: Fusion) -> tuple[int, int, int]:
    """Updates fused: non-holonomic, zero velocity, zero rotation."""
    non_holonomic, velocity, rotation = fusion.history.head.stamps[CONSTRAINT_FUSED].tolist()
    return non_holonomic, velocity, rotation


def changed(events: Iterable[Measurement], kind: type, change: dict[str, object] | None) -> list[Measurement]:
    """The events with the payloads of one kind replaced by `kind(**change)`, or dropped."""
    held = []
    for event in events:
        if not isinstance(event.payload, kind):
            held.append(event)
        elif change is not None:
            payload = kind(**change)
            held.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, payload))
    return held


def test_standstill(compiled: bool) -> None:
    fusion = fuse(config(filter=FACING), measurements(parked()), compiled)
    non_holonomic, velocity, rotation = counts(fusion)
    assert stands(fusion)
    assert non_holonomic == 0
    # from 0.8 s on it is seen, from 0.5 s later it is used, ten times a second
    assert velocity == rotation == pytest.approx((6.0 - 1.3) * 10, abs=2)
    assert np.linalg.norm(fusion.history.head.nominal[VELOCITY_E]) < 0.1


def test_turning_wheels_are_no_standstill(compiled: bool) -> None:
    """A wheel that turns slowly on a vehicle whose IMU feels nothing: creeping, or on a ferry."""
    events = changed(measurements(parked(3.0)), WheelSpeed, {"speed": 0.2})
    fusion = fuse(config(filter=FACING), events, compiled)
    assert not stands(fusion)
    assert counts(fusion)[1:] == (0, 0)


def test_silent_wheels_tell_nothing_of_standing(compiled: bool) -> None:
    fusion = fuse(config(filter=FACING), changed(measurements(parked(3.0)), WheelSpeed, None), compiled)
    assert not stands(fusion)
    one = [event for event in measurements(parked(3.0)) if event.source != "rear_left"]
    assert stands(fuse(config(filter=FACING), one, compiled))


@pytest.mark.parametrize(("axis", "sigma"), [("specific_force_b", 1.0), ("angular_rate_b", 0.03)])
def test_vibration_is_no_standstill(compiled: bool, axis: str, sigma: float) -> None:
    rng, events = np.random.default_rng(1), []
    for event in measurements(parked(3.0)):
        payload = event.payload
        if isinstance(payload, ImuSample):
            shaken = {"specific_force_b": payload.specific_force_b, "angular_rate_b": payload.angular_rate_b}
            shaken[axis] = tuple((np.array(shaken[axis]) + rng.normal(0.0, sigma, 3)).tolist())
            payload = ImuSample(**shaken)
        events.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, payload))
    fusion = fuse(config(filter=FACING), events, compiled)
    assert not stands(fusion)
    assert counts(fusion)[1:] == (0, 0)


def test_switched_off(compiled: bool) -> None:
    motion = {"standstill": False, "non_holonomic": False}
    fusion = fuse(config(filter=FACING, motion=motion), measurements(parked(3.0)), compiled)
    assert counts(fusion) == (0, 0, 0)


def test_end_of_a_standstill(compiled: bool) -> None:
    def speed(t: np.ndarray) -> np.ndarray:
        return 3.0 * np.clip(t - 4.0, 0.0, None)

    truth = drive(6.0, speed, lambda t: 0.4 + 0 * t, rate=50.0)
    events = measurements(truth)
    standing = fuse(config(filter=FACING), [event for event in events if event.t_ns < T0 + 4 * SECOND], compiled)
    driving = fuse(config(filter=FACING), events, compiled)
    assert stands(standing)
    assert not stands(driving)
    assert counts(driving)[1] - counts(standing)[1] <= 2  # none is left that holds the vehicle back
    assert counts(driving)[0] > 10
    speed_n = np.linalg.norm(driving.history.head.nominal[VELOCITY_E])
    assert speed_n == pytest.approx(truth.speed[-1], abs=0.3)


def test_zero_rotation_finds_the_gyro_bias(compiled: bool) -> None:
    """The bias is that of the mean before the start, so the start is made without: the vehicle drives up, and stands."""

    def speed(t: np.ndarray) -> np.ndarray:
        return 3.0 * np.clip(4.0 - t, 0.0, None)

    events = measurements(drive(10.0, speed, lambda t: 0.4 + 0 * t, rate=50.0), gyro_bias=BIAS)
    errors, sigmas = [], []
    for used in (True, False):
        head = fuse(config(filter=FACING, motion={"standstill": used}), events, compiled).history.head
        errors.append(np.abs(head.nominal[GYRO_BIAS_B] - BIAS).max())
        sigmas.append(np.sqrt(np.diag(head.covariance)[GYRO_BIAS]).max())
    assert errors[0] < 4e-4
    assert errors[0] < 4 * sigmas[0]
    assert sigmas[0] < sigmas[1] / 3


@needs_compiled
def test_non_holonomic_constraint_bounds_the_lateral_drift() -> None:
    """Without GNSS the wheels know how far, the constraint knows where to."""
    truth = drive(30.0, lambda t: 15.0 + 0 * t, lambda t: 0.4 + 0 * t, rate=50.0)
    misses = []
    for used in (True, False):
        events = [
            event
            for event in measurements(truth, accel_bias=(0.0, 0.3, 0.0))
            if not isinstance(event.payload, GnssPosition | GnssVelocity) or event.t_ns < T0 + 8 * SECOND
        ]
        motion = {"non_holonomic": used, "standstill": False}
        head = fuse(config(filter=FACING, motion=motion), events, True).history.head
        off = truth.mat_eb[-1].T @ (head.nominal[POSITION_E] - truth.position_e[-1])
        misses.append(abs(off[1]))
    assert misses[0] < 3.0  # of 330 m
    assert misses[0] < misses[1] / 2


def test_quiet_drive_without_wheels_is_no_standstill(compiled: bool) -> None:
    """A boat in an even turn feels as still as one at its mooring: the turn must not pass for the gyro's bias."""
    rate = math.radians(0.4)
    truth = drive(20.0, lambda t: 8.0 + 0 * t, lambda t: 0.4 + rate * t, rate=50.0)
    fusion = fuse(config((), filter=FACING), measurements(truth, (), seed=None), compiled)
    head = fusion.history.head
    _, velocity, rotation = counts(fusion)
    assert (velocity, rotation) == (0, 0)
    assert not stands(fusion)  # it feels like standstill, and the velocity denies it
    assert np.abs(head.nominal[GYRO_BIAS_B]).max() < 1e-4
    assert fusion.totals()["REJECTED"] == 0


@needs_compiled
def test_wheels_do_not_tell_the_heading() -> None:
    """Without GNSS nothing tells it: an error of the heading turns velocity and path along, and its sigma never shrinks."""
    truth = drive(90.0, lambda t: 12.0 + 3.0 * np.sin(0.2 * t), lambda t: 0.4 + 0.3 * np.sin(0.1 * t), rate=50.0)
    events = [event for event in measurements(truth) if not event.source.startswith("gps0")]
    first = [event for event in measurements(truth) if event.source.startswith("gps0") and event.t_ns < T0 + 2 * SECOND]
    fusion, sigmas = Fusion(config(filter=FACING | {"heading_sigma_deg": 5.0})), []
    for event in sorted(events + first, key=lambda event: event.key):
        fusion.fuse(event)
        if event.source == "imu0" and event.sequence % 500 == 0 and event.t_ns > T0 + 4 * SECOND:
            state = fusion.solution_at(event.t_ns).state
            assert state is not None
            sigmas.append(math.degrees(state.sigma_yaw()))
    assert all(later > 0.95 * earlier for earlier, later in itertools.pairwise(sigmas))  # but for the second order


def doubted(speed: float, told_s: float = 2.0) -> float:
    """Sigma of the heading [rad] after a turn at rest by 0.2 rad/s for 1 s and back, where the wheels at both sides, 1.6 m
    apart, read `speed` [m/s], and a measurement tells the heading at `told_s`."""
    sides = {name: {"position_m": (0.0, -0.8 if "left" in name else 0.8, 0.3)} for name in WHEELS}
    whole = config()
    whole = replace(whole, wheel={name: replace(whole.wheel[name], **sides[name]) for name in WHEELS})
    params = make_parameters(whole)
    state = running_state(np.random.default_rng(3))
    down = mat_ne(state.nominal[POSITION_E])[2]
    state.covariance[ATTITUDE, ATTITUDE] = 1e-6 * np.eye(3)
    for i in params.wheels:
        state.memory[i, LAST_SPEED], state.source_stamps[i, T_LAST] = speed, state.stamps[T]
    level_b = mat_eb(state).T @ down
    for k in range(200):
        if k == round(told_s * 100):
            state.covariance[ATTITUDE, ATTITUDE] = 1e-6 * np.eye(3)
        earth_b = mat_eb(state).T @ [0.0, 0.0, EARTH_RATE]
        rate = (0.2 if k < 100 else -0.2) * level_b
        doubt_turn(state, state.nominal[GYRO_BIAS_B] + earth_b + rate, 0.01, params)
    return math.sqrt(down @ state.covariance[ATTITUDE, ATTITUDE] @ down)


def test_a_turn_at_rest_is_doubted() -> None:
    """As far as the wheels do not show it, and until a measurement tells the heading."""
    assert doubted(0.0) == pytest.approx(0.2, rel=1e-6)
    assert doubted(0.04) == pytest.approx(0.15, rel=1e-6)  # 0.05 rad/s by the wheels
    assert doubted(0.09) == pytest.approx(0.2 - 0.1125, rel=1e-6)
    assert doubted(0.11) == pytest.approx(1e-3, rel=1e-6)  # they turn
    assert doubted(0.0, 1.0) == pytest.approx(1e-3, rel=1e-6)
    assert doubted(0.0, 0.5) == pytest.approx(math.sqrt(0.2**2 - 0.1**2 + 1e-6), rel=1e-6)
