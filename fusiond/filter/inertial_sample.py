"""One inertial sample judged by those before it, and the health of each of the sensor's axes.

A sample is compared with the held one, the newest that was believed. The change is explained by the sensor's own scatter,
the mean square of such changes, or by what can happen to a vehicle from one sample to the next. A sample that neither
explains is rejected: the state goes on with the held one, and from there to the next sample that is believed, with the
noise of what the vehicle may have done unseen. Where that takes longer than `imu_gap`, it coasts.

Who is wrong is put to the vote: the held sample has the support of the time over which samples agreed with it, at most
`SUPPORT_TIME`, and a sample that contradicts it takes from that support the time since the sample before. Where nothing
of it is left, the held one is given up. So a bad sample changes nothing, nor do many; one that is believed by mistake, the
first after a silence, is soon given up.

A judgement depends on the samples before alone. So an event between the held sample and one that is not believed knows as
well that it must not interpolate towards it.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter.parameters import SENSOR_AXES, Parameters
from fusiond.filter.rows import Row
from fusiond.filter.source_health import blame_frozen, is_trusted, judge_repetition
from fusiond.filter.state import (
    CHANGE_FORCE,
    CHANGE_RATE,
    FROZEN_ODDS,
    FROZEN_PLACE,
    HELD_FORCE_B,
    HELD_RATE_B,
    INTERVAL,
    LAST_SENSED,
    NEVER,
    PEAK,
    QUANTUM,
    SHARE_CHANGED,
    SUPPORT,
    T_IMU,
    T_LAST,
    FilterState,
)
from fusiond.maths.portable import square
from fusiond.maths.typed import Vector, compiled

BLOW_RATE = 1.0  # rad/s: what a kerb or a pothole changes a vehicle's angular rate by at once
BLOW_FORCE = 40.0  # m/s^2: and its specific force
SWING = 20.0  # rad/s^2: and what tyres, brakes or propellers add to that in the time between two samples
JERK = 400.0  # m/s^3: the same of the specific force
OWN = 36.0  # a squared change of up to so many times the mean one is the sensor's own scatter
CLIPPED = 16.0  # a squared change counts in the mean for at most so many times that
SCATTER_TIME = 1.0  # s, over which the mean is taken
SUPPORT_TIME = 2.0  # s
MIN_SPAN = 1e-4  # s: two inertial samples are not taken as closer
UNIFORM = 1 / 12  # of the square of a range: variance of what may lie anywhere in it

AXES = 6  # accelerometer x, y, z, gyro x, y, z, as the sensor is mounted
STEPS = 4.0  # quanta that both other axes must have moved by, so that a repetition of the third says something
EXACT = 1e-9  # m/s^2, rad/s: a smaller change comes from turning the axes
FREEZES = 1e-6  # odds that an axis freezes at a sample
MOST_ODDS = 1e3  # odds are not kept beyond
OTHER_IF_FROZEN = 1e-3  # chance that a frozen axis changes
LEAST_SAME, MOST_SAME = 1 / 3, 0.95  # bounds to the chance, which is learnt, that a good axis repeats a reading
SHARE_LEARNT = 0.01  # weight of the newest sample in that


@compiled
def compare(state: FilterState, values: Vector, elapsed: float, params: Parameters) -> tuple[float, float, float, float]:
    """The squared change from the held sample, of specific force and angular rate, and the squared changes that are the
    sensor's own scatter from one sample to the next: as seen lately, or as configured over `elapsed` [s]."""
    a = state.auxiliary
    force = rate = 0.0
    for i in range(3):
        force += square(values[i] - a[HELD_FORCE_B.start + i])
        rate += square(values[3 + i] - a[HELD_RATE_B.start + i])
    white = 6.0 / max(elapsed, MIN_SPAN)  # two samples, three axes
    return force, rate, max(a[CHANGE_FORCE], white * params.noise.accel), max(a[CHANGE_RATE], white * params.noise.gyro)


@compiled
def ratios(
    force: float, rate: float, own_force: float, own_rate: float, since: float, blows: float
) -> tuple[float, float]:
    """Test ratios of the changes of force and rate, `since` [s] after the sample before: above 1 neither scatter nor physics
    explain them, with so many `blows`."""
    by_force = force / (OWN * own_force + square(blows * BLOW_FORCE + JERK * since))
    return by_force, rate / (OWN * own_rate + square(blows * BLOW_RATE + SWING * since))


@compiled
def since_last(state: FilterState, t_ns: int, params: Parameters) -> float:
    """Time [s] since the sample before, believed or not; infinite where there is nothing to judge by: no sample, or none
    within `imu_gap`."""
    last = state.source_stamps[params.imu_source, T_LAST]
    if state.stamps[T_IMU] == NEVER or last == NEVER or t_ns - last > params.imu_gap_ns:
        return math.inf
    return (t_ns - last) * 1e-9


@compiled
def is_believed(state: FilterState, values: Vector, t_ns: int, params: Parameters) -> bool:
    """Whether a sample, the next one after the newest behind the state, may be used."""
    if not is_trusted(state.memory[params.imu_source]):
        return False
    since = since_last(state, t_ns, params)
    if not state.auxiliary[SUPPORT] > since:
        return True
    elapsed = (t_ns - state.stamps[T_IMU]) * 1e-9
    force, rate, own_force, own_rate = compare(state, values, elapsed, params)
    by_force, by_rate = ratios(force, rate, own_force, own_rate, since, 1.0)
    return not (by_force > 1 or by_rate > 1)


@compiled
def judge(state: FilterState, row: Row, params: Parameters) -> bool:
    """Judge a sample of a sensor that is trusted: `is_believed`, and what that changes. One that contradicts the held sample
    gets ratio, innovation and variance of the accelerometer or the gyro, whichever is further off."""
    a, values, t_ns = state.auxiliary, row["values"], int(row["t_ns"])
    since = since_last(state, t_ns, params)
    if since == math.inf:
        a[SUPPORT] = 0.0
        return True
    elapsed = (t_ns - state.stamps[T_IMU]) * 1e-9
    force, rate, own_force, own_rate = compare(state, values, elapsed, params)
    by_force, by_rate = ratios(force, rate, own_force, own_rate, since, 1.0)
    if by_force > 1 or by_rate > 1:
        row["ratio"] = max(by_force, by_rate)
        for i in range(3):
            if by_force > by_rate:
                row["innovation"][i] = values[i] - a[HELD_FORCE_B.start + i]
                row["variance"][i] = own_force / 3
            else:
                row["innovation"][i] = values[3 + i] - a[HELD_RATE_B.start + i]
                row["variance"][i] = own_rate / 3
        if a[SUPPORT] > since:
            a[SUPPORT] -= since
            return False
        a[SUPPORT] = 0.0
    else:
        a[SUPPORT] = min(a[SUPPORT] + since, SUPPORT_TIME)
    share = since / (SCATTER_TIME + since)
    a[CHANGE_FORCE] += share * (min(force, CLIPPED * own_force) - a[CHANGE_FORCE])
    a[CHANGE_RATE] += share * (min(rate, CLIPPED * own_rate) - a[CHANGE_RATE])
    return True


@compiled
def doubt(
    state: FilterState, values: Vector, t_ns: int, until_ns: int, believed: bool, params: Parameters
) -> tuple[float, float]:
    """What interpolation may miss: noise densities of acceleration [(m/s^2)^2/Hz] and rate [(rad/s)^2/Hz] for a piece of the
    interval from the held sample, up to `t_ns`; the next sample is of `until_ns`. None between good samples, one after the
    other.

    Over a gap of length s the signal goes its own way: a random walk, whose steps are the mean change between samples. And a
    change may have come at any instant of the gap. That holds as well of a change that only a blow explains.
    """
    held = state.stamps[T_IMU]
    elapsed = (until_ns - held) * 1e-9
    force, rate, own_force, own_rate = compare(state, values, elapsed, params)
    by_force, by_rate = ratios(force, rate, own_force, own_rate, elapsed, 0.0)
    bridged = not believed or state.source_stamps[params.imu_source, T_LAST] > held
    if not (bridged or by_force > 1 or by_rate > 1):
        return 0.0, 0.0
    if not believed:
        elapsed, force, rate = (t_ns - held) * 1e-9, 0.0, 0.0
    steps = max(elapsed / max(state.memory[params.imu_source, INTERVAL], MIN_SPAN), 1.0)
    return (own_force * steps + UNIFORM * force) * elapsed, (own_rate * steps + UNIFORM * rate) * elapsed


@compiled
def judge_sensor(state: FilterState, values: Vector, t_ns: int, params: Parameters) -> None:
    """The health of the sensor as a source, by a sample: it is frozen if the sample repeats as a whole, or in one axis.

    A whole sample that repeats says something only where the readings of late changed by more than a few quanta: a sensor
    that is coarse for its noise, or whose readings an autopilot has filtered, repeats itself on a straight road."""
    memory, a = state.memory[params.imu_source], state.auxiliary
    same, fine = judge_axes(state, values, params), False
    for kind in range(2):
        change = a[CHANGE_FORCE] if kind == 0 else a[CHANGE_RATE]
        if change >= 3 * square(STEPS * a[QUANTUM.start + kind]):
            fine = True
    if fine or not same:
        judge_repetition(memory, state.source_stamps[params.imu_source], same, t_ns)
    if memory[FROZEN_PLACE] > 0:
        odds = 0.0
        for i in range(AXES):
            odds = max(odds, state.auxiliary[FROZEN_ODDS.start + i])
        blame_frozen(memory, odds / (1 + odds))


@compiled
def judge_axes(state: FilterState, values: Vector, params: Parameters) -> bool:
    """Bayes' rule for each axis of the sensor (THEORY D1): is it frozen? Its repetition to the bit is evidence where the two
    others of its kind moved by more than a few quanta, so that a quantised sensor at rest gives none. Returns whether the
    whole sample repeats the one before."""
    a, turn, memory = state.auxiliary, params.model_parameters[params.imu_source], state.memory[params.imu_source]
    same, worst, place = True, 1.0, 0.0
    moved = np.empty(3)
    for kind in range(2):
        first = 3 * kind
        for i in range(3):
            sensed = 0.0
            for j in range(3):
                sensed += turn[SENSOR_AXES.start + 3 * j + i] * values[first + j]
            moved[i] = abs(sensed - a[LAST_SENSED.start + first + i])
            a[LAST_SENSED.start + first + i] = sensed
            a[PEAK.start + kind] = max(a[PEAK.start + kind], abs(sensed))
            if moved[i] > EXACT:
                same = False
                if a[QUANTUM.start + kind] == 0 or moved[i] < a[QUANTUM.start + kind]:
                    a[QUANTUM.start + kind] = moved[i]
        least, lively = STEPS * a[QUANTUM.start + kind], 0
        for i in range(3):
            lively += 1 if moved[i] > least else 0
        for i in range(3):
            k = first + i
            changed = moved[i] > EXACT
            odds = max(a[FROZEN_ODDS.start + k], FREEZES)
            if changed:
                odds = max(odds * OTHER_IF_FROZEN, FREEZES)
            if lively - (1 if moved[i] > least else 0) == 2:
                if not changed:
                    chance = min(max(1 - a[SHARE_CHANGED.start + k], LEAST_SAME), MOST_SAME)
                    odds = min(odds / chance, MOST_ODDS)
                a[SHARE_CHANGED.start + k] += SHARE_LEARNT * ((1.0 if changed else 0.0) - a[SHARE_CHANGED.start + k])
            a[FROZEN_ODDS.start + k] = odds
            if odds > worst:
                worst = odds
                saturated = abs(a[LAST_SENSED.start + k]) >= a[PEAK.start + kind]
                place = 1.0 + k + (AXES if saturated else 0)
    memory[FROZEN_PLACE] = place
    return same
