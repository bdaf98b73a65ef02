"""What the filter believes of its sources: hypotheses weighed by their likelihoods, and noise that is learnt.

Decision fusion (THEORY D1). Each source is one of: nominal, noisy, biased (a wheel: slipping), frozen. The evidence is the
whitened innovation e = L^-1 d, L L' = S, which is N(0, 1) per axis while all is well, and whether the reading is the one
before it to the bit. Bayes' rule is applied at most every `JUDGE_NS`, or twice a source's correlation time: samples
closer than that tell the same again. A fifth hypothesis, absent (D2), needs no memory: it is weighed when it is asked for.

Nothing is certain after one sample: every hypothesis expects an outlier now and then, so an outlier is weak evidence.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.filter.state import (
    BELIEF,
    BIAS,
    BIAS_VARIANCE,
    BIASED,
    FROZEN,
    INTERVAL,
    LAST_INNOVATION,
    LAST_SUM,
    MEAN_NIS,
    NEVER,
    NOISE_EXCESS,
    NOISY,
    NOMINAL,
    T_JUDGED,
    T_LAST,
)
from fusiond.maths.portable import exp
from fusiond.maths.wgs84 import Array

JUDGE_NS = 50_000_000  # samples closer than this share their error
KEEPS = 20.0  # s: for so long a source stays what it is
PRIOR = (0.997, 0.001, 0.001, 0.001)  # nominal, noisy, biased, frozen: what it becomes then
OUTLIERS = 0.01  # share of readings that are off whatever the source is
OUTLIER_VARIANCE = 100.0  # of such a reading, per axis, in units of S
NOISY_VARIANCE = 16.0  # of a noisy source's innovation, likewise
FIRST_BIAS_VARIANCE = 100.0  # of a biased source's bias, likewise
BIAS_WALK = 0.01  # how fast a bias changes: variance added at each sample
FARTHEST = 1000.0  # a squared innovation beyond is no stranger than this: no likelihood vanishes
LEAST_BIAS = 3.0  # a smaller bias, in sigmas, is not called one
SAME_IF_NOMINAL = 1 / 3  # chance that a good sensor repeats a reading to the bit
SAME_IF_FAULTY = 1 / 20  # chance that a noisy or biased one does
OTHER_IF_FROZEN = 1e-3  # chance that a frozen one does not
TELLING = 4.0  # times the sensor's own variance: what more than that has told is the state, not the sensor
NOTED = 0.1  # a source that is noisy with at most this probability is taken as it is
NOTHING = np.zeros(0)
DISTRUST = 0.5  # a source that is biased or frozen with more than this probability is not fused
ABSENT = 1e-3  # chance that a source that was heard a moment ago has gone
DETECTION = 0.9  # chance that an expected reading comes
MOST_MISSES = 30
UNKNOWN_INTERVAL = 1.0  # s, where a source was never heard
CHANCE = 0.2  # learnt noise that differs by less than this share from the given is the same
NOISE_TIME = 30.0  # s, over which noise is learnt
CLIPPED = 25.0  # a squared innovation counts for at most so many times its variance: outliers are not noise
INTERVAL_SHARE = 0.05  # weight of the newest interval in the mean
NIS_TIME = 10.0  # s, over which the mean of the normalised innovation squared is taken


class Belief(NamedTuple):
    """What a source is held to be: probabilities of nominal, noisy, biased, frozen and absent; the likeliest; and why."""

    probabilities: tuple[float, float, float, float, float]
    status: str
    reason: str


STATUSES = ("nominal", "noisy", "biased", "frozen", "absent")


class Judgement(NamedTuple):
    """One look at a source: whitened innovation (m,), whether the reading repeats the one before, and when."""

    whitened: Array
    same: bool
    t_ns: int


def begin(memory: Array) -> None:
    """What is believed of a source of which nothing is known yet."""
    memory[BELIEF] = PRIOR
    memory[BIAS] = 0.0
    memory[BIAS_VARIANCE] = FIRST_BIAS_VARIANCE


def tells(predicted: Array, variance: Array) -> bool:
    """Whether an innovation tells of the sensor: H P H' and R, (m,) each, the one not far above the other. A state that is
    uncertain, after an outage, is off alike at every look."""
    total = own = 0.0
    for a in range(len(variance)):
        total += predicted[a]
        own += variance[a]
    return total <= TELLING * own


def judge_repetition(memory: Array, stamps: NDArray[np.int64], same: bool, t_ns: int) -> None:
    """The same for a source without innovations, the inertial sensor: only a frozen one shows."""
    if is_due(stamps, t_ns, 0.0):
        judge(memory, stamps, Judgement(NOTHING, same, t_ns))


def is_due(stamps: NDArray[np.int64], t_ns: int, correlation: float) -> bool:
    """Whether enough time has passed since the last look for a new one to tell something new."""
    return bool(stamps[T_JUDGED] == NEVER or t_ns - stamps[T_JUDGED] >= max(JUDGE_NS, int(2e9 * correlation)))


def judge(memory: Array, stamps: NDArray[np.int64], look: Judgement) -> None:
    """Bayes' rule for one source (D1), after the passage of time has blurred what was believed."""
    if memory[NOMINAL] + memory[NOISY] + memory[BIASED] + memory[FROZEN] == 0:
        begin(memory)
    elapsed = KEEPS if stamps[T_JUDGED] == NEVER else (look.t_ns - int(stamps[T_JUDGED])) * 1e-9
    stamps[T_JUDGED] = look.t_ns
    blurred = 1 - exp(-elapsed / KEEPS)
    total = 0.0
    _renew_bias(memory, look.whitened)
    for i, likelihood in enumerate(likelihoods(memory, look.whitened, look.same)):
        place = NOMINAL + i
        memory[place] = (memory[place] + blurred * (PRIOR[i] - memory[place])) * likelihood
        total += memory[place]
    for i in range(len(PRIOR)):
        memory[NOMINAL + i] = memory[NOMINAL + i] / total
    _follow_bias(memory, look.whitened)


def likelihoods(memory: Array, whitened: Array, same: bool) -> tuple[float, float, float, float]:
    """Of the four hypotheses, up to a common factor (2 pi)^(-m/2)."""
    m = len(whitened)
    square = off = 0.0
    stretch, variance = _stretch(memory, m), 1 + memory[BIAS_VARIANCE]
    for a in range(m):
        square += whitened[a] * whitened[a]
        rest = whitened[a] - memory[BIAS.start + a] * stretch
        off += rest * rest
    square = min(square, FARTHEST)
    outlier = _density(square, OUTLIER_VARIANCE, m)
    good = (1 - OUTLIERS) * _density(square, 1.0, m) + OUTLIERS * outlier
    noisy = (1 - OUTLIERS) * _density(square, NOISY_VARIANCE, m) + OUTLIERS * outlier
    biased = (1 - OUTLIERS) * _density(off, variance, m) + OUTLIERS * outlier
    if not same:
        return good, noisy, biased, outlier * OTHER_IF_FROZEN
    return good * SAME_IF_NOMINAL, noisy * SAME_IF_FAULTY, biased * SAME_IF_FAULTY, outlier


def _renew_bias(memory: Array, whitened: Array) -> None:
    """Forget the bias where a new one, of which nothing is known, explains the innovation better."""
    m = len(whitened)
    square = off = 0.0
    for a in range(m):
        square += whitened[a] * whitened[a]
        rest = whitened[a] - memory[BIAS.start + a]
        off += rest * rest
    if _density(square, 1 + FIRST_BIAS_VARIANCE, m) > _density(off, 1 + memory[BIAS_VARIANCE], m):
        memory[BIAS] = 0.0
        memory[BIAS_VARIANCE] = FIRST_BIAS_VARIANCE


def _density(square: float, variance: float, m: int) -> float:
    """exp(-square / 2 variance) / variance^(m/2)"""
    root = math.sqrt(variance)
    scale = 1.0
    for _ in range(m):
        scale *= root
    return exp(-square / (2 * variance)) / scale


def _stretch(memory: Array, m: int) -> float:
    """What takes a bias that is too small to be called one to the least that is; as it is while it is not known."""
    if memory[BIAS_VARIANCE] >= 1.0:
        return 1.0
    size = 0.0
    for a in range(m):
        size += memory[BIAS.start + a] * memory[BIAS.start + a]
    size = math.sqrt(size)
    return LEAST_BIAS / size if 1e-9 < size < LEAST_BIAS else 1.0


def _follow_bias(memory: Array, whitened: Array) -> None:
    """A scalar Kalman filter for each axis of the bias, all of one variance."""
    variance = memory[BIAS_VARIANCE] + BIAS_WALK
    gain = variance / (variance + 1)
    for a in range(len(whitened)):
        memory[BIAS.start + a] += gain * (whitened[a] - memory[BIAS.start + a])
    memory[BIAS_VARIANCE] = (1 - gain) * variance


def is_trusted(memory: Array) -> bool:
    """Whether a source is fused at all."""
    return bool(memory[BIASED] + memory[FROZEN] <= DISTRUST)


def noise_factor(memory: Array, least: float, most: float) -> float:
    """By what a source's configured variance is multiplied: as learnt, within bounds; a little more or less is chance."""
    excess = float(memory[NOISE_EXCESS])
    beyond = max(0.0, excess - CHANCE) + min(0.0, excess + CHANCE)
    return min(max(1 + beyond, least), most)


def noisy_factor(memory: Array) -> float:
    """And by what besides, by the probability that it is noisy: nothing while that is small."""
    return float(1 + (NOISY_VARIANCE - 1) * memory[NOISY]) if memory[NOISY] > NOTED else 1.0


def learn(memory: Array, seen: tuple[Array, Array], predicted: Array, elapsed: float) -> None:
    """Noise from innovations (THEORY C3): the mean of d^2 - H P H', as a multiple of the configured variance. `seen` is
    innovation and configured variance, `predicted` the diagonal of H P H', all (m,)."""
    innovation, variance = seen
    found = configured = 0.0
    nis = 0.0
    m = len(innovation)
    for a in range(m):
        square, spread = innovation[a] * innovation[a], predicted[a] + variance[a]
        nis += square / spread
        found += min(square, CLIPPED * spread) - predicted[a]
        configured += variance[a]
    memory[MEAN_NIS] += elapsed / (NIS_TIME + elapsed) * (nis / m - memory[MEAN_NIS])
    if configured > 0:
        memory[NOISE_EXCESS] += elapsed / (NOISE_TIME + elapsed) * (found / configured - 1 - memory[NOISE_EXCESS])


def arrive(memory: Array, stamps: NDArray[np.int64], values: Any, t_ns: int) -> tuple[bool, float]:
    """Note a reading: whether it repeats the one before to the bit, and the time since [s]."""
    total = float(values[0]) + float(values[1]) + float(values[2])
    same = stamps[T_LAST] != NEVER and total == memory[LAST_SUM]
    memory[LAST_SUM] = total
    elapsed = 0.0 if stamps[T_LAST] == NEVER else (t_ns - int(stamps[T_LAST])) * 1e-9
    if elapsed > 0:
        share = INTERVAL_SHARE if memory[INTERVAL] > 0 else 1.0
        memory[INTERVAL] += share * (min(elapsed, 10.0) - memory[INTERVAL])
    return bool(same), elapsed


def moved(memory: Array, innovation: Array, variance: Array, gate: float) -> bool:
    """Whether the error of a rejected reading differs by more than noise from that of the one before; notes it."""
    total = 0.0
    for a in range(len(innovation)):
        step = innovation[a] - memory[LAST_INNOVATION.start + a]
        total += step * step / (2 * variance[a])
        memory[LAST_INNOVATION.start + a] = innovation[a]
    return not total <= gate


def belief(memory: Array, stamps: NDArray[np.int64], t_ns: int, since_ns: int) -> Belief:
    """What is believed of a source at `t_ns`, of which the filter has run since `since_ns`.

    Absent (THEORY D2): with detection probability P_D, each expected reading that is missing has likelihood 1 - P_D.
    """
    kept = memory[BELIEF].tolist() if memory[BELIEF].any() else list(PRIOR)
    age = (t_ns - max(int(stamps[T_LAST]), since_ns)) * 1e-9
    expected = memory[INTERVAL] if memory[INTERVAL] > 0 else UNKNOWN_INTERVAL
    odds = ABSENT / (1 - ABSENT)
    for _ in range(min(int(age / expected), MOST_MISSES)):
        odds /= 1 - DETECTION
    absent = odds / (1 + odds)
    nominal, noisy, biased, frozen = (float(p) * (1 - absent) for p in kept)
    probabilities = (nominal, noisy, biased, frozen, absent)
    status = STATUSES[max(range(len(STATUSES)), key=probabilities.__getitem__)]
    return Belief(probabilities, status, _reason(memory, status, age))


def _reason(memory: Array, status: str, age: float) -> str:
    """What speaks for a status, for people."""
    match status:
        case "noisy":
            return f"its squared innovations are {memory[MEAN_NIS]:.1f} times what they should be"
        case "biased":
            off = max(memory[BIAS].tolist(), key=abs)
            return f"its readings are off to one side by {abs(off):.0f} sigma, and not fused"
        case "frozen":
            return "it repeats one reading while the vehicle's motion says otherwise, and is not fused"
        case "absent":
            return f"nothing of it for {age:.1f} s"
    return ""
