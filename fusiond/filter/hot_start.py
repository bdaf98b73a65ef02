"""What a stored state is worth at the start: checked against what was gathered, before any of it is used.

Biases and calibrations are first values, with variances aged by their random walks. The heading is another matter: a
vehicle can have been turned unnoticed, and a running filter does not recover from a wrong heading. So it is only ever
one hypothesis of the bank, next to the twelve all round, and the drive decides. Where place, standstill and
level agree it leads the bank, and as long as it does, its state is published: a parked vehicle has one at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fusiond.filter.observations.model import LEVER_ARM_B
from fusiond.filter.parameters import Parameters
from fusiond.filter.state import (
    CHOOSING,
    FIX_E,
    FIX_VARIANCE,
    HOT_START,
    NEVER,
    PHASE,
    RESETS,
    RUNNING,
    STORED,
    T_FIRST_VELOCITY,
    FilterState,
    T,
    Verdict,
)
from fusiond.filter.stored_state import StoredState
from fusiond.maths.portable import square
from fusiond.maths.rotation import matrix_from_euler, product
from fusiond.maths.typed import Array, compiled
from fusiond.maths.wgs84 import ecef, mat_ne

USED_WEIGHT = 0.8  # of the stored heading where all agrees: it takes evidence, not chance, to collapse the bank on it
LEADS = 0.5  # weight from which its state is published
DOUBTED_WEIGHT = 0.5  # and where only the place does
USED_SIGMA = math.radians(3.0)  # rad, at the least: parked is not nailed down
DOUBTED_SIGMA = math.radians(15.0)  # rad, at the least: some turning of the wheel
USELESS_SIGMA = math.radians(30.0)  # rad: a heading no better than this is none
LEVEL_AGREES = math.radians(1.5)  # rad: passengers and fuel tilt no vehicle more; on a slope turning does
SHARP = 10.0  # m: places known no better than this tell little
ROLLED = 20.0  # m, how far a vehicle that was parked may have gone before the filter starts
BRIEF = 5.0  # s: how long after a stop in motion its heading is worth something


WORDS = {
    Verdict.NONE: "no start yet",
    Verdict.USED: "heading, biases and calibration taken: same place, at rest, level as before",
    Verdict.DOUBTED: "biases and calibration taken; its heading is tried among others",
    Verdict.OTHERWISE_KNOWN: "biases and calibration taken; the heading is known otherwise",
    Verdict.MOVED: "biases and calibration taken; its heading and position ignored: the vehicle is elsewhere",
    Verdict.IN_MOTION: "biases and calibration taken; its heading ignored: it was in motion, too long ago",
    Verdict.VAGUE: "biases and calibration taken; its heading ignored: it was not known well",
    Verdict.FUTURE: "ignored: it is from the future",
    Verdict.STALE: "ignored: it is too old",
}


class Heading(NamedTuple):
    """A stored heading, its sigma [rad], and its weight in the bank."""

    yaw: float
    sigma: float
    weight: float


def recall(state: FilterState, params: Parameters) -> tuple[StoredState | None, Verdict]:
    """The stored state, if it is of use at the state's instant: at the first start only, and not beyond its age."""
    stored = params.stored
    if stored is None or state.stamps[RESETS]:
        return None, Verdict.NONE
    age_ns = int(state.stamps[T]) - stored.t_ns
    if age_ns < 0:
        return None, Verdict.FUTURE
    return (None, Verdict.STALE) if age_ns > params.max_stored_age_ns else (stored, Verdict.OTHERWISE_KNOWN)


def aged(stored: StoredState, state: FilterState, params: Parameters) -> tuple[list[float], list[float]]:
    """Values of gyro bias, accelerometer bias and calibrations, and their variances now: grown by the random walks, and
    never larger than those of a cold start. What is frozen stays at zero; what was not estimated then starts cold."""
    age, noise = (int(state.stamps[T]) - stored.t_ns) * 1e-9, params.noise
    values = [*stored.gyro_bias, *stored.accel_bias, *stored.calibrations]
    kept = [*stored.gyro_bias_variance, *stored.accel_bias_variance, *stored.calibration_variances]
    missing = [0.0] * (len(noise.calibrations) - len(stored.calibrations))
    values, kept = values + missing, kept + [math.inf] * len(missing)
    walks = [noise.gyro_bias] * 3 + [noise.accel_bias] * 3 + list(noise.calibrations)
    cold = [square(params.imu.gyro_bias_sigma)] * 3 + [square(params.imu.accel_bias_sigma)] * 3
    cold += params.calibration_variances.tolist()
    variances = [min(old + walk * age, most) for old, walk, most in zip(kept, walks, cold, strict=False)]
    return [value if most > 0 else 0.0 for value, most in zip(values, cold, strict=False)], variances


def heading(
    stored: StoredState, state: FilterState, source: int, level: tuple[float, float] | None, params: Parameters
) -> tuple[Heading | None, Verdict]:
    """What the stored heading is worth, where the last fix came by `source`; `level` is roll and pitch now [rad] of a
    vehicle at rest, None in motion."""
    sigma, age = math.sqrt(stored.yaw_variance), (int(state.stamps[T]) - stored.t_ns) * 1e-9
    if sigma > USELESS_SIGMA:
        return None, Verdict.VAGUE
    if not stored.at_rest and age > BRIEF:
        return None, Verdict.IN_MOTION
    reach = 0.0
    if not stored.at_rest:
        reach = params.filter.v_max_mps * age
    elif level is None:
        reach = ROLLED
    spread = stored.position_variance + float(state.auxiliary[FIX_VARIANCE][0])
    if max(0.0, _distance(stored, state.auxiliary[FIX_E], params.model_parameters[source][LEVER_ARM_B]) - reach) > math.sqrt(
        params.gates[2] * spread
    ):
        return None, Verdict.MOVED
    agrees = level is not None and max(abs(level[0] - stored.roll), abs(level[1] - stored.pitch)) <= LEVEL_AGREES
    if agrees and stored.at_rest and spread <= square(SHARP):
        return Heading(stored.yaw, max(sigma, USED_SIGMA), USED_WEIGHT), Verdict.USED
    return Heading(stored.yaw, max(sigma, DOUBTED_SIGMA), DOUBTED_WEIGHT), Verdict.DOUBTED


@compiled
def leads(state: FilterState, params: Parameters) -> bool:
    """Whether a bank is so sure of the stored heading that its state is published."""
    if state.stamps[PHASE] != CHOOSING or state.stamps[HOT_START] != Verdict.USED:
        return False
    return state.bank[STORED, 0] >= LEADS


@compiled
def has_state(state: FilterState, params: Parameters) -> bool:
    """Whether there is a state that is published: the filter runs, or the stored heading leads."""
    return state.stamps[PHASE] == RUNNING or leads(state, params)


def leading(state: FilterState) -> FilterState:
    """A copy that runs with the stored heading, for publication."""
    published, hypothesis = state.copy(), state.hypothesis(STORED)
    published.nominal[:], published.covariance[:] = hypothesis.nominal, hypothesis.covariance
    published.stamps[PHASE] = RUNNING
    published.stamps[T_FIRST_VELOCITY] = NEVER
    return published


def is_confirmed(state: FilterState) -> bool:
    """Whether the drive or two antennas have confirmed the heading of a running filter. Until then it is the given or the
    stored one."""
    return bool(state.stamps[T_FIRST_VELOCITY] != NEVER)


def _distance(stored: StoredState, fix_e: Array, lever_b: Array) -> float:
    """How far [m], horizontally, the antenna is from where it was."""
    place_e = ecef(stored.latitude, stored.longitude, stored.height)
    to_n = mat_ne(place_e)
    arm_n = product(matrix_from_euler(stored.roll, stored.pitch, stored.yaw), lever_b)
    north, east, _ = product(to_n, fix_e - place_e) - arm_n
    return math.sqrt(square(north) + square(east))
