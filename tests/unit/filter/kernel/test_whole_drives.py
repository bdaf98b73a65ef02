"""The compiled and the interpreted kernel give the same bits over drives that reach every branch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import (
    GnssPosition,
    GnssVelocity,
    GnssYaw,
    ImuSample,
    LateralAcceleration,
    Measurement,
    Parked,
    Payload,
    Pressure,
    SteeringAngle,
    WheelSpeed,
    YawRate,
)
from fusiond.filter.rivals import INERTIAL, RECEIVER, RIVALS
from fusiond.filter.rivals import WHEELS as WHEELS_SLIP
from fusiond.filter.state import (
    BLOWN,
    CHOOSING,
    DELAYS_ERROR,
    EXCLUDED,
    HEIGHT_OFFSET_ERROR,
    INERTIAL_DELAYS_ERROR,
    NEVER,
    PHASE,
    RUNNING,
    SLIP_ERROR,
    STEERING_OFFSET_ERROR,
    T_START,
    T_STILL,
    VELOCITY_E,
    WIDE_SIZE,
    YAW_RATE_OFFSET_ERROR,
    FilterState,
    ResetReason,
    Verdict,
)
from fusiond.filter.step import LOST_HEADING, yaw_variance
from fusiond.filter.stored_state import StoredState
from tests.conftest import needs_compiled
from tests.helpers.streams import (
    MS,
    PULLS_AWAY_S,
    SECOND,
    T0,
    WHEELS,
    Drive,
    config,
    drive,
    fuse,
    measurements,
    ramp,
    reset_by,
    same_bits,
    same_state,
    town,
)

pytestmark = needs_compiled
LEARNT = {"lever_arm_sigma_m": 0.3, "delay_sigma_ms": 100.0, "velocity_delay_sigma_ms": 50.0}
HEADED = {"heading_deg": math.degrees(0.7)}
Change = Callable[[Measurement, float], Payload | None]  # by the seconds since the begin; None: it is missing


def sensed(truth: Drive, change: Change = lambda event, _: event.payload, **options: Any) -> list[Measurement]:
    """What the sensors say of a drive at 25 Hz, wheels and GNSS at 5 Hz, in the order of the stamps."""
    held = []
    for event in measurements(truth, **{"wheel_hz": 5.0} | options):
        payload = change(event, (event.t_ns - T0) / SECOND)
        if payload is not None:
            held.append(msgspec.structs.replace(event, payload=payload))
    return held


def both_kernels(
    settings: Config,
    events: list[Measurement],
    stored: StoredState | None = None,
    poison: Callable[[FilterState, int], None] = lambda head, number: None,
) -> Fusion:
    """Both kernels over events in the order of arrival. Often, and at the end, all that they hold is asserted to be the same
    bits, and what is published ahead. `poison` may spoil a state before an event. Returns the filter that runs compiled."""
    first, second = Fusion(settings, True, stored), Fusion(settings, False, stored)
    for number, event in enumerate(events):
        for fusion in (first, second):
            poison(fusion.history.head, number)
            fusion.fuse(event)
        if number % 40 == 0 or number == len(events) - 1:
            same_bits(first, second)
            ahead = event.t_ns + number % 7 * 50 * MS
            estimates = first.solution_at(ahead), second.solution_at(ahead)
            same_state(first._predicted, second._predicted)
            assert estimates[0].mode is estimates[1].mode
            assert (estimates[0].state is None) == (estimates[1].state is None)
    assert first.history.rerun == second.history.rerun
    assert first.history.head.stamps[PHASE] == RUNNING
    return first


def departing(heading: float, seconds: float, speed: float = 6.0) -> Drive:
    """Stands, pulls away after 3 s and weaves a little."""
    return drive(
        seconds,
        lambda t: speed * ramp(t, PULLS_AWAY_S, 3.0),
        lambda t: heading + 0.2 * np.sin(0.5 * t) * ramp(t, PULLS_AWAY_S, 3.0),
        rate=25.0,
    )


@pytest.mark.parametrize("speed", [6.0, -3.0])
def test_a_heading_is_chosen(speed: float) -> None:
    """The bank stands, rolls, and bridges a hole in the IMU's data; duplicates and outliers come meanwhile."""

    def change(event: Measurement, t: float) -> Payload | None:
        if event.source == "imu0" and 3.3 < t < 3.7:
            return None
        return GnssVelocity(40.0, 0.0, 0.0) if event.source == "gps0.velocity" and event.sequence == 11 else event.payload

    events = sensed(departing(4.0, 6.5, speed), change)
    events += [msgspec.structs.replace(event, sequence=event.sequence + 10**6) for event in events[::9]]
    settings = config(filter={"heading_spread_deg": 4.0})
    events.sort(key=lambda event: event.key)
    for until_s, stands in ((2.9, True), (4.0, False)):
        early = fuse(settings, [event for event in events if event.t_ns < T0 + until_s * SECOND], True).history.head
        assert (early.stamps[PHASE], early.stamps[T_STILL] != NEVER) == (CHOOSING, stands)
    fusion = both_kernels(settings, events)
    assert fusion.history.head.stamps[T_START] < T0 + 2 * SECOND
    assert fusion.totals()["DUPLICATE"] > 20


def kept(heading: float) -> StoredState:
    """What a vehicle leaves that stood there, facing otherwise than it does now."""
    fusion = fuse(config(filter={"heading_deg": math.degrees(heading)}), sensed(departing(heading, 3.0)), True)
    stored = fusion.to_store()
    assert stored is not None
    return msgspec.structs.replace(stored, t_ns=T0 - SECOND)


def test_a_hot_start_that_the_drive_contradicts() -> None:
    fusion = both_kernels(config(), sensed(departing(2.0, 7.0)), kept(0.5))
    assert fusion.hot_start() is Verdict.USED
    assert reset_by(fusion)[:2] == (1, ResetReason.HEADING_DECIDED)


def test_all_that_can_be_learnt() -> None:
    """Lever arm, delays, a scale for each wheel, the barometer's offset; fixes weighed as a mixture; steered wheels with a
    sign; velocities of two axes and of three; a dual-antenna receiver; readings whose errors are correlated."""

    def change(event: Measurement, t: float) -> Payload | None:
        payload = event.payload
        if isinstance(payload, GnssPosition | GnssVelocity) and t < 2.0:
            return None
        if isinstance(payload, WheelSpeed):
            return WheelSpeed(-payload.speed)
        if isinstance(payload, GnssPosition) and t > 11.0:
            return msgspec.structs.replace(payload, latitude=payload.latitude + 1e-3)
        if isinstance(payload, GnssVelocity) and event.sequence % 3 == 0:
            return GnssVelocity(payload.north, payload.east, None, payload.sigma)
        if isinstance(payload, GnssPosition) and event.sequence % 10 == 7:
            return msgspec.structs.replace(payload, latitude=payload.latitude + 1e-5 * (event.sequence % 4))
        return payload

    events = sensed(departing(0.7, 12.0, -4.0), change)
    pressure = [
        Measurement(T0 + 7 * MS + k * 200 * MS, "baro", k, T0, Pressure(95_000.0 + 3.0 * math.sin(k), 290.0))
        for k in range(60)
    ]
    gnss = LEARNT | {"outliers": "mixture", "lever_arm_m": (0.5, 0.2, -1.0), "position_correlation_s": 0.5}
    yaws = [Measurement(T0 + 3 * MS + k * 200 * MS, "yaw0", k, T0, GnssYaw(0.7, 0.01)) for k in range(60)]
    settings = config(
        filter=HEADED | {"wheel_scale_by": "wheel"},
        dual_antenna={"yaw0": {"link": "link", "offset_deg": 2.0}},
        gnss=gnss | {"group": "roof", "shared_sigma_m": 0.5},
        wheel={"unsigned": False, "steered": True, "position_m": (1.2, 0.8, 0.3), "correlation_s": 0.2},
        barometer={"baro": {"link": "link", "sigma_m": 0.5}},
        imu={"delay_sigma_ms": 50.0},
    )
    fusion = both_kernels(settings, sorted(events + pressure + yaws, key=lambda event: event.key))
    sigma = np.sqrt(np.diag(fusion.history.head.covariance))
    assert fusion.params.size == WIDE_SIZE
    assert sigma[HEIGHT_OFFSET_ERROR][0] < 3.0  # of 100 m
    assert sigma[DELAYS_ERROR][0] < 0.1
    assert (sigma[INERTIAL_DELAYS_ERROR] < 0.05).all()
    assert sigma[SLIP_ERROR][0] < math.radians(0.5)
    assert fusion.outcomes()["front_left"]["FUSED"] > 40
    assert fusion.outcomes()["yaw0"]["FUSED"] > 10


def test_what_the_car_tells_of_itself() -> None:
    """Yaw rate, steering, lateral acceleration, and a gear lever at park until it pulls away; a hole of the inertial sensor
    in the bend; stamps by clocks that may be off; a wheel with a direction from elsewhere."""
    truth = drive(14.0, lambda t: 10.0 * ramp(t, 4.0, 3.0), lambda t: 0.7 + 0.15 * np.clip(t - 7.0, 0.0, None), rate=25.0)

    def change(event: Measurement, t: float) -> Payload | None:
        if isinstance(event.payload, WheelSpeed):
            return WheelSpeed(event.payload.speed, signed=t > 6)
        return None if event.source == "imu0" and 10.0 < t < 11.0 else event.payload

    off = {True: 0.0, False: 0.01}  # s, of the stamps, by whether they are the inertial sensor's
    events = [
        msgspec.structs.replace(event, stamp_sigma=off[event.source == "imu0"]) for event in sensed(truth, change)
    ]
    for k in range(140):
        t, t_ns = 0.1 * k, T0 + 3 * MS + k * 100 * MS
        speed, turn = 10.0 * float(ramp(np.array(t), 4.0, 3.0)), 0.15 * (t > 7.0)
        angle = 2.7 * turn / speed if speed > 1 else 0.0
        own = (YawRate(turn + 0.02), SteeringAngle(angle + 0.01), LateralAcceleration(speed * turn), Parked(t < 3.5))
        names = ("esc", "column", "across", "gear")
        events += [Measurement(t_ns, name, k, t_ns, payload) for name, payload in zip(names, own, strict=True)]
    signal: dict[str, Any] = {"bus": "bus", "signal": "m.s"}
    settings = config(
        filter=HEADED,
        yaw_rate={"esc": signal},
        steering={"column": signal | {"wheelbase_m": 2.7}},
        lateral_acceleration={"across": signal},
        parked={"gear": signal},
    )
    fusion = both_kernels(settings, sorted(events, key=lambda event: event.key))
    head = fusion.history.head
    for block, first, true in ((YAW_RATE_OFFSET_ERROR, math.radians(1.0), 0.02), (STEERING_OFFSET_ERROR, 0.0058, 0.01)):
        assert math.sqrt(head.covariance[block, block][0, 0]) < 0.7 * first
        assert head.nominal[block.start + 1] == pytest.approx(true, abs=0.005)
    outcomes = fusion.outcomes()
    assert all(outcomes[name]["FUSED"] > 90 for name in ("esc", "column", "across", "gear"))


def test_an_imu_that_falls_silent() -> None:
    """At rest and in motion; briefly, and, with GNSS, until the heading is lost; then the filter aligns anew."""
    truth = drive(14.0, lambda t: 10.0 * ramp(t, 4.0, 3.0), lambda t: 0.7 + 0.15 * np.clip(t - 5.0, 0.0, None), rate=25.0)
    holes = [(2.0, 3.0), (5.0, 5.3), (8.0, 10.0)]

    def change(event: Measurement, t: float) -> Payload | None:
        if event.source.startswith("gps0") and holes[2][0] < t < holes[2][1]:
            return None
        return None if event.source == "imu0" and any(begin < t < end for begin, end in holes) else event.payload

    events = sensed(truth, change)
    lost = fuse(config(filter=HEADED), [event for event in events if event.t_ns < T0 + 9.9 * SECOND], True)
    assert yaw_variance(lost.history.head) > LOST_HEADING**2
    assert reset_by(lost)[0] == 0  # the hole at rest cost nothing
    assert reset_by(both_kernels(config(filter=HEADED), events))[:2] == (1, ResetReason.HEADING_LOST)


def test_a_frozen_imu() -> None:
    """It repeats one sample for two seconds: the filter coasts, and takes it again when it lives."""
    held: dict[str, Payload] = {}

    def change(event: Measurement, t: float) -> Payload:
        if event.source == "imu0" and not 7.0 < t < 9.0:
            held["imu0"] = event.payload
        return held["imu0"] if event.source == "imu0" else event.payload

    events = sensed(town(12.0, rate=25.0), change)
    frozen = fuse(config(filter=HEADED), [event for event in events if event.t_ns < T0 + 9 * SECOND], True)
    assert frozen.health(T0 + 9 * SECOND)["imu0"].status == "frozen"
    fusion = both_kernels(config(filter=HEADED), events)
    assert fusion.health(T0 + 12 * SECOND)["imu0"].status == "nominal"


@pytest.mark.parametrize("before", ["imu0", "gps0.position"])
@pytest.mark.parametrize(("part", "place"), [("nominal", 4), ("nominal", 11), ("covariance", 0)])
def test_a_state_that_is_not_finite(part: str, place: int, before: str) -> None:
    """Velocity, gyro bias, a variance: spoilt before one event of a source, after the filter has run for long."""
    truth = drive(8.0, lambda t: 10.0 + 0 * t, lambda t: 0.7 + 0 * t, rate=25.0)
    events = sensed(truth, wheels=())
    when = next(i for i, event in enumerate(events) if event.source == before and event.t_ns > T0 + 3 * SECOND)

    def poison(head: FilterState, number: int) -> None:
        if number == when:
            getattr(head, part).flat[place] = math.nan

    with np.errstate(invalid="ignore"):
        fusion = both_kernels(config((), filter=HEADED), events, poison=poison)
    assert reset_by(fusion)[:2] == (1, ResetReason.NOT_FINITE)
    assert fusion.history.head.stamps[BLOWN] == 1


def seen_alive(events: list[Measurement], settings: Config) -> tuple[set[int], Fusion]:
    """Places in the bank that held a rival at any time; both kernels alike."""
    met: set[int] = set()

    def watch(head: FilterState, _: int) -> None:
        met.update(slot for slot in range(RIVALS) if head.stamps[PHASE] == RUNNING and head.bank[slot, 0] > 0)

    return met, both_kernels(settings, events, poison=watch)


def test_a_spoofed_receiver() -> None:
    """Positions pull away, velocities too from then on; at last all is right again."""

    def change(event: Measurement, t: float) -> Payload:
        payload = event.payload
        if isinstance(payload, GnssPosition) and 9.0 < t < 19.0:
            return msgspec.structs.replace(payload, latitude=payload.latitude + 3.0 * (t - 9.0) / 6.4e6)
        if isinstance(payload, GnssVelocity) and 14.0 < t < 19.0:
            return msgspec.structs.replace(payload, north=payload.north + 3.0)
        return payload

    met, fusion = seen_alive(sensed(town(24.0, rate=25.0), change), config(filter=HEADED))
    assert RECEIVER in met
    assert fusion.outcomes()["gps0.position"]["REJECTED"] > 10
    assert not fusion.history.head.memory[:, EXCLUDED].any()


def test_a_jump_of_the_fixes() -> None:
    def change(event: Measurement, t: float) -> Payload:
        payload = event.payload
        if isinstance(payload, GnssPosition) and t > 9.0:
            return msgspec.structs.replace(payload, latitude=payload.latitude + 100.0 / 6.4e6)
        return payload

    met, fusion = seen_alive(sensed(town(14.0, rate=25.0), change), config(filter=HEADED))
    assert RECEIVER in met
    assert fusion.outcomes()["gps0.position"]["REJECTED"] > 20


@pytest.mark.parametrize("wide", [False, True], ids=["", "wide"])
def test_an_inertial_sensor_that_lies(wide: bool) -> None:
    def change(event: Measurement, t: float) -> Payload:
        payload = event.payload
        if isinstance(payload, ImuSample) and 9.0 < t < 10.0:
            x, y, z = payload.angular_rate_b
            return msgspec.structs.replace(payload, angular_rate_b=(x + 0.2, y, z))
        return payload

    settings = config(filter=HEADED, gnss=LEARNT if wide else {})
    met, fusion = seen_alive(sensed(town(13.0, rate=25.0), change), settings)
    assert met >= {INERTIAL, WHEELS_SLIP}
    assert reset_by(fusion)[1] is ResetReason.INERTIAL_LIED


def test_a_barometer_that_jumps() -> None:
    """The height offset is put where its source says, after that was rejected for long."""
    events = sensed(town(20.0, rate=25.0), wheels=())
    for k in range(100):
        pressure = (95_000.0 if k < 40 else 94_000.0) + 3.0 * math.sin(k)
        events.append(Measurement(T0 + 7 * MS + k * 200 * MS, "baro", k, T0, Pressure(pressure, 290.0)))
    settings = config((), filter=HEADED, barometer={"baro": {"link": "link", "sigma_m": 0.5}})
    fusion = both_kernels(settings, sorted(events, key=lambda event: event.key))
    assert fusion.outcomes()["baro"]["FUSED"] > 45
    assert fusion.outcomes()["baro"]["REJECTED"] > 2


def test_faulty_sources() -> None:
    """One wheel slips, one repeats its reading, one is noisy; GNSS is away for longer than an outage, and comes back off."""
    noise = np.random.default_rng(8)

    def change(event: Measurement, t: float) -> Payload | None:
        payload = event.payload
        if isinstance(payload, GnssPosition | GnssVelocity) and 12.0 < t < 23.0:
            return None
        if isinstance(payload, GnssPosition) and t > 23.0:
            return msgspec.structs.replace(payload, latitude=payload.latitude + 3e-6)
        if isinstance(payload, WheelSpeed) and t > 8.0:
            wrong = {
                "rear_left": 1.3 * payload.speed,
                "front_right": 9.0,
                "front_left": abs(payload.speed + float(noise.normal(0.0, 0.35))),
            }
            return WheelSpeed(wrong.get(event.source, payload.speed))
        return payload

    fusion = both_kernels(config(filter=HEADED, wheel={"noise_most": 1.5}), sensed(town(28.0, rate=25.0), change))
    found = fusion.health(T0 + 28 * SECOND)
    assert {source: found[source].status for source in WHEELS} == {
        "rear_left": "biased",
        "front_right": "frozen",
        "front_left": "noisy",
        "rear_right": "nominal",
    }


@pytest.mark.parametrize("heading", [HEADED, {}], ids=["given", "chosen"])
def test_a_vehicle_that_is_carried(heading: dict[str, float]) -> None:
    """A ferry: wheels at rest while GNSS sees the vehicle move."""
    truth = drive(9.0, lambda t: 5.0 * ramp(t, 2.0, 4.0), lambda t: 0.7 + 0.1 * t, rate=25.0)
    settings = config(filter=heading)
    fusion = both_kernels(
        settings, sensed(truth, lambda event, _: WheelSpeed(0.0) if isinstance(event.payload, WheelSpeed) else event.payload)
    )
    assert fusion.outcomes()["rear_left"]["REJECTED"] > 3
    assert np.linalg.norm(fusion.history.head.nominal[VELOCITY_E]) > 4.0


def test_a_hole_in_all_data() -> None:
    truth = drive(3.0, lambda t: 12.0 + 0 * t, lambda t: 0.7 + 0 * t, rate=25.0)
    events, shift = sensed(truth), 40 * SECOND
    again = [
        msgspec.structs.replace(event, t_ns=event.t_ns + shift, t_receive_ns=event.t_receive_ns + shift) for event in events
    ]
    assert reset_by(both_kernels(config(), events + again))[:2] == (1, ResetReason.DATA_GAP)


@pytest.mark.parametrize("settings", [config(), config(filter={"heading_deg": 40.0})], ids=["course", "given"])
def test_events_out_of_order(settings: Config) -> None:
    """A start, outliers, duplicates, a hole in the IMU's data, and fixes that come late and rewind."""
    rng, held = np.random.default_rng(7), []
    for event in sensed(town(16.0, rate=25.0), wheel_hz=12.0):
        if event.source == "imu0" and 12 * SECOND < event.t_ns - T0 < 12.5 * SECOND:
            continue
        chance, payload = rng.random(), event.payload
        if chance < 0.05 and isinstance(payload, WheelSpeed):
            payload = WheelSpeed(payload.speed + 3.0)
        if chance < 0.1 and isinstance(payload, GnssPosition):
            payload = GnssPosition(payload.latitude + 1e-5, payload.longitude, payload.height)
        held.append(msgspec.structs.replace(event, payload=payload))
        if chance > 0.98:
            held.append(msgspec.structs.replace(event, sequence=event.sequence + 10**6))
    late = sorted(held, key=lambda event: (event.t_ns + 120 * MS * event.source.startswith("gps0"), event.key))
    fusion = both_kernels(settings, late)
    assert all(fusion.totals()[name] > 0 for name in ("FUSED", "REJECTED", "DUPLICATE"))
    assert fusion.history.rerun > 20
