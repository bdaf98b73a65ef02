"""A start from a stored state: what of it is believed, what is not, and that a wrong one does no lasting harm."""

from __future__ import annotations

import math
from functools import cache

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.estimator.solution import Mode
from fusiond.events import Measurement
from fusiond.filter.hot_start import DOUBTED_WEIGHT, USED_WEIGHT, Verdict, aged
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    ALIGNING,
    CHOOSING,
    GYRO_BIAS,
    GYRO_BIAS_B,
    HOT_START,
    PHASE,
    RESET_REASON,
    RUNNING,
    STORED,
    WHEEL_SCALE,
    FilterState,
    ResetReason,
    T,
)
from fusiond.filter.stored_state import StoredState, StoredStateError, check, from_text, installation, to_text, with_frame
from fusiond.maths.wgs84 import ecef, geodetic, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import PULLS_AWAY_S, SECOND, T0, Drive, bits, config, drive, fuse, measurements, ramp

HOUR = 3600 * SECOND
YAW = 0.7
PLACE = (math.radians(48.1), math.radians(11.6), 520.0)


@cache
def stored() -> StoredState:
    """What a drive that ends at rest leaves."""
    truth = drive(
        24.0,
        lambda t: 8.0 * (ramp(t, 1.0, 4.0) - ramp(t, 14.0, 6.0)),
        lambda t: YAW + 0.4 * np.sin(0.5 * t) * ramp(t, 1.0, 4.0) * (1 - ramp(t, 13.0, 6.0)),
        rate=50.0,
    )
    given = config(filter={"heading_deg": math.degrees(YAW)})
    kept = fuse(given, measurements(truth, gyro_bias=(0.01, -0.02, 0.015)), True).to_store()
    assert kept is not None
    here_e = truth.position_e[-1]
    away = mat_ne(here_e) @ (ecef(kept.latitude, kept.longitude, kept.height) - here_e)
    assert math.hypot(away[0], away[1]) < 3.0
    return kept


def place() -> tuple[float, float, float]:
    return stored().latitude, stored().longitude, stored().height


def elsewhere(north: float) -> tuple[float, float, float]:
    here = ecef(*place())
    return geodetic(here + mat_ne(here).T @ (north, 0.0, 0.0))


def later(
    turned: float = 0.0,
    seconds: float = 3.0,
    start: tuple[float, float, float] | None = None,
    age_ns: int = HOUR,
    speed: float = 6.0,
) -> tuple[Drive, list[Measurement]]:
    """Stands where it stood, or elsewhere, turned or not; pulls away after 3 s, and weaves."""
    truth = drive(
        seconds,
        lambda t: speed * ramp(t, PULLS_AWAY_S, 4.0),
        lambda t: stored().yaw + turned + 0.2 * np.sin(0.5 * t) * ramp(t, PULLS_AWAY_S, 3.0),
        rate=50.0,
        start=start or place(),
    )
    events = measurements(truth, seed=3, gyro_bias=(0.01, -0.02, 0.015))
    return truth, shifted(events, stored().t_ns + age_ns - T0)


def shifted(events: list[Measurement], by_ns: int) -> list[Measurement]:
    """The same, so much later."""
    return [
        msgspec.structs.replace(event, t_ns=event.t_ns + by_ns, t_receive_ns=event.t_receive_ns + by_ns) for event in events
    ]


def hot(events: list[Measurement], kept: StoredState, compiled: bool | None = None) -> Fusion:
    fusion = Fusion(config(), compiled, kept)
    for event in events:
        fusion.fuse(event)
    return fusion


def off(fusion: Fusion, truth: Drive) -> tuple[float, float]:
    """Error of the yaw told at the newest instant, and its sigma [rad]."""
    head = fusion.history.head
    estimate = fusion.solution_at(int(head.stamps[T])).state
    assert estimate is not None
    forward_n = mat_ne(truth.position_e[-1]) @ truth.mat_eb[-1][:, 0]
    error = estimate.euler()[2] - math.atan2(forward_n[1], forward_n[0])
    return (error + math.pi) % (2 * math.pi) - math.pi, estimate.sigma_yaw()


def test_where_it_stood_it_has_a_state_at_once(compiled: bool) -> None:
    truth, events = later(seconds=1.3)
    fusion, told = Fusion(config(), compiled, stored()), []
    for event in events:
        fusion.fuse(event)
        if event.source == "gps0.velocity" and fusion.solution_at(event.t_ns).mode is Mode.NOMINAL:
            told.append((event.t_ns - events[0].t_ns) / SECOND)
    assert told[0] < 1.3  # the first fix after the 0.8 s of leveling
    assert fusion.hot_start() is Verdict.USED
    error, sigma = off(fusion, truth)
    assert abs(error) < 3 * sigma < math.radians(15.0)
    estimate = fusion.solution_at(int(fusion.history.head.stamps[T])).state
    assert estimate is not None
    away = mat_ne(truth.position_e[-1]) @ (
        ecef(estimate.latitude, estimate.longitude, estimate.height) - truth.position_e[-1]
    )
    assert np.all(abs(away) < 3 * np.array(estimate.sigma_position_n()))
    assert fusion.history.head.stamps[PHASE] == CHOOSING  # the drive is to decide


def test_it_can_be_stored_again_before_it_has_driven() -> None:
    _, events = later()
    fusion = hot(events, stored())
    assert fusion.settled().mode is Mode.NOMINAL
    again = fusion.to_store()
    assert again is not None and again.at_rest
    assert again.yaw == pytest.approx(stored().yaw, abs=math.radians(1.0))
    assert hot(later(age_ns=2 * HOUR)[1], again).hot_start() is Verdict.USED


@needs_compiled
@pytest.mark.parametrize("turned_deg", [0, 10, 45, 90, 135, 180, 270])
@pytest.mark.parametrize("speed", [6.0, -3.0])
def test_turned_on_the_spot_it_is_found_out(turned_deg: int, speed: float) -> None:
    """Nothing shows it before it drives; then it must not be confidently wrong for long."""
    truth, events = later(math.radians(turned_deg), 13.0, speed=speed)
    fusion = hot(events, stored(), True)
    error, sigma = off(fusion, truth)
    assert abs(error) < math.radians(5.0)
    assert abs(error) < 3 * sigma
    assert fusion.history.head.stamps[PHASE] == RUNNING


@needs_compiled
def test_a_wrong_heading_is_withdrawn_soon() -> None:
    truth, events = later(math.radians(90.0), 8.0)
    fusion, wrong, resets = Fusion(config(), True, stored()), [], []
    for event in events:
        fusion.fuse(event)
        estimate = fusion.solution_at(event.t_ns).state
        second = (event.t_ns - events[0].t_ns) / SECOND
        if estimate is not None:
            forward_n = mat_ne(truth.position_e[0]) @ truth.mat_eb[min(truth.at(second), len(truth.seconds) - 1)][:, 0]
            error = abs((estimate.euler()[2] - math.atan2(forward_n[1], forward_n[0]) + math.pi) % (2 * math.pi) - math.pi)
            wrong.append((second, error > 3 * estimate.sigma_yaw()))
            resets.append(fusion.solution_at(event.t_ns).resets)
    assert max(second for second, is_wrong in wrong if is_wrong) < PULLS_AWAY_S + 1.5
    assert (resets[0], resets[-1]) == (0, 1)  # what is published jumps
    assert fusion.history.head.stamps[RESET_REASON] == ResetReason.HEADING_DECIDED
    assert resets == sorted(resets)


def test_elsewhere_the_heading_is_ignored(compiled: bool) -> None:
    _, events = later(math.radians(90.0), 1.2, elsewhere(200.0))
    fusion = hot(events, stored(), compiled)
    assert fusion.hot_start() is Verdict.MOVED
    head = fusion.history.head
    assert fusion.solution_at(int(head.stamps[T])).state is None
    assert head.stamps[PHASE] == CHOOSING and head.bank[STORED, 0] == 0
    assert head.hypothesis(0).nominal[WHEEL_SCALE] == pytest.approx(stored().calibrations[0], abs=1e-3)


@needs_compiled
def test_elsewhere_the_drive_tells() -> None:
    truth, events = later(math.radians(90.0), 13.0, elsewhere(200.0))
    error, sigma = off(hot(events, stored(), True), truth)
    assert abs(error) < min(math.radians(5.0), 3 * sigma)


def first_weight(events: list[Measurement], kept: StoredState) -> tuple[float, Verdict]:
    """Of the stored heading, when the bank begins."""
    fusion = Fusion(config(), None, kept)
    for event in events:
        fusion.fuse(event)
        if fusion.history.head.stamps[PHASE] == CHOOSING:
            break
    head = fusion.history.head
    return float(head.bank[STORED, 0]), Verdict(int(head.stamps[HOT_START]))


def test_what_agrees_in_part_is_one_hypothesis_of_many() -> None:
    kept = stored()
    assert first_weight(later()[1], kept) == (pytest.approx(USED_WEIGHT), Verdict.USED)
    tilted = msgspec.structs.replace(kept, roll=kept.roll + math.radians(3.0))
    assert first_weight(later()[1], tilted) == (pytest.approx(DOUBTED_WEIGHT), Verdict.DOUBTED)
    moving = msgspec.structs.replace(kept, at_rest=False)
    assert first_weight(later(age_ns=2 * SECOND)[1], moving) == (pytest.approx(DOUBTED_WEIGHT), Verdict.DOUBTED)
    assert first_weight(later()[1], moving) == (0.0, Verdict.IN_MOTION)
    vague = msgspec.structs.replace(kept, yaw_variance=1.0)
    assert first_weight(later()[1], vague) == (0.0, Verdict.VAGUE)
    assert hot(later()[1], tilted).solution_at(stored().t_ns + HOUR + 2 * SECOND).state is None  # not told before it is sure


def test_without_a_stored_state_there_is_no_verdict() -> None:
    fusion = fuse(config(), later()[1])
    assert fusion.history.head.stamps[HOT_START] == Verdict.NONE
    assert fusion.hot_start() is Verdict.NONE


def test_in_motion_now_it_is_one_hypothesis_of_many() -> None:
    truth = drive(4.0, lambda t: 4.0 + 0 * t, lambda t: stored().yaw + 0 * t, rate=50.0, start=place())
    events = shifted(measurements(truth), stored().t_ns + HOUR - T0)
    assert first_weight(events, stored()) == (pytest.approx(DOUBTED_WEIGHT), Verdict.DOUBTED)


def test_a_stored_heading_goes_before_a_given_one_that_contradicts_it() -> None:
    """It was stored later than the other was configured."""
    truth, events = later()
    for given_deg, verdict in ((100.0, Verdict.USED), (math.degrees(stored().yaw) + 1.0, Verdict.OTHERWISE_KNOWN)):
        fusion = Fusion(config(filter={"heading_deg": given_deg}), None, stored())
        for event in events:
            fusion.fuse(event)
        assert fusion.hot_start() is verdict
        error, sigma = off(fusion, truth)
        assert abs(error) < 3 * sigma
        solution = fusion.solution_at(int(fusion.history.head.stamps[T]))
        assert solution.mode is Mode.NOMINAL and not solution.heading_confirmed  # it has not driven
        running = fusion.history.head if verdict is Verdict.OTHERWISE_KNOWN else fusion.history.head.hypothesis(STORED)
        assert running.nominal[WHEEL_SCALE] == pytest.approx(stored().calibrations[0], abs=1e-3)


@needs_compiled
@pytest.mark.parametrize("speed", [3.0, 12.0])
@pytest.mark.parametrize("age_s", [2, 30])
def test_restarted_in_motion_a_wrong_given_heading_does_no_harm(speed: float, age_s: int) -> None:
    """Be what is stored seconds old, or too old to be of use: no heading is told that is far off."""
    moving = msgspec.structs.replace(stored(), at_rest=False)
    yaw = stored().yaw
    truth = drive(
        12.0, lambda t: speed + 0.8 * np.sin(t), lambda t: yaw + 0.3 * np.sin(0.5 * t), rate=50.0, start=place()
    )
    events = shifted(measurements(truth, seed=4), stored().t_ns + age_s * SECOND - T0)
    fusion = Fusion(config(filter={"heading_deg": math.degrees(yaw) - 144.0}), True, moving)
    seen = 0
    for event in events:
        fusion.fuse(event)
        solution = fusion.solution_at(event.t_ns)
        if event.source == "gps0.velocity" and solution.state is not None:
            at = min(truth.at((event.t_ns - events[0].t_ns) / SECOND), len(truth.seconds) - 1)
            forward_n = mat_ne(truth.position_e[at]) @ truth.mat_eb[at][:, 0]
            error = solution.state.euler()[2] - math.atan2(forward_n[1], forward_n[0])
            assert abs((error + math.pi) % (2 * math.pi) - math.pi) < math.radians(10.0)
            assert solution.heading_confirmed
            seen += 1
    assert seen > 20


@pytest.mark.parametrize(("age_ns", "verdict"), [(-HOUR, Verdict.FUTURE), (8 * 24 * HOUR, Verdict.STALE)])
def test_stale_or_from_the_future_it_is_a_cold_start(age_ns: int, verdict: Verdict) -> None:
    _, events = later(age_ns=age_ns)
    fusion, cold = hot(events, stored()), fuse(config(), events)
    assert fusion.hot_start() is verdict
    np.testing.assert_array_equal(fusion.history.head.bank, cold.history.head.bank)


def test_variances_grow_with_age_up_to_those_of_a_cold_start() -> None:
    kept, layout = stored(), make_parameters(config(), stored())
    state, before = FilterState(len(layout.sources)), None
    cold = [layout.imu.gyro_bias_sigma**2] * 3 + [layout.imu.accel_bias_sigma**2] * 3 + layout.calibration_variances.tolist()
    for age_ns in (0, SECOND, HOUR, 24 * HOUR, 365 * 24 * HOUR):
        state.stamps[T] = kept.t_ns + age_ns
        _, variances = aged(kept, state, layout)
        assert all(now >= then for now, then in zip(variances, before or variances, strict=True))
        assert all(now <= most for now, most in zip(variances, cold, strict=True))
        before = variances
    assert variances[:6] == cold[:6]


def test_a_frozen_calibration_stays_at_zero() -> None:
    layout = make_parameters(config(filter={"wheel_scale_sigma": 0.0}), stored())
    state = FilterState(len(layout.sources))
    state.stamps[T] = stored().t_ns
    values, variances = aged(stored(), state, layout)
    assert (values[6], variances[6]) == (0.0, 0.0)


def test_a_state_of_fewer_or_more_calibrations_is_of_use_for_those_that_there_are() -> None:
    """Between two runs `wheel_scale_sigma` became 0, or was given, where each wheel has a scale."""
    narrow, wide = config(), config(filter={"wheel_scale_by": "wheel"})
    layouts = [make_parameters(setup, None) for setup in (narrow, wide)]
    sizes = [len(layout.calibration_variances) for layout in layouts]
    assert len(stored().calibrations) == sizes[0] < sizes[1]
    state = FilterState(len(layouts[0].sources))
    state.stamps[T] = stored().t_ns
    values, variances = aged(stored(), state, layouts[1])
    assert values == [*stored().gyro_bias, *stored().accel_bias, *stored().calibrations, *[0.0] * (sizes[1] - sizes[0])]
    assert variances[6 + sizes[0] :] == layouts[1].calibration_variances[sizes[0] :].tolist()  # those of a cold start
    more = [0.0] * (sizes[1] - sizes[0])
    longer = msgspec.structs.replace(
        stored(),
        calibrations=[*stored().calibrations, *more],
        calibration_variances=[*stored().calibration_variances, *more],
    )
    assert aged(longer, state, layouts[0]) == aged(stored(), state, layouts[0])


def test_a_gyro_that_has_changed_contradicts_what_is_stored() -> None:
    changed = msgspec.structs.replace(stored(), gyro_bias=(0.2, 0.0, 0.0), gyro_bias_variance=(1e-8, 1e-8, 1e-8))
    hypothesis = hot(later(seconds=2.5)[1], changed).history.head.hypothesis(STORED)
    np.testing.assert_allclose(hypothesis.nominal[GYRO_BIAS_B], (0.01, -0.02, 0.015), atol=5e-3)
    good = msgspec.structs.replace(stored(), gyro_bias_variance=(1e-8, 1e-8, 1e-8))
    fresh = hot(later(seconds=1.0, age_ns=SECOND)[1], good).history.head.hypothesis(STORED)
    assert np.diag(fresh.covariance)[GYRO_BIAS].max() < 1e-7  # not widened to what a standstill tells


def test_a_later_start_is_not_hot() -> None:
    """After a hole in the data the filter knows more than what was stored, and than the heading that was given."""
    _, events = later(seconds=3.0)
    given = config(filter={"heading_deg": math.degrees(stored().yaw)})
    fusion = Fusion(given, None, stored())
    for event in events:
        fusion.fuse(event)
    assert fusion.history.head.stamps[PHASE] == RUNNING
    fusion.history.head.nominal[WHEEL_SCALE] = 0.05  # learnt since
    phases = []
    for event in shifted([event for event in events if event.t_ns < events[0].t_ns + 1.2 * SECOND], 60 * SECOND):
        fusion.fuse(event)
        phases.append(fusion.history.head.stamps[PHASE])
    head = fusion.history.head
    assert ALIGNING in phases and phases[-1] == CHOOSING
    assert head.bank[STORED, 0] == 0.0
    assert head.hypothesis(0).nominal[WHEEL_SCALE] == pytest.approx(0.05, abs=1e-3)


@needs_compiled
def test_order_of_arrival_does_not_matter() -> None:
    _, events = later(seconds=6.0)
    rng = np.random.default_rng(5)
    arrival = np.array([event.t_ns for event in events]) + rng.integers(0, 400_000_000, len(events))
    shuffled = [events[i] for i in np.argsort(arrival, kind="stable")]
    one, other = hot(events, stored(), True).history.head, hot(shuffled, stored(), True).history.head
    assert one.numbers.tobytes() == other.numbers.tobytes()
    assert one.whole.tobytes() == other.whole.tobytes()


@needs_compiled
def test_both_kernels_agree() -> None:
    _, events = later(seconds=1.5)
    one, other = (hot(events, stored(), compiled).history.head for compiled in (True, False))
    np.testing.assert_array_equal(bits(one.numbers), bits(other.numbers))
    np.testing.assert_array_equal(one.whole, other.whole)


# --- The text


def test_text_and_back() -> None:
    assert from_text(to_text(stored())) == stored()
    framed = with_frame(stored(), (48.1, 11.6, 520.25), 129)
    assert from_text(to_text(framed)) == framed
    with pytest.raises(StoredStateError, match="checksum"):
        from_text(to_text(framed).replace(b"129", b"128"))


def test_whatever_is_torn_or_altered_is_found() -> None:
    text = to_text(stored())
    for end in range(0, len(text) - 2, 7):
        with pytest.raises(StoredStateError, match="torn or altered"):
            from_text(text[:end])
    with pytest.raises(StoredStateError, match="checksum"):
        from_text(text.replace(b'"at_rest": true', b'"at_rest": false'))
    with pytest.raises(StoredStateError, match="torn or altered"):
        from_text(text.replace(b'"roll"', b'"rolled"'))
    with pytest.raises(StoredStateError, match="its version is 2, not 3"):
        from_text(text.replace(b'"version": 3', b'"version": 2'))


def test_it_is_for_one_vehicle_as_it_is_configured() -> None:
    check(stored(), config())
    with pytest.raises(StoredStateError, match="of the vehicle 'vehicle'"):
        check(stored(), config(vehicle={"name": "other"}))
    with pytest.raises(StoredStateError, match="configured otherwise"):
        Fusion(config(gnss={"lever_arm_m": (1.0, 0.0, 0.0)}), None, stored())
    with pytest.raises(StoredStateError, match="from the future, by 5 s"):
        check(stored(), config(), stored().t_ns - 5 * SECOND)
    with pytest.raises(StoredStateError, match=r"it is 169\.0 h old"):
        check(stored(), config(), stored().t_ns + 169 * HOUR)
    assert installation(config()) == installation(config(filter={"heading_deg": 3.0}))
