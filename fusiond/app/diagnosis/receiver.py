"""What the receivers' own data say of them: velocity, delays, the yaw of two antennas, and the heading at the start."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.diagnosis.finding import Finding
from fusiond.app.diagnosis.fits import MIN_READINGS, SURE, Lag, lag_between
from fusiond.app.diagnosis.wheels import MOVING, Motion, motion_by_gnss
from fusiond.app.mounting.windows import BIN, means_of
from fusiond.maths.typed import Array

BASE_S = 4.0  # over which positions are differenced
FAR_M = 5.0  # that the vehicle must have moved in it: more than fixes scatter
NEAR_S = 1.0  # between a yaw and the course that it is compared with
ARM_M = 1.0  # what the distance from antenna to rear axle may be off: the course of an antenna before it leads
VELOCITY_SHARE = 0.15  # how far a velocity may be from what the positions say
VELOCITY_ANGLE = math.radians(10.0)
LEAST_LAG = 0.1  # s: a smaller one is a matter of tuning
TURNING = math.radians(3.0)  # rad/s: a bend
YAW_OFF = math.radians(10.0)  # slip, and the course of an antenna beside the axle, are less
MAX_YAW_SPREAD = math.radians(15.0)


def velocity_findings(evidence: Evidence) -> Iterator[Finding]:
    """What is wrong with the receivers' velocities."""
    for name, section in evidence.config.gnss.items():
        if section.use_velocity and not len(evidence.velocities[name]) and len(evidence.positions[name]) >= MIN_READINGS:
            yield Finding(
                kind="gnss_no_velocity",
                weight="note",
                text=f"{name} gives no velocity in any of its {len(evidence.positions[name])} fixes: the heading is found "
                "later; turn the velocity on at the receiver, or give filter.heading_deg",
                key=f"gnss.{name}.use_velocity",
                value="false",
            )
        yield from _velocity(evidence, name)


def receiver_findings(evidence: Evidence) -> Iterator[Finding]:
    """What is wrong with the receivers, by velocities that are right."""
    motion = motion_by_gnss(evidence)
    if motion is not None:
        yield from _delays(evidence, motion)
        yield from _yaws(evidence, motion)
        yield from _heading(evidence, motion)


def _velocity(evidence: Evidence, name: str) -> Iterator[Finding]:
    """A receiver's velocity against the change of its positions: a factor and an angle, as complex numbers."""
    if min(len(evidence.velocities[name]), len(evidence.positions[name])) < MIN_READINGS:
        return
    t, velocity = evidence.velocities[name].arrays()
    t_fix, place = evidence.positions[name].arrays()
    begin, end = (
        np.interp(t - BASE_S / 2, t_fix, np.arange(len(t_fix))),
        np.interp(t + BASE_S / 2, t_fix, np.arange(len(t_fix))),
    )
    first, last = np.floor(begin).astype(int), np.ceil(end).astype(int)
    apart = t_fix[last] - t_fix[first]
    usable = (apart > BASE_S / 2) & (apart < 3 * BASE_S)
    moved = (place[last] - place[first])[usable] / apart[usable, None]
    given = velocity[usable]
    fast = np.hypot(*moved.T) * apart[usable] > FAR_M
    if fast.sum() < MIN_READINGS:
        return
    by_place, by_velocity = moved[fast] @ (1, 1j), given[fast] @ (1, 1j)
    ratio = np.conj(by_place) * by_velocity / np.abs(by_place) ** 2
    factor = complex(np.median(ratio.real), np.median(ratio.imag))
    if abs(abs(factor) - 1) > VELOCITY_SHARE or abs(math.atan2(factor.imag, factor.real)) > VELOCITY_ANGLE:
        yield Finding(
            kind="gnss_velocity",
            text=f"{name}: its velocity is {abs(factor):.2f} times what its positions say, and "
            f"{math.degrees(math.atan2(factor.imag, factor.real)):.0f} deg beside it: are its unit and its course right?",
            key=f"gnss.{name}.use_velocity",
            value="false",
        )


def _delays(evidence: Evidence, motion: Motion) -> Iterator[Finding]:
    """Whose stamps are late: of receiver, wheels and gyro, each pair is compared, and the one is blamed that both others
    contradict."""
    config, bins = evidence.config, evidence.gathering
    by_wheels = by_gyro = None
    straight = [means_of(one) for one in bins.wheels.values() if len(one) >= MIN_READINGS]
    if straight:
        t_wheel = np.asarray((straight[0][0] + 0.5) * BIN, np.float64)
        speed = np.mean([np.interp(t_wheel, (keys + 0.5) * BIN, np.abs(means[:, 0])) for keys, means in straight], axis=0)
        by_wheels = lag_between(motion.t, motion.speed, t_wheel, speed)
    if len(bins.imu) >= MIN_READINGS:
        keys, means = means_of(bins.imu)
        t_imu = np.asarray((keys + 0.5) * BIN, np.float64)
        by_gyro = _beside_axle(lag_between(motion.t, motion.turn, t_imu, means[:, 5]), evidence, motion)
    receiver = config.gnss[motion.receiver]
    prior = max(math.hypot(receiver.delay_sigma_ms, receiver.velocity_delay_sigma_ms), receiver.stamp_sigma_ms) / 1e3
    late, early = _late(by_wheels, prior), _late(by_gyro, prior)
    if late and (early or by_gyro is None):
        yield _delay(motion.receiver, by_wheels, "the wheels", f"gnss.{motion.receiver}.delay_ms", receiver.delay_ms)
    elif early and by_wheels is None:
        yield _delay(motion.receiver, by_gyro, "the gyro", f"gnss.{motion.receiver}.delay_ms", receiver.delay_ms)
    elif late:
        (name, wheel), *_ = config.wheel.items()
        key, now = (
            (f"can.{wheel.bus}.delay_ms", config.can[wheel.bus].delay_ms)
            if wheel.bus
            else (f"wheel.{name}.delay_ms", wheel.delay_ms)
        )
        yield _delay("the wheels", _turned(by_wheels), "GNSS", key, now)
    elif early:
        ((name, imu),) = config.imu.items()
        yield _delay(name, _turned(by_gyro), "GNSS", f"imu.{name}.delay_ms", imu.delay_ms)


def _beside_axle(lag: Lag | None, evidence: Evidence, motion: Motion) -> Lag | None:
    """A lag of the course against the gyro without the lead that an antenna before the unsteered axle has in bends."""
    turning = np.abs(motion.turn) > TURNING
    if lag is None or not turning.any():
        return None
    speed = float(np.median(motion.speed[turning]))
    arm = evidence.config.gnss[motion.receiver].lever_arm_m[0] - evidence.config.motion.point_m[0]
    return Lag(lag.lag + arm / speed, math.hypot(lag.sigma, ARM_M / speed))


def _late(lag: Lag | None, prior: float) -> bool:
    return lag is not None and abs(lag.lag) > max(SURE * math.hypot(lag.sigma, prior), LEAST_LAG)


def _turned(lag: Lag | None) -> Lag | None:
    return None if lag is None else Lag(-lag.lag, lag.sigma)


def _delay(who: str, lag: Lag | None, other: str, key: str, now_ms: float) -> Finding:
    assert lag is not None
    which = "late" if lag.lag > 0 else "early"
    return Finding(
        kind="delay",
        text=f"{who}: {abs(lag.lag) * 1e3:.0f} +- {lag.sigma * 1e3:.0f} ms too {which} against {other}, as configured",
        key=key,
        value=f"{max(0.0, now_ms + lag.lag * 1e3):.0f}",
    )


def _yaws(evidence: Evidence, motion: Motion) -> Iterator[Finding]:
    """The yaw of two antennas against the course, in fast motion: their difference is the offset."""
    for name, section in evidence.config.dual_antenna.items():
        t, yaw = evidence.yaws[name].arrays()
        fast = motion.speed > 3 * MOVING
        if len(t) < MIN_READINGS or fast.sum() < MIN_READINGS:
            continue
        course = motion.course[fast]
        inside = (t > motion.t[fast][0]) & (t < motion.t[fast][-1])
        nearest = np.clip(np.searchsorted(motion.t[fast], t[inside]), 0, len(course) - 1)
        near = np.abs(motion.t[fast][nearest] - t[inside]) < NEAR_S
        off = yaw[inside][near, 0] - np.interp(t[inside][near], motion.t[fast], course)
        mean, spread = _circular(off)
        wrong = math.remainder(mean - math.radians(section.offset_deg), 2 * math.pi)
        if len(off) >= MIN_READINGS and spread < MAX_YAW_SPREAD and abs(wrong) > YAW_OFF:
            yield Finding(
                kind="yaw_offset",
                text=f"{name}: its yaw is {math.degrees(mean):.0f} deg clockwise from the course, and configured as "
                f"{section.offset_deg:g} deg",
                key=f"dual_antenna.{name}.offset_deg",
                value=f"{math.degrees(mean):.0f}",
            )


def _circular(angles: Array) -> tuple[float, float]:
    """Mean and standard deviation of angles [rad]."""
    if not len(angles):
        return 0.0, math.inf
    mean = complex(np.mean(np.exp(1j * angles)))
    return math.atan2(mean.imag, mean.real), math.sqrt(max(0.0, -2 * math.log(max(abs(mean), 1e-12))))


def _heading(evidence: Evidence, motion: Motion) -> Iterator[Finding]:
    """The given heading against the first sure course, taken back to the start by the gyro."""
    settings, bins = evidence.config.filter, evidence.gathering.imu
    fast = motion.speed > settings.course_speed_mps
    if settings.heading_deg is None or fast.sum() < MIN_READINGS or len(bins) < MIN_READINGS:
        return
    keys, means = means_of(bins)
    t = (keys + 0.5) * BIN
    first = motion.t[fast][: 5 * MIN_READINGS]
    turned = np.concatenate([[0.0], np.cumsum(means[1:, 5] * np.diff(t))])
    mean, spread = _circular(motion.course[fast][: len(first)] - np.interp(first, t, turned))
    sigma = math.hypot(math.radians(settings.heading_sigma_deg), spread)
    off = math.remainder(math.radians(settings.heading_deg) - mean, 2 * math.pi)
    if abs(off) > max(SURE * sigma, YAW_OFF):
        yield Finding(
            kind="heading",
            text=f"the heading at the start was {math.degrees(mean) % 360:.0f} deg, by the course and the gyro, and not "
            f"{settings.heading_deg:g} +- {settings.heading_sigma_deg:g} deg",
            key="filter.heading_deg",
            value=f"{math.degrees(mean) % 360:.0f}",
        )
