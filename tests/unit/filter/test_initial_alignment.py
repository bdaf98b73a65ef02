"""The start of the filter: at rest and in motion, level, headed, freed of bias; what it waits for; starting again."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.estimator.solution import Mode
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.filter.heading_bank import BANK_SIGMA
from fusiond.filter.hot_start import Heading as StoredHeading
from fusiond.filter.initial_alignment import _all_round, _weight_of
from fusiond.filter.rows import Outcome
from fusiond.filter.state import (
    ALIGNING,
    ATTITUDE,
    BLOWN,
    CHOOSING,
    GYRO_BIAS,
    GYRO_BIAS_B,
    PHASE,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RESET_REASON,
    RESETS,
    RUNNING,
    T_START,
    VELOCITY,
    VELOCITY_E,
    ResetReason,
    T,
)
from fusiond.filter.step import LOST_HEADING, yaw_variance
from fusiond.maths.rotation import euler, matrix, matrix_from_euler, skew
from tests.conftest import needs_compiled
from tests.helpers.streams import MS, PULLS_AWAY_S, SECOND, T0, WHEELS, Drive, bits, config, drive, fuse, measurements, ramp

HEADING = 0.4  # rad
GIVEN = {"heading_deg": math.degrees(HEADING), "heading_sigma_deg": 2.0}


def straight(seconds: float, speed: float, acceleration: float = 0.0) -> Drive:
    return drive(seconds, lambda t: speed + acceleration * t, lambda t: HEADING + 0 * t, rate=50.0)


def start(fusion: Fusion, events: list[Measurement]) -> float:
    """Feed events until the filter runs; the instant at which it started [s]."""
    for event in events:
        fusion.fuse(event)
        if fusion.history.head.stamps[PHASE] == RUNNING:
            return float(fusion.history.head.stamps[T_START] - T0) / SECOND
    raise AssertionError("the filter did not start")


def attitude(fusion: Fusion) -> tuple[float, float, float]:
    """Roll, pitch, yaw [deg]."""
    estimate = fusion.solution_at(int(fusion.history.head.stamps[T])).state
    assert estimate is not None
    roll, pitch, yaw = np.degrees(estimate.euler())
    return float(roll), float(pitch), float(yaw)


def tilted(events: list[Measurement], roll: float, pitch: float) -> list[Measurement]:
    """As measured by an IMU on a vehicle that stands askew, facing as before."""
    turn = matrix_from_euler(roll, pitch, 0.0).T
    held = []
    for event in events:
        if isinstance(event.payload, ImuSample):
            force, rate = (tuple((turn @ part).tolist()) for part in msgspec.structs.astuple(event.payload))
            held.append(msgspec.structs.replace(event, payload=ImuSample(force, rate)))
        else:
            held.append(event)
    return held


def test_at_rest_with_a_given_heading(compiled: bool) -> None:
    truth = straight(3.0, 0.0)
    fusion = Fusion(config(filter=GIVEN, gnss={"lever_arm_m": (0.5, 0.0, -1.0)}), compiled)
    events = tilted(measurements(truth, seed=None), math.radians(5), math.radians(-3))
    assert start(fusion, events) == pytest.approx(0.86)  # the first fix after the 0.8 s of leveling
    np.testing.assert_allclose(attitude(fusion), (5.0, -3.0, math.degrees(HEADING)), atol=1e-3)
    head = fusion.history.head
    antenna = head.nominal[POSITION_E] + matrix(head.nominal[QUATERNION_EB]) @ (0.5, 0.0, -1.0)
    np.testing.assert_allclose(antenna, truth.position_e[0], atol=1e-6)
    np.testing.assert_allclose(head.nominal[VELOCITY_E], 0.0, atol=1e-4)
    sigma = np.sqrt(np.diag(head.covariance))
    mat_nb = matrix_from_euler(math.radians(5), math.radians(-3), HEADING)
    arm = skew(mat_nb @ (0.5, 0.0, -1.0)) * np.radians([3.0, 3.0, 2.0])  # what the attitude makes of the antenna's
    assert np.linalg.norm(sigma[0:3]) == pytest.approx(math.sqrt(1.5**2 + 1.5**2 + 3.0**2 + np.sum(arm**2)))
    assert sigma[3:6].max() < 0.1  # it stands
    assert np.linalg.norm(sigma[6:9]) == pytest.approx(math.radians(math.sqrt(3.0**2 + 3.0**2 + 2.0**2)))


def test_at_rest_without_a_heading_it_waits(compiled: bool) -> None:
    fusion = fuse(config(), measurements(straight(4.0, 0.0)), compiled)
    assert fusion.history.head.stamps[PHASE] == CHOOSING
    estimate = fusion.solution_at(T0 + 4 * SECOND)
    assert (estimate.mode, estimate.state) == (Mode.ALIGNING, None)
    assert fusion.totals()["GATHERED"] == sum(fusion.totals().values())  # there is no state that anything went into


def test_in_motion_by_the_course(compiled: bool) -> None:
    truth = straight(4.0, 12.0)
    fusion = Fusion(config(), compiled)
    started = start(fusion, measurements(truth))
    assert started == pytest.approx(1.06)  # a second after the first velocity
    roll, pitch, yaw = attitude(fusion)
    assert yaw == pytest.approx(math.degrees(HEADING), abs=2.0)
    assert max(abs(roll), abs(pitch)) < 1.0
    head, now = fusion.history.head, truth.at(started)
    np.testing.assert_allclose(head.nominal[VELOCITY_E], truth.velocity_e[now], atol=0.4)
    np.testing.assert_allclose(head.nominal[POSITION_E], truth.position_e[now], atol=5.0)


def test_slow_motion_has_no_course(compiled: bool) -> None:
    fusion = fuse(config(filter={"course_speed_mps": 5.0}), measurements(straight(3.0, 4.5)), compiled)
    assert fusion.history.head.stamps[PHASE] == CHOOSING
    assert fusion.solution_at(T0 + 3 * SECOND).state is None


@pytest.mark.parametrize("heading", [{}, GIVEN], ids=["by course", "given"])
@pytest.mark.parametrize("acceleration", [-2.5, 0.0, 2.5])
def test_leveling_takes_the_acceleration_out(compiled: bool, acceleration: float, heading: dict[str, float]) -> None:
    """Uncompensated, 2.5 m/s^2 would pass for a slope of 14 deg; a velocity taken for its change, for anything."""
    truth = straight(4.0, 20.0, acceleration)
    fusion = Fusion(config(filter=heading), compiled)
    start(fusion, measurements(truth, seed=None))
    roll, pitch, yaw = attitude(fusion)
    assert max(abs(roll), abs(pitch)) < 0.6
    assert yaw == pytest.approx(math.degrees(HEADING), abs=0.1)
    speed = np.linalg.norm(fusion.history.head.nominal[VELOCITY_E])
    assert speed == pytest.approx(truth.speed[truth.at(1.03)], abs=0.1)


def test_given_heading_on_a_smooth_road_without_wheels(compiled: bool) -> None:
    """A vehicle that drives without a tremor looks as if it stood: its GNSS velocity says that it does not."""
    fusion = fuse(config((), filter=GIVEN), measurements(straight(6.0, 20.0), (), seed=None), compiled)
    assert fusion.totals()["REJECTED"] == 0
    assert np.linalg.norm(fusion.history.head.nominal[VELOCITY_E]) == pytest.approx(20.0, abs=0.1)


def without_velocity(events: list[Measurement]) -> list[Measurement]:
    return [event for event in events if not isinstance(event.payload, GnssVelocity)]


def test_fixes_without_a_velocity_start_a_bank(compiled: bool) -> None:
    """As soon as it is clear that no velocity is to come: 3 s after the first fix."""
    truth = straight(5.0, 12.0)
    fusion = Fusion(config(), compiled)
    for event in without_velocity(measurements(truth)):
        fusion.fuse(event)
        if fusion.history.head.stamps[PHASE] == CHOOSING:
            break
    head = fusion.history.head
    assert float(head.stamps[T_START] - T0) / SECOND == pytest.approx(3.06)
    first = head.hypothesis(0)
    assert np.sqrt(np.diag(first.covariance)[VELOCITY]) == pytest.approx(20.0)  # a third of v_max_mps
    own = math.hypot(math.radians(3.0), 1.0 / 9.78)  # of the level: what half a second's acceleration makes of gravity
    attitude_sigma = np.sqrt(np.trace(first.covariance[ATTITUDE, ATTITUDE]))
    assert attitude_sigma == pytest.approx(math.hypot(own, own, BANK_SIGMA), rel=1e-3)


def test_a_velocity_that_comes_is_waited_for(compiled: bool) -> None:
    """However slow it is, a start from it is better than one from the fixes."""
    truth = straight(4.0, 4.5)
    fusion = fuse(config(), [event for event in measurements(truth) if event.t_ns < T0 + SECOND], compiled)
    assert fusion.history.head.stamps[PHASE] == ALIGNING
    fusion = fuse(config(), measurements(truth), compiled)
    assert float(fusion.history.head.stamps[T_START] - T0) / SECOND == pytest.approx(1.06)


@needs_compiled
@pytest.mark.parametrize("wheels", [WHEELS, ()], ids=["wheels", "no wheels"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_fixes_alone_tell_the_heading(seed: int, wheels: tuple[str, ...]) -> None:
    truth = drive(30.0, lambda t: 8.0 + 2.0 * np.sin(0.6 * t), lambda t: seed + 0.5 * np.sin(0.3 * t), rate=50.0)
    fusion = fuse(config(wheels), without_velocity(measurements(truth, wheels, seed=seed)), True)
    off = attitude(fusion)[2] - math.degrees(seed + 0.5 * math.sin(0.3 * 30.0))
    assert abs((off + 180) % 360 - 180) < 3.0
    head = fusion.history.head
    assert head.stamps[RESETS] == 0
    np.testing.assert_allclose(head.nominal[VELOCITY_E], truth.velocity_e[-1], atol=0.5)


VAGUE = 60.0  # deg


@needs_compiled
@pytest.mark.parametrize("speed", [3.0, 12.0])
@pytest.mark.parametrize("sigma_deg", [9.0, 20.0, VAGUE, 1000.0])
@pytest.mark.parametrize("sigmas", [0, 1, -2])
def test_a_vague_heading_is_a_prior(sigmas: int, sigma_deg: float, speed: float) -> None:
    """Right or two sigmas off, it ends where a start without one ends."""
    truth = drive(12.0, lambda t: speed + 0.8 * np.sin(t), lambda t: HEADING + 0.1 * t, rate=50.0)
    given = (math.degrees(HEADING) + sigmas * sigma_deg) % 360
    fusion = fuse(config(filter={"heading_deg": given, "heading_sigma_deg": sigma_deg}), measurements(truth), True)
    assert attitude(fusion)[2] == pytest.approx(math.degrees(HEADING + 1.2), abs=2.0)
    assert fusion.history.head.stamps[RESETS] == 0


@needs_compiled
@pytest.mark.parametrize("sigma_deg", [2.0, 25.0])
def test_a_heading_that_the_course_contradicts_loses(sigma_deg: float) -> None:
    truth = drive(8.0, lambda t: 14.0 + 0 * t, lambda t: HEADING + 0.1 * t, rate=50.0)
    wrong = {"heading_deg": math.degrees(HEADING) - 140.0, "heading_sigma_deg": sigma_deg}
    fusion = fuse(config(filter=wrong), measurements(truth), True)
    assert attitude(fusion)[2] == pytest.approx(math.degrees(HEADING + 0.8), abs=2.0)
    assert fusion.history.head.stamps[RESETS] == 0


@needs_compiled
def test_a_heading_that_the_course_contradicts_wins_in_reverse() -> None:
    """Backwards at the speed of a course: what the body feels decides for the given heading."""
    truth = drive(10.0, lambda t: -10.0 - 2.0 * np.sin(t), lambda t: HEADING + 0.1 * t, rate=50.0)
    fusion = fuse(config(filter=GIVEN), measurements(truth), True)
    assert attitude(fusion)[2] == pytest.approx(math.degrees(HEADING + 1.0), abs=2.0)


def pulling_away(turned: float, speed: float, seconds: float = 12.0) -> list[Measurement]:
    """Stands for 3 s, then drives off with a heading so far from the given one."""
    curve = lambda t: speed * ramp(t, PULLS_AWAY_S, 4.0)  # noqa: E731
    truth = drive(seconds, curve, lambda t: HEADING + turned + 0.2 * np.sin(0.5 * t) * ramp(t, 3.0, 3.0), rate=50.0)
    return measurements(truth)


def confirmed(fusion: Fusion) -> bool:
    return fusion.solution_at(int(fusion.history.head.stamps[T])).heading_confirmed


def test_a_given_heading_is_confirmed_by_the_drive(compiled: bool) -> None:
    """Also below the speed of a course; at rest nothing confirms it."""
    fusion, events = Fusion(config(filter=GIVEN), compiled), pulling_away(0.05, 3.0, 6.0)
    for event in events:
        fusion.fuse(event)
        if event.t_ns == T0 + PULLS_AWAY_S * SECOND:
            assert fusion.history.head.stamps[PHASE] == RUNNING and not confirmed(fusion)
    assert confirmed(fusion)
    assert fusion.history.head.stamps[RESETS] == 0


@needs_compiled
@pytest.mark.parametrize("turned_deg", [60.0, 144.0, 180.0])
def test_a_given_heading_that_the_drive_contradicts_is_dropped(turned_deg: float) -> None:
    """It is never called confirmed, and soon after the speed of a course the right one is known."""
    fusion = Fusion(config(filter=GIVEN), True)
    for event in pulling_away(math.radians(turned_deg), 14.0, 14.0):
        fusion.fuse(event)
        if event.source == "gps0.velocity" and confirmed(fusion):
            off = attitude(fusion)[2] - math.degrees(HEADING) - turned_deg
            assert abs((off + 180) % 360 - 180) < 25.0  # it weaves by 11 deg
    assert confirmed(fusion)
    head = fusion.history.head
    assert (head.stamps[RESETS], head.stamps[RESET_REASON]) == (1, ResetReason.HEADING_DECIDED)


@needs_compiled
def test_both_kernels_prove_a_heading_alike() -> None:
    events = pulling_away(math.radians(144.0), 14.0, 8.0)
    one, other = (fuse(config(filter=GIVEN), events, compiled).history.head for compiled in (True, False))
    np.testing.assert_array_equal(one.whole, other.whole)
    np.testing.assert_array_equal(bits(one.numbers), bits(other.numbers))


@pytest.mark.parametrize("sigma_deg", [9.0, 15.0, 24.0, 40.0, 1e5])
def test_hypotheses_of_a_given_heading_make_up_its_distribution(sigma_deg: float) -> None:
    sigma = math.radians(sigma_deg)
    found = _all_round((1.0, sigma), 0.75).values()
    weights, turns = np.array([weight for _, weight in found]), np.array([yaw - 1.0 for (yaw, _), _ in found])
    own = np.array([one for (_, one), _ in found])
    assert weights.sum() == pytest.approx(0.75)
    assert set(own) == {min(sigma / 2, BANK_SIGMA)}
    if sigma_deg < 45:
        shares = weights / 0.75
        assert shares @ turns == pytest.approx(0.0, abs=1e-3)
        assert math.sqrt(shares @ (turns**2 + own**2)) == pytest.approx(sigma, rel=0.02)
    else:
        np.testing.assert_allclose(weights, 0.75 / 12, rtol=1e-4)


def test_a_stored_and_a_given_heading_are_weighed_by_bayes() -> None:
    stored = StoredHeading(0.5, 0.1, 0.8)
    assert _weight_of(stored, None) == 0.8
    assert _weight_of(stored, (2.0, 1e6)) == pytest.approx(0.8, abs=1e-6)
    spread = 0.1**2 + 0.5**2
    for off in (0.0, 0.7, math.pi):
        likelihood = sum(math.exp(-((off + 2 * math.pi * k) ** 2) / (2 * spread)) for k in (-1, 0, 1))
        likelihood *= math.sqrt(2 * math.pi / spread)  # over that of a heading from anywhere, 1 / (2 pi)
        assert _weight_of(stored, (0.5 + off, 0.5)) == pytest.approx(0.8 * likelihood / (0.8 * likelihood + 0.2), rel=1e-9)


def test_the_arm_ties_position_and_velocity_to_the_attitude(compiled: bool) -> None:
    """The antenna is known as the fix is, however little is known of where the body is around it."""
    arm, turning = (1.5, 0.5, -1.0), drive(3.0, lambda t: 10.0 + 0 * t, lambda t: HEADING + 0.4 * t, rate=50.0)
    fusion = Fusion(config(gnss={"lever_arm_m": arm}), compiled)
    start(fusion, measurements(turning))
    head = fusion.history.head
    rotation, p = matrix(head.nominal[QUATERNION_EB]), head.covariance
    swing = np.cross(head.auxiliary[RATE_B] - head.nominal[GYRO_BIAS_B], arm)
    for block, offset, sigmas in ((POSITION, arm, (1.5, 1.5, 3.0)), (VELOCITY, swing, (0.2, 0.2, 0.2))):
        h = np.zeros((3, len(p)))
        h[:, block], h[:, ATTITUDE] = np.eye(3), -skew(rotation @ offset)
        assert np.sqrt(np.trace(h @ p @ h.T)) == pytest.approx(np.linalg.norm(sigmas), rel=1e-3)
        assert np.trace(p[block, block]) > np.sum(np.square(sigmas))
    assert np.linalg.eigvalsh(p).min() > -1e-12
    antenna_e = head.nominal[VELOCITY_E] + rotation @ swing
    np.testing.assert_allclose(antenna_e, turning.velocity_e[turning.at(1.06)], atol=0.5)  # as measured there, with no arm


def test_gyro_bias_of_a_standstill(compiled: bool) -> None:
    bias = (0.02, -0.01, 0.015)
    fusion = Fusion(config(filter=GIVEN), compiled)
    # GNSS comes 2 s after the IMU
    events = [
        event
        for event in measurements(straight(4.0, 0.0), gyro_bias=bias)
        if isinstance(event.payload, ImuSample | WheelSpeed) or event.t_ns > T0 + 2 * SECOND
    ]
    start(fusion, events)
    head = fusion.history.head
    np.testing.assert_allclose(head.nominal[GYRO_BIAS_B], bias, atol=5e-3)  # noise of 0.014 rad/s over half a second
    np.testing.assert_allclose(np.sqrt(np.diag(head.covariance)[GYRO_BIAS]), math.radians(0.05))
    for event in events:
        fusion.fuse(event)
    np.testing.assert_allclose(fusion.history.head.nominal[GYRO_BIAS_B], bias, atol=1.5e-3)


def test_waits_for_a_fix(compiled: bool) -> None:
    events = [event for event in measurements(straight(5.0, 12.0)) if not isinstance(event.payload, GnssPosition)]
    assert fuse(config(), events, compiled).history.head.stamps[PHASE] == ALIGNING
    assert fuse(config(filter=GIVEN), events, compiled).history.head.stamps[PHASE] == ALIGNING


def test_an_old_fix_does_not_start_it(compiled: bool) -> None:
    truth = straight(8.0, 12.0)
    events = [event for event in measurements(truth) if event.t_ns != T0 + 30 * MS]
    early = [e for e in events if not isinstance(e.payload, GnssVelocity) or e.t_ns > T0 + 5 * SECOND]
    early = [e for e in early if not isinstance(e.payload, GnssPosition) or e.t_ns < T0 + 3 * SECOND]
    assert fuse(config(), early, compiled).history.head.stamps[PHASE] == ALIGNING


def test_waits_for_the_imu(compiled: bool) -> None:
    events = [event for event in measurements(straight(4.0, 12.0)) if not isinstance(event.payload, ImuSample)]
    fusion = fuse(config(), events, compiled)
    assert fusion.history.head.stamps[PHASE] == ALIGNING
    assert fusion.totals()["WAITING"] > 0


def later(events: list[Measurement], shift_ns: int) -> list[Measurement]:
    return [
        Measurement(e.t_ns + shift_ns, e.source, e.sequence + 10**6, e.t_receive_ns + shift_ns, e.payload) for e in events
    ]


@pytest.mark.parametrize(("gap_s", "resets"), [(7200.0, 1), (31.0, 1), (20.0, 1), (0.3, 0)])
def test_starts_again_after_a_gap(compiled: bool, gap_s: float, resets: int) -> None:
    """It went on another way while nothing was heard; when its heading is lost, and after the restart gap, it aligns anew,
    and says that it jumped."""
    first, second = straight(4.0, 12.0), drive(4.0, lambda t: 12.0 + 0 * t, lambda t: 2.0 + 0 * t, rate=50.0)
    events = measurements(first) + later(measurements(second), round((4.0 + gap_s) * SECOND))
    fusion = fuse(config(), events, compiled)
    head = fusion.history.head
    assert head.stamps[RESETS] >= resets
    assert bool(head.stamps[T_START] > T0 + 4 * SECOND) is bool(resets)
    if resets:
        reason = ResetReason.DATA_GAP if gap_s > 30.0 else ResetReason.HEADING_LOST
        assert (head.stamps[RESETS], head.stamps[RESET_REASON]) == (1, reason)
        np.testing.assert_allclose(head.nominal[POSITION_E], second.position_e[-1], atol=2.0)
        np.testing.assert_allclose(head.nominal[VELOCITY_E], second.velocity_e[-1], atol=0.3)
        assert attitude(fusion)[2] == pytest.approx(math.degrees(2.0), abs=1.5)
    assert sum(fusion.totals()[name] for name in ("FUSED", "REJECTED", "GATHERED")) == len(events)


IN_BEND = 6.0  # s, when the autopilot falls silent


def bend(speed: float = 14.0) -> Drive:
    """As tight as a car goes around a corner."""
    return drive(18.0, lambda t: speed + 0 * t, lambda t: HEADING + 0.2 * t, rate=50.0)


def without(silence_s: float, events: list[Measurement]) -> list[Measurement]:
    """While the autopilot reboots there is no IMU and no GNSS; the wheels go on."""
    silent = range(T0 + round(IN_BEND * SECOND), T0 + round((IN_BEND + silence_s) * SECOND))
    return [event for event in events if event.t_ns not in silent or isinstance(event.payload, WheelSpeed)]


@pytest.mark.parametrize(("silence_s", "resets"), [(0.4, 0), (1.0, 0), (3.0, 1), (8.0, 1)])
def test_an_autopilot_that_reboots_in_a_bend(compiled: bool, silence_s: float, resets: int) -> None:
    """It comes back with the vehicle turned by up to 90 deg. A heading that is lost is found anew; nothing is blamed."""
    truth = bend()
    fusion = fuse(config(), without(silence_s, measurements(truth)), compiled)
    head = fusion.history.head
    assert (head.stamps[PHASE], head.stamps[RESETS]) == (RUNNING, resets)
    assert head.stamps[RESET_REASON] == (ResetReason.HEADING_LOST if resets else ResetReason.NONE)
    np.testing.assert_allclose(head.nominal[POSITION_E], truth.position_e[-1], atol=2.0)
    np.testing.assert_allclose(head.nominal[VELOCITY_E], truth.velocity_e[-1], atol=0.3)
    off = attitude(fusion)[2] - math.degrees(HEADING + 0.2 * 18.0)
    assert abs((off + 180) % 360 - 180) < 2.5
    assert {belief.status for belief in fusion.health(int(head.stamps[T])).values()} <= {"nominal", "noisy"}


def test_a_reboot_on_the_spot_costs_nothing(compiled: bool) -> None:
    """What rests does not turn: a parked vehicle keeps its heading, however long the autopilot is away."""
    truth = drive(18.0, lambda t: 0 * t, lambda t: HEADING + 0 * t, rate=50.0)
    fusion = fuse(config(filter=GIVEN), without(10.0, measurements(truth)), compiled)
    head = fusion.history.head
    assert (head.stamps[PHASE], head.stamps[RESETS]) == (RUNNING, 0)
    assert attitude(fusion)[2] == pytest.approx(math.degrees(HEADING), abs=2.0)


def test_a_lost_heading_is_not_found_by_coasting(compiled: bool) -> None:
    """GNSS that is back before the IMU tells where the vehicle is, and how fast; not where it heads."""
    truth = bend()
    imu_less = [e for e in measurements(truth) if e.t_ns < T0 + 6 * SECOND or not isinstance(e.payload, ImuSample)]
    back = [event for event in without(4.0, imu_less) if event.t_ns < T0 + 12 * SECOND]
    fusion = fuse(config(), [event for event in back if event.t_ns < T0 + 10 * SECOND], compiled)
    before = yaw_variance(fusion.history.head)
    assert before > LOST_HEADING**2
    for event in back:
        if event.t_ns >= T0 + 10 * SECOND:
            fusion.fuse(event)
    head = fusion.history.head
    assert head.stamps[RESETS] == 0
    assert yaw_variance(head) >= before
    at = truth.at(11.9)
    assert np.linalg.norm(head.nominal[POSITION_E] - truth.position_e[at]) < 5.0
    assert np.linalg.norm(head.nominal[VELOCITY_E] - truth.velocity_e[at]) < 1.0


@needs_compiled
def test_kernels_agree_over_a_reboot() -> None:
    """Coasting, a lost heading that GNSS is not to tell, the start anew."""
    events = without(3.0, measurements(bend()))
    one, other = (fuse(config(), events, compiled).history.head for compiled in (True, False))
    np.testing.assert_array_equal(one.whole, other.whole)
    np.testing.assert_array_equal(bits(one.numbers), bits(other.numbers))


def test_a_silent_imu_in_a_tunnel(compiled: bool) -> None:
    """Without GNSS nothing finds the heading: as it is, far less certain, it is better than none."""
    events = [e for e in without(3.0, measurements(bend())) if e.t_ns < T0 + 3 * SECOND or not e.source.startswith("gps0")]
    head = fuse(config(), events, compiled).history.head
    assert (head.stamps[PHASE], head.stamps[RESETS]) == (RUNNING, 0)
    assert yaw_variance(head) > LOST_HEADING**2


def test_a_given_heading_is_that_of_the_start(compiled: bool) -> None:
    """Whoever has driven since does not head there any more."""
    truth = bend()
    fusion = fuse(config(filter=GIVEN), without(3.0, measurements(truth)), compiled)
    off = attitude(fusion)[2] - math.degrees(HEADING + 0.2 * 18.0)
    assert fusion.history.head.stamps[RESETS] == 1
    assert abs((off + 180) % 360 - 180) < 2.5


def test_calibration_survives_a_gap(compiled: bool) -> None:
    bias = (0.01, -0.01, 0.005)
    events = measurements(straight(6.0, 12.0), gyro_bias=bias)
    fusion = fuse(config(), events, compiled)
    learnt = fusion.history.head.nominal[GYRO_BIAS_B].copy()
    imu = next(event for event in events if isinstance(event.payload, ImuSample))
    fusion.fuse(later([imu], 7200 * SECOND)[0])
    head = fusion.history.head
    assert head.stamps[PHASE] == ALIGNING
    np.testing.assert_array_equal(head.nominal[GYRO_BIAS_B], learnt)
    assert fusion.solution_at(int(head.stamps[T])).state is None


@pytest.mark.parametrize("poison", [math.nan, math.inf])
@pytest.mark.parametrize("place", ["position", "quaternion", "gyro bias", "covariance"])
def test_a_state_that_is_not_finite_is_emptied(compiled: bool, place: str, poison: float) -> None:
    """Never expected; where it happens the filter aligns anew, counts it, and publishes nothing that is not finite."""
    events = measurements(straight(8.0, 12.0), ())  # without wheels, no event rewinds to a state before the poison
    fusion = fuse(config(()), [event for event in events if event.t_ns < T0 + 4 * SECOND], compiled)
    head = fusion.history.head
    if place == "covariance":
        head.covariance[4, 4] = poison
    else:
        head.nominal[{"position": 1, "quaternion": 7, "gyro bias": 11}[place]] = poison
    rest = [event for event in events if event.t_ns >= T0 + 4 * SECOND]
    with np.errstate(invalid="ignore"):
        for event in rest:
            outcome = fusion.fuse(event).outcome
            assert outcome in (Outcome.FUSED, Outcome.REJECTED, Outcome.WAITING, Outcome.GATHERED)
            if head.stamps[BLOWN]:
                estimate = fusion.solution_at(event.t_ns).state
                assert estimate is None or math.isfinite(sum(estimate.velocity_n) + estimate.covariance.sum())
    assert (head.stamps[BLOWN], head.stamps[RESETS], head.stamps[PHASE]) == (1, 1, RUNNING)
    assert head.stamps[RESET_REASON] == ResetReason.NOT_FINITE
    assert np.isfinite(head.numbers).all()
    roll, pitch, yaw = euler(matrix_from_euler(*np.radians(attitude(fusion))))
    assert (roll, pitch, yaw) == (pytest.approx(0.0, abs=0.03), pytest.approx(0.0, abs=0.03), pytest.approx(0.4, abs=0.04))
