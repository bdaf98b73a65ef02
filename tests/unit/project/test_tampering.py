"""Attacks of the study: each changes what it says, from its beginning on, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.study.attacks import ATTACKS, attacked
from benchmarks.study.recorded import changed, installed, recorded
from benchmarks.study.tampering import (
    ACCEL,
    GYRO,
    Random,
    Tamper,
    adds,
    frozen,
    inertial,
    jump,
    later,
    meaconed,
    outage,
    position_only,
    reads,
    silent,
    together,
    wheels,
    with_velocity,
)
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Received, WheelSpeed
from fusiond.simulation.wgs84 import radii
from fusiond.units import SECOND
from tests.conftest import needs_compiled
from tests.helpers.simulated import CRUISE, scenario

DRIVE = recorded(scenario(CRUISE.format(20), clean=False, wheels="rate_hz = 20.0\nchatter = false\n"), 1)
BEGIN_NS = DRIVE.start_ns + 10 * SECOND


def of(kind: type, events: list[Received]) -> list[Received]:
    return [event for event in events if isinstance(event.payload, kind)]


def told(tamper: Tamper, seed: int = 1) -> list[Received]:
    random: Random = np.random.default_rng(seed)
    return tamper(DRIVE.events, BEGIN_NS, random)


def differing(events: list[Received]) -> list[tuple[Received, Received]]:
    assert len(events) == len(DRIVE.events)
    return [(old, new) for old, new in zip(DRIVE.events, events, strict=True) if old != new]


def north_east(old: GnssPosition, new: GnssPosition) -> tuple[float, float]:
    meridian, transverse = radii(np.array(old.latitude))
    north = (new.latitude - old.latitude) * (meridian + old.height)
    return float(north), float((new.longitude - old.longitude) * (transverse + old.height) * math.cos(old.latitude))


def test_one_inertial_sample() -> None:
    ((old, new),) = differing(told(inertial(GYRO, "xz", reads(5.0), samples=1)))
    assert isinstance(old.payload, ImuSample) and isinstance(new.payload, ImuSample)
    assert new.t_receive_ns >= BEGIN_NS and new.payload.specific_force_b == old.payload.specific_force_b
    x, y, z = new.payload.angular_rate_b
    assert (abs(x), y, abs(z)) == (5.0, old.payload.angular_rate_b[1], 5.0)


def test_an_axis_that_is_off_and_one_that_freezes_for_a_second() -> None:
    pairs = differing(told(inertial(ACCEL, "y", adds(2.0), 1.0)))
    offs = [new.payload.specific_force_b[1] - old.payload.specific_force_b[1] for old, new in pairs]  # type: ignore[union-attr]
    assert len(pairs) == 100 and np.abs(offs) == pytest.approx(2.0) and len(set(np.sign(offs))) == 1
    held = {new.payload.angular_rate_b[2] for _, new in differing(told(frozen(1.0, GYRO, "z")))}  # type: ignore[union-attr]
    assert len(held) == 1


@pytest.mark.parametrize(
    ("tamper", "offset", "speed"),
    [
        (position_only(0.5, 5.0), lambda t: 0.5 * t, 0.0),
        (with_velocity(0.5, 5.0, 3.0), lambda t: 3 + 0.5 * t, 0.5),
        (jump(100.0, 5.0), lambda _: 100.0, 0.0),
    ],
)
def test_spoofs(tamper: Tamper, offset: object, speed: float) -> None:
    pairs = differing(told(tamper))
    courses = set()
    for old, new in pairs:
        since = (new.t_receive_ns - BEGIN_NS) / SECOND
        assert 0 <= since < 5
        if isinstance(old.payload, GnssPosition) and isinstance(new.payload, GnssPosition):
            north, east = north_east(old.payload, new.payload)
            assert math.hypot(north, east) == pytest.approx(offset(since), abs=1e-3)  # type: ignore[operator]
            if math.hypot(north, east) > 0.5:
                courses.add(round(math.atan2(east, north), 1))
        elif isinstance(old.payload, GnssVelocity) and isinstance(new.payload, GnssVelocity):
            off = new.payload.north - old.payload.north, new.payload.east - old.payload.east
            assert math.hypot(*off) == pytest.approx(speed)
    assert len(courses) <= 2 and len(pairs) >= 24 * (2 if speed else 1)


def test_old_fixes_with_new_stamps() -> None:
    events = told(meaconed(0.1, 20.0))
    old, new = of(GnssPosition, DRIVE.events)[-1], of(GnssPosition, events)[-1]
    assert (new.t_sensor_ns, new.sequence) == (old.t_sensor_ns, old.sequence)
    assert isinstance(old.payload, GnssPosition) and isinstance(new.payload, GnssPosition)
    assert -north_east(old.payload, new.payload)[0] == pytest.approx(10.0, abs=4)  # a second old, at 10 m/s northward


def test_silence_wheels_and_combinations() -> None:
    events = told(together(outage(5.0), later(2.0, silent(ImuSample, 1.0))))
    assert len(of(GnssPosition, events)) == len(of(GnssPosition, DRIVE.events)) - 25
    assert len(of(ImuSample, events)) == len(of(ImuSample, DRIVE.events)) - 100
    pairs = differing(told(wheels(0.0, 1.0, ("rear_left",))))
    assert {new.source for _, new in pairs} == {"rear_left"} and len(pairs) == 20
    assert {new.payload.speed for _, new in pairs if isinstance(new.payload, WheelSpeed)} == {0.0}


def test_a_configuration_changed_and_without_the_receivers_noise() -> None:
    config = changed(DRIVE.config, "gnss", delay_ms=lambda old: old + 7.0, position_sigma_m=0.3)
    assert (config.gnss["gps0"].delay_ms, config.gnss["gps0"].position_sigma_m) == (7.0, 0.3)
    bare = installed(config).gnss["gps0"]
    assert bare.position_sigma_m == type(bare)(link="a").position_sigma_m and bare.delay_ms == 7.0
    assert bare.lever_arm_m == DRIVE.config.gnss["gps0"].lever_arm_m


@needs_compiled
def test_nothing_is_called_an_attack_where_nothing_happens() -> None:
    seen, found = attacked("nothing", 1, 0)
    assert found.during < 1.5 and found.dishonest == 0 and found.back < 1 and found.share > 0.98
    assert not found.others and not found.modes and "nothing" in ATTACKS
    assert 0.3 < seen.claimed()[seen.between(60, 120)].mean() < 2
