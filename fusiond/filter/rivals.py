"""Rival hypotheses: whole states that explain a contradiction in other ways, weighed by all that comes in (THEORY D4).

When sources contradict the state, one of four things is so, and each has a place in the bank: the inertial sensor lied
(INERTIAL), a receiver lies (RECEIVER), the state is wrong and the receiver right (RETURN), all wheels slip alike (WHEELS).
Each is a whole state and covariance, carried and updated like the main one: without its liar, or with the uncertainty that
the lie left behind. Its weight is its odds against the main state, by Bayes' rule from every reading that both judge.

A rival begins when a change of the source (Shiryaev's statistic; the health of D1) has become likely enough, and ends when
it has become unlikely, or when the expected loss says so (D5): then it becomes the main state. Until then the mixture's
moments are published (B6), so that the covariance holds all that may be so.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.events import FIX_FIXED
from fusiond.filter.measurement_update import cholesky, difference, inject, project, whiten
from fusiond.filter.observations import GNSS_POSITION, GNSS_VELOCITY, WHEEL_SPEED
from fusiond.filter.observations.model import COMPANION, Observation
from fusiond.filter.parameters import Parameters
from fusiond.filter.source_health import (
    MAX_SQUARE,
    OUTAGE_NS,
    OUTLIER_VARIANCE,
    OUTLIERS,
    begin,
    distrust,
    is_trusted,
    odds_of_bias,
)
from fusiond.filter.state import (
    ACCEL_BIAS,
    ALIVE,
    ATTITUDE,
    COASTING,
    EXCLUDED,
    FIX_TYPE,
    GYRO_BIAS,
    INERTIAL_DOUBT,
    INERTIAL_ODDS,
    LAST_RATIO,
    LED_OFF,
    LED_OFF_ODDS,
    MAIN_WEIGHT,
    POSITION,
    POSITION_E,
    RESET_SOURCE,
    STATE_DOUBT,
    SUSPECT,
    T_LAST,
    T_POSITION,
    VELOCITY,
    FilterState,
    ResetReason,
    T,
    count_reset,
    is_sound,
)
from fusiond.maths.linear import mirror
from fusiond.maths.portable import exp, square
from fusiond.maths.typed import ErrorRows3, Matrix3, Vector, Vector3, compiled
from fusiond.units import SECOND

RIVALS = 4
MEAN, MEDIAN = 0, 1  # places in the configuration's Estimate; the third is the likeliest hypothesis
HALF = 0.5
LEAST_SIGMA = 1e-12
HALVINGS = 40  # of the distance between hypotheses, to find a median
INERTIAL, RECEIVER, RETURN, WHEELS = range(RIVALS)  # places in the bank while the filter runs
LEAST_ODDS = 1e-6  # of the inertial sensor having lied, while nothing speaks for it
BEGIN = 0.01  # odds with which a rival begins
END = 1e-7  # and below which it is given up
LEAD = 100.0  # odds against all others with which a rival leads, where no loss says otherwise
LEAD_BY_LOSS = 10.0  # the same of one that does without a receiver, or goes where that is, at equal losses
SHARE_OF_LIAR = 0.1  # chance that a liar reads what would be read if it did not lie
MAX_ODDS = 1e12  # that one reading gives
MIN_WEIGHT = 1e-100
MAX_CONSISTENCY = 20.0  # largest exponent of the odds that a fix gives
LIE_TURN = 0.03  # rad, by which an inertial sensor that lied may have turned the attitude, per axis
LIE_RATE = 0.03  # rad/s, by which its gyro bias may be another now
LIE_SPEED = 0.05  # m/s, by which the velocity may be off
LIE_FORCE = 0.3  # m/s^2, by which its accelerometer bias may be another now
WHEEL_FRESH_NS = SECOND // 2  # a wheel silent for longer says nothing
FRESH = 0.05  # doubt above which a lie of the inertial sensor is fresh
FIRST = 0.1  # of these variances, that a lie has for certain
LARGER = 0.3  # chance that a lie is larger than that
GOES_ON = 10.0  # of these variances, that a large one has from then on
LARGEST = 100.0  # and at most by this factor, in variance
WRONG_TIME = 200.0  # s of dead reckoning after which it is likelier than not that it has gone wrong unnoticed
MAX_WRONG = 0.9
WRONG_AFTER_LIE = 0.5  # probability that the position is wrong after the inertial sensor lied


@compiled
def likelihood(innovation: Vector3, variance: Vector3, factor: float, m: int, spread: Matrix3) -> float:
    """Density of an innovation (m,) with covariance `spread` + factor * diag(variance), up to (2 pi)^(-m/2), where a share
    of all readings are outliers; 0 where that is not positive definite."""
    lower, widened, whitened = np.empty((3, 3)), np.empty(3), np.empty(3)
    for a in range(m):
        widened[a] = factor * variance[a]
    if not cholesky(spread, widened, 1.0, m, lower) or not whiten(spread, innovation, widened, m, whitened):
        return 0.0
    distance, size = 0.0, 1.0
    for a in range(m):
        distance += whitened[a] * whitened[a]
        size *= lower[a, a]
    outlier = exp(-min(distance, MAX_SQUARE) / (2 * OUTLIER_VARIANCE))
    for _a in range(m):
        outlier /= math.sqrt(OUTLIER_VARIANCE)
    return ((1 - OUTLIERS) * exp(-distance / 2) + OUTLIERS * outlier) / size


@compiled
def unread(variance: Vector3, factor: float, m: int, spread: Matrix3) -> float:
    """What stands for the likelihood in a hypothesis that does not use a source: the one that a reading has on average
    where it is used. So it says nothing for or against."""
    lower, widened = np.empty((3, 3)), np.empty(3)
    expected, size = 0.0, 1.0
    for a in range(m):
        widened[a] = factor * variance[a]
        expected += (spread[a, a] + variance[a]) / (spread[a, a] + widened[a])
    if not cholesky(spread, widened, 1.0, m, lower):
        return 0.0
    for a in range(m):
        size *= lower[a, a]
    return exp(-expected / 2) / size


@compiled
def lie_variance(k: int) -> float:
    """What a lie of the inertial sensor adds to the variance of the k-th error state."""
    if VELOCITY.start <= k < VELOCITY.stop:
        return LIE_SPEED * LIE_SPEED
    if ATTITUDE.start <= k < ATTITUDE.stop:
        return LIE_TURN * LIE_TURN
    if GYRO_BIAS.start <= k < GYRO_BIAS.stop:
        return LIE_RATE * LIE_RATE
    if ACCEL_BIAS.start <= k < ACCEL_BIAS.stop:
        return LIE_FORCE * LIE_FORCE
    return 0.0


@compiled
def watch_inertial(state: FilterState, seen: Observation, factor: float, spread: Matrix3, fits: float) -> None:
    """Weigh the hypothesis that the inertial sensor lied a moment ago by one observation, of likelihood `fits` under the
    main state: Shiryaev's odds of a change. When they are worth it, the rival begins."""
    a = state.auxiliary
    if state.bank[INERTIAL, 0] > 0 or not fits > 0:
        return
    widened = np.empty((3, 3))
    with_lie(seen, spread, FIRST, widened)
    lied = likelihood(seen.innovation, seen.variance, factor, seen.m, widened)
    a[INERTIAL_ODDS] = min(max(a[INERTIAL_ODDS], LEAST_ODDS) * (lied / fits), MAX_ODDS)
    if a[INERTIAL_ODDS] >= BEGIN:
        suspect_motion(state, BEGIN)


@compiled
def suspect_motion(state: FilterState, odds: float) -> None:
    """Begin the rivals in which the inertial sensor lied, and in which all wheels do, where they are not there yet."""
    state.auxiliary[INERTIAL_ODDS] = LEAST_ODDS
    if state.auxiliary[COASTING] != 0:
        return
    if state.bank[INERTIAL, 0] == 0:
        open_slot(state, INERTIAL, odds)
        rival = state.hypothesis(INERTIAL)
        rival.nominal[INERTIAL_DOUBT] = 1.0
        for k in range(VELOCITY.start, ACCEL_BIAS.stop):
            rival.covariance[k, k] += FIRST * lie_variance(k)
    if state.bank[WHEELS, 0] == 0:
        open_slot(state, WHEELS, odds)


@compiled
def with_lie(seen: Observation, spread: Matrix3, scale: float, widened: Matrix3) -> None:
    """Write `spread`, H P H' (m, m), with `scale` times the variance of a lie in P, into `widened`."""
    for i in range(seen.m):
        for j in range(seen.m):
            widened[i, j] = spread[i, j]
            for k in range(VELOCITY.start, ACCEL_BIAS.stop):
                widened[i, j] += scale * (seen.jacobian[i, k] * lie_variance(k) * seen.jacobian[j, k])


@compiled
def fit_lie(  # noqa: PLR0912 - loops
    rival: FilterState, seen: Observation, across: ErrorRows3, spread: Matrix3
) -> float:
    """Let the rival in which the inertial sensor lied take the lie that explains an observation best, delta = Lambda H'
    (S + H Lambda H')^-1 d, as an uncertainty of that size, if that makes it likelier and the lie is fresh. `across` and
    `spread`, H P and H P H', become those of P + delta delta'. Returns how likely that is beforehand, the less the larger
    it is: exp(-delta' Lambda^-1 delta / 2)."""
    m, widened, lower, lie, off = seen.m, np.empty((3, 3)), np.empty((3, 3)), np.zeros(rival.size), np.zeros(3)
    with_lie(seen, spread, LARGEST, widened)
    solved = np.empty(3)
    if not rival.nominal[INERTIAL_DOUBT] > FRESH or not cholesky(widened, seen.variance, 1.0, m, lower):
        return 1.0
    for a in range(m):
        solved[a] = seen.innovation[a]
        for b in range(a):
            solved[a] -= lower[a, b] * solved[b]
        solved[a] /= lower[a, a]
    for a in range(m - 1, -1, -1):
        for b in range(a + 1, m):
            solved[a] -= lower[b, a] * solved[b]
        solved[a] /= lower[a, a]
    for k in range(VELOCITY.start, ACCEL_BIAS.stop):
        for a in range(m):
            lie[k] += LARGEST * lie_variance(k) * seen.jacobian[a, k] * solved[a]
        for a in range(m):
            off[a] += seen.jacobian[a, k] * lie[k]
    size = 0.0
    for a in range(m):
        size += off[a] * solved[a]
        for b in range(m):
            widened[a, b] = spread[a, b] + off[a] * off[b]
    prior = LARGER * exp(-min(size, MAX_SQUARE) / 2)
    larger = prior * likelihood(seen.innovation, seen.variance, 1.0, m, widened)
    if not larger > likelihood(seen.innovation, seen.variance, 1.0, m, spread):
        return 1.0
    for k in range(VELOCITY.start, ACCEL_BIAS.stop):
        rival.covariance[k] += lie[k] * lie
    for k in range(GYRO_BIAS.start, ACCEL_BIAS.stop):  # it may go on, which shows as a bias
        rival.covariance[k, k] = max(rival.covariance[k, k], GOES_ON * lie_variance(k))
    mirror(rival.covariance)
    project(rival, seen, across, spread)
    return prior


@compiled
def speaks(state: FilterState, wheel: int) -> bool:
    """Whether a wheel, by its source, was heard lately and is trusted."""
    return state.stamps[T] - state.source_stamps[wheel, T_LAST] <= WHEEL_FRESH_NS and is_trusted(state.memory[wheel])


@compiled
def wheels_contradict(state: FilterState, params: Parameters) -> bool:
    """Whether most of the wheels that were heard lately contradict the main state: then it is not one of them that lies."""
    heard = against = 0
    for i in params.wheels:
        if speaks(state, i):
            heard += 1
            if state.memory[i, LAST_RATIO] > 1:
                against += 1
    return 2 * against > heard


@compiled
def may_lie(state: FilterState, receiver: int, params: Parameters) -> bool:
    """Whether a receiver, by its position source, may be called a liar. Not where its ambiguities are fixed, which fits only
    true carrier phases, and just an inertial sensor contradicts it; any trusted wheel that was heard lately is a witness."""
    if state.memory[receiver, FIX_TYPE] != FIX_FIXED:
        return True
    for i in params.wheels:  # noqa: SIM110 - a loop, for the kernel
        if speaks(state, i):
            return True
    return False


@compiled
def open_slot(state: FilterState, slot: int, odds: float) -> None:
    """Begin a rival as a copy of the main state, with odds against that; but not while the state coasts."""
    if state.auxiliary[COASTING] != 0:
        return
    if state.stamps[ALIVE] == 0:
        state.auxiliary[MAIN_WEIGHT] = 1.0
    if state.bank[slot, 0] == 0:
        state.stamps[ALIVE] += 1
    state.bank[slot, 0] = max(odds * state.auxiliary[MAIN_WEIGHT], MIN_WEIGHT)
    rival = state.hypothesis(slot)
    rival.nominal[:] = state.nominal
    for k in range(state.size):
        rival.covariance[k] = state.covariance[k]


@compiled
def close_slot(state: FilterState, slot: int) -> None:
    """Give a rival up."""
    if state.bank[slot, 0] > 0:
        state.stamps[ALIVE] -= 1
    state.bank[slot] = 0.0


@compiled
def close_all(state: FilterState) -> None:
    """Give all rivals up."""
    for slot in range(RIVALS):
        close_slot(state, slot)


@compiled
def uses(state: FilterState, slot: int, source: int, params: Parameters) -> bool:
    """Whether a rival uses a source."""
    if slot == WHEELS and params.models[source] == WHEEL_SPEED:
        return False
    suspect = int(state.stamps[SUSPECT])
    if suspect >= 0 and (source == suspect or source == int(params.model_parameters[suspect, COMPANION])):
        if slot == RECEIVER:
            return False
        if slot in (RETURN, INERTIAL):
            return True
    return state.memory[source, EXCLUDED] == 0


@compiled
def weigh(state: FilterState, slot: int, own: float, main: float) -> None:
    """Bayes' rule for one rival: its likelihood of a reading against the main state's."""
    if own > 0 and main > 0:
        state.bank[slot, 0] *= min(own / main, MAX_ODDS)


@compiled
def weigh_liar(state: FilterState, source: int, lie: float, params: Parameters) -> None:
    """Weigh the rival that calls a source a liar by a reading of that, which as a lie has `lie` times the main state's
    likelihood."""
    slot = WHEELS
    if params.models[source] != WHEEL_SPEED:
        slot, position = RECEIVER, position_of(source, params)
        if position < 0 or state.stamps[SUSPECT] != position:
            return
    state.bank[slot, 0] *= min(lie, MAX_ODDS)


@compiled
def suspect_receiver(state: FilterState, source: int, params: Parameters) -> bool:
    """Begin a rival that does without a receiver, where its health (D1) says that it may be biased; and those in which the
    state has become wrong, which alone begin where it may not lie. Returns whether it has begun."""
    odds = odds_of_bias(state.memory[source])
    suspect = position_of(source, params)
    if odds < BEGIN or state.bank[RECEIVER, 0] > 0 or state.memory[source, EXCLUDED] != 0 or suspect < 0:
        return False
    if not may_lie(state, suspect, params):
        suspect_motion(state, min(odds, MAX_ODDS))
        return False
    state.stamps[SUSPECT] = suspect
    state.auxiliary[LED_OFF] = 0.0
    state.auxiliary[LED_OFF_ODDS] = 1.0
    open_slot(state, RECEIVER, min(odds, MAX_ODDS))
    suspect_motion(state, min(odds, MAX_ODDS) / 10)
    return state.bank[RECEIVER, 0] > 0


@compiled
def lead_off(state: FilterState, source: int, innovation: Vector3, elapsed: float, params: Parameters) -> None:
    """Add to where a suspected receiver's velocity leads, by its innovation (2,) [m/s] over `elapsed` [s]."""
    if state.bank[RECEIVER, 0] > 0 and int(params.model_parameters[int(state.stamps[SUSPECT]), COMPANION]) == source:
        for i in range(2):
            state.auxiliary[LED_OFF.start + i] += innovation[i] * elapsed


@compiled
def weigh_consistency(state: FilterState, source: int, whitened: Vector3, spread: Matrix3, variance: Vector3) -> None:
    """Weigh the rival in which a receiver lies by a fix, whose whole error is `whitened` (2,) by S = `spread` (2, 2) +
    diag(`variance`): its position must go where its velocity leads. A fix that stays with the state meanwhile speaks for the
    receiver. Only the newest counts: the errors of fixes are alike."""
    if not state.bank[RECEIVER, 0] > 0 or state.stamps[SUSPECT] != source:
        return
    off, led = np.empty(3), np.empty(3)
    for i in range(2):
        off[i] = state.auxiliary[LED_OFF.start + i]
    if not whiten(spread, off, variance, 2, led):
        return
    gained = 0.0
    for i in range(2):
        gained += led[i] * (2 * whitened[i] - led[i]) / 2
    odds = exp(max(min(gained, 0.0), -MAX_CONSISTENCY))
    state.bank[RECEIVER, 0] *= odds / state.auxiliary[LED_OFF_ODDS]
    state.auxiliary[LED_OFF_ODDS] = odds


@compiled
def fits_again(state: FilterState, source: int, whitened: Vector3, m: int, params: Parameters) -> bool:
    """Whether the positions of a receiver that was found to lie are taken back: by its whitened innovation (m,), it reads
    what a good one does on average. It must not be said of a receiver whose velocity is heard and still lies: a lie begins
    small."""
    companion = int(params.model_parameters[source, COMPANION])
    silent = companion < 0 or state.stamps[T] - state.source_stamps[companion, T_LAST] > OUTAGE_NS
    if not silent and state.memory[companion, EXCLUDED] != 0:
        return False
    distance = 0.0
    for a in range(m):
        distance += whitened[a] * whitened[a]
    return distance <= 2 * m


@compiled
def position_of(source: int, params: Parameters) -> int:
    """The position source of the receiver that a GNSS source belongs to."""
    if params.models[source] == GNSS_POSITION:
        return source
    for i in range(len(params.models)):
        if params.models[i] == GNSS_POSITION and int(params.model_parameters[i, COMPANION]) == source:
            return i
    return -1


@compiled
def wrong(state: FilterState, carried: bool) -> float:
    """Probability that the state's position is wrong, for all that its covariance says: the longer no position was fused,
    the likelier."""
    if carried:
        return MAX_WRONG
    since = (state.stamps[T] - state.stamps[T_POSITION]) * 1e-9
    return min(state.auxiliary[STATE_DOUBT] + square(since / WRONG_TIME), MAX_WRONG)


@compiled
def decide(  # noqa: PLR0912 - loops
    state: FilterState, disputed: bool, params: Parameters
) -> None:
    """Give up rivals that have become unlikely, and let one lead where the expected loss is less so. While the wheels rest
    and the receiver moves (`disputed`), it is not called a liar: the vehicle may be carried. Nor is it while it may well be
    the state that is wrong."""
    if state.bank[RECEIVER, 0] > 0 and not may_lie(state, int(state.stamps[SUSPECT]), params):
        close_slot(state, RECEIVER)
    blamed = not disputed and LEAD_BY_LOSS * state.bank[RETURN, 0] <= state.bank[RECEIVER, 0]
    total = state.auxiliary[MAIN_WEIGHT]
    for slot in range(RIVALS):
        if state.bank[slot, 0] > 0:
            hypothesis = state.hypothesis(slot)
            if not is_sound(hypothesis):
                close_slot(state, slot)
            total += state.bank[slot, 0]
    state.auxiliary[MAIN_WEIGHT] = max(state.auxiliary[MAIN_WEIGHT] / total, MIN_WEIGHT)
    for slot in range(RIVALS):
        state.bank[slot, 0] = state.bank[slot, 0] / total
    inertial = state.hypothesis(INERTIAL)
    young = state.bank[INERTIAL, 0] > 0 and inertial.nominal[INERTIAL_DOUBT] > FRESH
    excluded = state.memory[int(state.stamps[SUSPECT]), EXCLUDED] != 0
    for slot in range(RIVALS):
        if 0 < state.bank[slot, 0] < (END if young or (excluded and slot == INERTIAL) else BEGIN / 10):
            close_slot(state, slot)
    for slot in range(RIVALS):
        odds = state.bank[slot, 0]
        if odds > 0:
            needed = LEAD
            against = 1 - odds
            if slot == RECEIVER:
                rival = state.hypothesis(RECEIVER)
                apart, blurred = 1e-9, 0.0
                for i in range(3):
                    apart += square(rival.nominal[POSITION_E.start + i] - state.nominal[POSITION_E.start + i])
                    blurred += rival.covariance[POSITION.start + i, POSITION.start + i]
                needed = LEAD_BY_LOSS * params.dead_reckoning_cost / params.spoof_cost * math.sqrt(blurred / apart)
            elif slot == RETURN:
                needed = LEAD_BY_LOSS * params.spoof_cost / params.dead_reckoning_cost
            if odds >= needed * against and (blamed or slot != RECEIVER):
                _lead(state, slot, params)
                return


@compiled
def _lead(state: FilterState, slot: int, params: Parameters) -> None:
    """Let a rival be the main state, and give up the others."""
    rival = state.hypothesis(slot)
    suspect = int(state.stamps[SUSPECT])
    state.nominal[:] = rival.nominal
    for k in range(state.size):
        state.covariance[k] = rival.covariance[k]
    state.auxiliary[MAIN_WEIGHT] = state.bank[slot, 0]
    for other in range(RIVALS):
        if not (slot == RECEIVER and other == INERTIAL):  # which may explain in time what the receiver says
            close_slot(state, other)
    if slot == INERTIAL:
        state.auxiliary[STATE_DOUBT] = WRONG_AFTER_LIE
        count_reset(state, ResetReason.INERTIAL_LIED)
        for source in range(state.sources):
            state.memory[source, EXCLUDED] = 0.0
            if source != params.imu_source:
                begin(state.memory[source])
    elif slot == WHEELS:
        for source in range(state.sources):
            if params.models[source] == WHEEL_SPEED:
                distrust(state.memory[source])
    elif slot == RECEIVER:
        exclude(state, suspect, 1.0, params)
    else:
        exclude(state, suspect, 0.0, params)
        count_reset(state, ResetReason.SOURCE_RETURNED)
        state.stamps[RESET_SOURCE] = suspect


@compiled
def exclude(state: FilterState, suspect: int, excluded: float, params: Parameters) -> None:
    """Exclude a receiver, or take it back; its health begins anew."""
    companion = int(params.model_parameters[suspect, COMPANION])
    _exclude(state.memory[suspect], excluded)
    if companion >= 0:
        _exclude(state.memory[companion], excluded)


@compiled
def _exclude(memory: Vector, excluded: float) -> None:
    memory[EXCLUDED] = excluded
    begin(memory)
    if excluded != 0:
        distrust(memory)


@compiled
def below(z: float) -> float:
    """Probability that a standard normal variable is below z, to 1e-7 (Abramowitz and Stegun 26.2.17)."""
    t = 1 / (1 + 0.2316419 * abs(z))
    series = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    beyond = 0.3989422804014327 * exp(-min(z * z, MAX_SQUARE) / 2) * series
    return beyond if z < 0 else 1 - beyond


@compiled
def median(weights: Vector, means: Vector, sigmas: Vector) -> float:
    """Of the mixture of all hypotheses (RIVALS + 1,) along one axis; the weights sum to 1."""
    low, high = math.inf, -math.inf
    for i in range(RIVALS + 1):
        if weights[i] > 0:
            low, high = min(low, means[i]), max(high, means[i])
    for _step in range(HALVINGS):
        middle, share = (low + high) / 2, 0.0
        for i in range(RIVALS + 1):
            if weights[i] > 0:
                share += weights[i] * below((middle - means[i]) / max(sigmas[i], LEAST_SIGMA))
        if share < HALF:
            low = middle
        else:
            high = middle
    return (low + high) / 2


@compiled
def mix(  # noqa: PLR0912 - loops
    state: FilterState, estimate: int
) -> None:
    """Make the state the mixture's: its `estimate`, that of least squared error (the mean), of least absolute error (the
    median of each error state), or the likeliest hypothesis (A7), with the covariance about it (B6)."""
    weights, errors = np.zeros(RIVALS + 1), np.zeros((RIVALS + 1, state.size))
    weights[RIVALS] = state.auxiliary[MAIN_WEIGHT]
    total, most = state.auxiliary[MAIN_WEIGHT], RIVALS
    for slot in range(RIVALS):
        total += state.bank[slot, 0]
    weights[RIVALS] /= total
    for slot in range(RIVALS):
        if state.bank[slot, 0] > 0:
            rival = state.hypothesis(slot)
            weights[slot] = state.bank[slot, 0] / total
            errors[slot] = difference(rival, state)
            if weights[slot] > weights[most]:
                most = slot
    chosen = np.zeros(state.size)
    if estimate == MEAN:
        for slot in range(RIVALS):
            chosen += weights[slot] * errors[slot]
    elif estimate == MEDIAN:
        means, sigmas = np.zeros(RIVALS + 1), np.zeros(RIVALS + 1)
        for k in range(state.size):
            sigmas[RIVALS] = math.sqrt(state.covariance[k, k])
            for slot in range(RIVALS):
                if weights[slot] > 0:
                    rival = state.hypothesis(slot)
                    means[slot], sigmas[slot] = errors[slot, k], math.sqrt(rival.covariance[k, k])
            chosen[k] = median(weights, means, sigmas)
    else:
        chosen[:] = errors[most]
    p = state.covariance
    for j in range(state.size):
        p[j] *= weights[RIVALS]
        p[j] += chosen[j] * weights[RIVALS] * chosen
    for slot in range(RIVALS):
        if weights[slot] > 0:
            rival = state.hypothesis(slot)
            for j in range(state.size):
                p[j] += weights[slot] * (rival.covariance[j] + (errors[slot, j] - chosen[j]) * (errors[slot] - chosen))
    mirror(p)
    inject(state, chosen)


def probability_of_lie(state: FilterState, source: int, params: Parameters) -> float | None:
    """That a source lies, as far as rivals have decided: of a receiver, and of the inertial sensor. None of another."""
    if source == params.imu_source:
        return float(state.nominal[INERTIAL_DOUBT])
    if params.models[source] in (GNSS_POSITION, GNSS_VELOCITY):
        named = state.stamps[ALIVE] > 0 and position_of(source, params) == state.stamps[SUSPECT]
        sure = bool(named and state.bank[RECEIVER, 0] >= LEAD / (1 + LEAD))  # though the main state, by its gate, is as good
        return float(state.memory[source, EXCLUDED] != 0 or sure)
    return None
