"""Health of the sources: hypotheses weighed by their likelihoods, and noise that is learnt.

Decision fusion (THEORY D1). Each source is one of: nominal, noisy, biased (a wheel: slipping), frozen. The evidence is the
whitened innovation e = L^-1 d, L L' = S, which is N(0, 1) per axis while all is well, and whether the reading is the one
before it to the bit. Bayes' rule is applied at most every `JUDGE_NS`, or twice a source's correlation time: samples
closer than that say the same again. A fifth hypothesis, absent (D2), needs no memory: it is weighed when it is asked for.

Nothing is certain after one sample: every hypothesis expects an outlier now and then, so an outlier is weak evidence.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusiond.filter.state import (
    ACTUAL_SPEED,
    BEFORE,
    BELIEF,
    BIAS,
    BIAS_VARIANCE,
    BIASED,
    EXCLUDED,
    FROZEN,
    FROZEN_PLACE,
    INTERVAL,
    LAST_SUM,
    MEAN_NIS,
    NEVER,
    NOISE_EXCESS,
    NOISY,
    NOMINAL,
    REJECTED_SPEED,
    T_JUDGED,
    T_LAST,
)
from fusiond.maths.portable import exp
from fusiond.maths.typed import Array, Matrix3, Stamps, Vector, Vector3, compiled

OUTAGE_NS = 10_000_000_000  # a source that was silent for longer is new when it returns, for as long
JUDGE_NS = 50_000_000  # samples closer than this share their error
MEAN_STATUS_TIME = 20.0  # s: how long a source keeps its status
PRIOR = (0.997, 0.001, 0.001, 0.001)  # nominal, noisy, biased, frozen: what it becomes then
PRIOR_OF_LIAR = (0.499, 0.001, 0.499, 0.001)  # the same of a source whose receiver was found to lie
PRIOR_BIASED = PRIOR[2]
OUTLIERS = 0.01  # share of readings that are off whatever the source is
OUTLIER_VARIANCE = 100.0  # of such a reading, per axis, in units of S
NOISY_VARIANCE = 16.0  # of a noisy source's innovation, likewise
FIRST_BIAS_VARIANCE = 100.0  # of a biased source's bias, likewise
BIAS_WALK = 0.01  # how fast a bias changes: variance added at each sample
MAX_SQUARE = 1000.0  # a squared innovation beyond is no stranger than this: no likelihood vanishes
MIN_BIAS = 2.0  # a smaller bias, in sigmas, is not called one
SAME_IF_NOMINAL = 1 / 3  # chance that a good sensor repeats a reading to the bit
SAME_IF_FAULTY = 1 / 20  # chance that a noisy or biased one does
OTHER_IF_FROZEN = 1e-3  # chance that a frozen one does not
NOTED = 0.1  # a source that is noisy with at most this probability is taken as it is
DISTRUST = 0.5  # a source that is biased or frozen with more than this probability is not fused
ABSENT = 1e-3  # chance that a source that was heard a moment ago has gone
DETECTION = 0.9  # chance that an expected reading comes
MAX_MISSES = 30
UNKNOWN_INTERVAL = 1.0  # s, where a source was never heard
CHANCE = 0.2  # learnt noise that differs by less than this share from the given is the same
NOISE_TIME = 30.0  # s, over which noise is learnt
CLIPPED = 25.0  # a squared innovation counts for at most so many times its variance: outliers are not noise
MAX_INTERVAL = 10.0  # s: a longer pause counts as this in the mean spacing
INTERVAL_SHARE = 0.05  # weight of the newest interval in the mean
MOVING = 2.0  # m/s: from here on a rejected wheel is compared with the vehicle's speed
REJECTED_SHARE = 0.02  # weight of the newest rejected reading in their mean
UNITS = {"km/h": 3.6, "mph": 1 / 0.44704, "knots": 1 / 0.514444, "m/s": 1 / 3.6}  # times too high, if it is that unit
UNIT_SHARE = 0.06  # how far from that a wheel may be
NIS_TIME = 10.0  # s, over which the mean of the normalised innovation squared is taken


class Belief(NamedTuple):
    """The health of a source: probabilities of nominal, noisy, biased, frozen and absent; the likeliest; and why."""

    probabilities: tuple[float, float, float, float, float]
    status: str
    reason: str


INERTIAL_AXES = ("accelerometer x", "accelerometer y", "accelerometer z", "gyro x", "gyro y", "gyro z")  # by FROZEN_PLACE
LIAR = "it contradicts the wheels and the inertial sensor; not fused"
CONTRADICTED = "it contradicts all the others; what it said lately counts for less"
STATUSES = ("nominal", "noisy", "biased", "frozen", "absent")


@compiled
def begin(memory: Vector) -> None:
    """Know nothing of a source yet."""
    for i in range(4):
        memory[NOMINAL + i] = memory[BEFORE.start + i] = PRIOR[i]
    memory[BIAS] = 0.0
    memory[BIAS_VARIANCE] = FIRST_BIAS_VARIANCE


@compiled
def judge_repetition(memory: Vector, stamps: Stamps, same: bool, t_ns: int) -> None:
    """Judge a source without innovations, the inertial sensor: only a frozen one shows."""
    if is_due(stamps, t_ns, 0.0):
        nothing = np.zeros(3)
        judge(memory, stamps, nothing, 0, same, t_ns)


@compiled
def blame_frozen(memory: Vector, probability: float) -> None:
    """Take a source as frozen with at least this probability, because a part of it is."""
    if memory[NOMINAL] + memory[NOISY] + memory[BIASED] + memory[FROZEN] == 0:
        begin(memory)
    if memory[FROZEN] < probability:
        rest = (1 - probability) / (1 - memory[FROZEN])
        for i in range(4):
            memory[NOMINAL + i] *= rest
        memory[FROZEN] = probability


@compiled
def is_due(stamps: Stamps, t_ns: int, correlation: float) -> bool:
    """Whether enough time has passed since the last look for a new one to be independent of it."""
    pause = int(2e9 * correlation)
    return stamps[T_JUDGED] == NEVER or t_ns - stamps[T_JUDGED] >= max(JUDGE_NS, pause)


@compiled
def judge(memory: Vector, stamps: Stamps, whitened: Vector3, m: int, same: bool, t_ns: int) -> None:
    """Bayes' rule for one source (THEORY D1), after the passage of time has blurred its probabilities: by the whitened
    innovation (m,), and whether the reading repeats the one before to the bit."""
    if memory[NOMINAL] + memory[NOISY] + memory[BIASED] + memory[FROZEN] == 0:
        begin(memory)
    elapsed = MEAN_STATUS_TIME
    if stamps[T_JUDGED] != NEVER:
        elapsed = (t_ns - stamps[T_JUDGED]) * 1e-9
    stamps[T_JUDGED] = t_ns
    blurred = 1 - exp(-elapsed / MEAN_STATUS_TIME)
    for i in range(4):
        usual = PRIOR[i] if memory[EXCLUDED] == 0 else PRIOR_OF_LIAR[i]
        memory[BEFORE.start + i] = memory[NOMINAL + i] + blurred * (usual - memory[NOMINAL + i])
    look(memory, whitened, m, same)
    _follow_bias(memory, whitened, m)


@compiled
def judge_repeated(memory: Vector, whitened: Vector3, m: int) -> None:
    """Whether a distrusted source that repeats its reading is rather frozen than biased. It stays distrusted: that it
    happens to be right, at rest say, proves nothing."""
    nominal, _noisy, biased, frozen = likelihoods(memory, whitened, m, True)
    distrusted, share = memory[BIASED] + memory[FROZEN], frozen * memory[FROZEN]
    total = biased * memory[BIASED] + share
    if nominal <= frozen and total > 0:
        memory[FROZEN] = distrusted * share / total
        memory[BIASED] = distrusted - memory[FROZEN]


@compiled
def look(memory: Vector, whitened: Vector3, m: int, same: bool) -> None:
    """The probabilities after a look, from those before it. A reading that shares its error with the look before takes its
    place: what both say counts once."""
    _renew_bias(memory, whitened, m)
    nominal, noisy, biased, frozen = likelihoods(memory, whitened, m, same)
    memory[NOMINAL] = memory[BEFORE.start] * nominal
    memory[NOISY] = memory[BEFORE.start + 1] * noisy
    memory[BIASED] = memory[BEFORE.start + 2] * biased
    memory[FROZEN] = memory[BEFORE.start + 3] * frozen
    total = 0.0
    for i in range(4):
        total += memory[NOMINAL + i]
    for i in range(4):
        memory[NOMINAL + i] = memory[NOMINAL + i] / total


@compiled
def likelihoods(memory: Vector, whitened: Vector3, m: int, same: bool) -> tuple[float, float, float, float]:
    """Of the four hypotheses, up to a common factor (2 pi)^(-m/2)."""
    square = off = 0.0
    stretch = _stretch(memory, m)
    for a in range(m):
        square += whitened[a] * whitened[a]
        rest = whitened[a] - memory[BIAS.start + a] * stretch
        off += rest * rest
    square, off = min(square, MAX_SQUARE), min(off, MAX_SQUARE)
    outlier = _density(square, OUTLIER_VARIANCE, m)
    good = (1 - OUTLIERS) * _density(square, 1.0, m) + OUTLIERS * outlier
    noisy = (1 - OUTLIERS) * _density(square, NOISY_VARIANCE, m) + OUTLIERS * outlier
    biased = (1 - OUTLIERS) * _density(off, 1 + memory[BIAS_VARIANCE], m) + OUTLIERS * outlier
    if not same:
        return good, noisy, biased, outlier * OTHER_IF_FROZEN
    return good * SAME_IF_NOMINAL, noisy * SAME_IF_FAULTY, biased * SAME_IF_FAULTY, outlier


@compiled
def _renew_bias(memory: Vector, whitened: Vector3, m: int) -> None:
    """Forget the bias where a new one, of which nothing is known, explains the innovation better."""
    square = off = 0.0
    for a in range(m):
        square += whitened[a] * whitened[a]
        rest = whitened[a] - memory[BIAS.start + a]
        off += rest * rest
    if _density(square, 1 + FIRST_BIAS_VARIANCE, m) > _density(off, 1 + memory[BIAS_VARIANCE], m):
        memory[BIAS] = 0.0
        memory[BIAS_VARIANCE] = FIRST_BIAS_VARIANCE


@compiled
def _density(square: float, variance: float, m: int) -> float:
    """exp(-square / 2 variance) / variance^(m/2)"""
    root = math.sqrt(variance)
    scale = 1.0
    for _a in range(m):
        scale *= root
    return exp(-square / (2 * variance)) / scale


@compiled
def _stretch(memory: Vector, m: int) -> float:
    """What takes a bias that is too small to be called one to the least that is; 1 while it is not known."""
    if memory[BIAS_VARIANCE] >= 1.0:
        return 1.0
    size = 0.0
    for a in range(m):
        size += memory[BIAS.start + a] * memory[BIAS.start + a]
    size = math.sqrt(size)
    return MIN_BIAS / size if 1e-9 < size < MIN_BIAS else 1.0


@compiled
def _follow_bias(memory: Vector, whitened: Vector3, m: int) -> None:
    """A scalar Kalman filter for each axis of the bias, all of one variance."""
    variance = memory[BIAS_VARIANCE] + BIAS_WALK
    gain = variance / (variance + 1)
    for a in range(m):
        memory[BIAS.start + a] += gain * (whitened[a] - memory[BIAS.start + a])
    memory[BIAS_VARIANCE] = (1 - gain) * variance


@compiled
def is_trusted(memory: Vector) -> bool:
    """Whether a source is fused at all."""
    return memory[EXCLUDED] == 0 and memory[BIASED] + memory[FROZEN] <= DISTRUST


@compiled
def is_used(memory: Vector, by_rivals: bool) -> bool:
    """Whether a source is fused in the main state. Of a receiver, rival hypotheses decide whether it lies."""
    return memory[EXCLUDED] == 0 and memory[FROZEN] + (0.0 if by_rivals else memory[BIASED]) <= DISTRUST


@compiled
def is_stuck(memory: Vector) -> bool:
    """Whether a source repeats one reading."""
    return memory[FROZEN] > DISTRUST


@compiled
def odds_of_bias(memory: Vector) -> float:
    """Of a source being biased against its being nominal."""
    return memory[BIASED] / memory[NOMINAL] if memory[NOMINAL] > 1e-12 else memory[BIASED] * 1e12


@compiled
def distrust(memory: Vector) -> None:
    """Take a source as biased, until its readings say otherwise."""
    for i in range(4):
        memory[NOMINAL + i] = memory[BEFORE.start + i] = PRIOR[i]
    memory[NOMINAL] = memory[BEFORE.start] = PRIOR[BIASED - NOMINAL]
    memory[BIASED] = memory[BEFORE.start + BIASED - NOMINAL] = PRIOR[0]


@compiled
def noise_factor(memory: Vector, lowest: float, highest: float) -> float:
    """By what a source's configured variance is multiplied: as learnt, within bounds; a little more or less is chance."""
    beyond = 0.0
    if memory[NOISE_EXCESS] > CHANCE:
        beyond = memory[NOISE_EXCESS] - CHANCE
    elif memory[NOISE_EXCESS] < -CHANCE:
        beyond = memory[NOISE_EXCESS] + CHANCE
    return min(max(1 + beyond, lowest), highest)


@compiled
def noisy_factor(memory: Vector) -> float:
    """And by what besides, by the probability that it is noisy: 1 while that is small."""
    return 1 + (NOISY_VARIANCE - 1) * memory[NOISY] if memory[NOISY] > NOTED else 1.0


@compiled
def learn(memory: Vector, innovation: Vector3, variance: Vector3, spread: Matrix3, m: int, elapsed: float) -> None:
    """Noise from innovations (THEORY C3): the mean of d^2 - H P H', as a multiple of the configured variance (m,), with
    H P H' (m, m) and `elapsed` [s] since the last one."""
    found = configured = nis = 0.0
    for a in range(m):
        square, expected = innovation[a] * innovation[a], spread[a, a] + variance[a]
        nis += square / expected
        found += min(square, CLIPPED * expected) - spread[a, a]
        configured += variance[a]
    memory[MEAN_NIS] += elapsed / (NIS_TIME + elapsed) * (nis / m - memory[MEAN_NIS])
    if configured > 0:
        memory[NOISE_EXCESS] += elapsed / (NOISE_TIME + elapsed) * (found / configured - 1 - memory[NOISE_EXCESS])


@compiled
def since_last(stamps: Stamps, t_ns: int) -> float:
    """Time since a source's last reading [s]; 0 for the first."""
    if stamps[T_LAST] == NEVER:
        return 0.0
    return (t_ns - stamps[T_LAST]) * 1e-9


@compiled
def arrive(memory: Vector, stamps: Stamps, values: Vector, t_ns: int) -> bool:
    """Note a reading. Returns whether it repeats the one before to the bit."""
    total = values[0] + values[1] + values[2]
    same = stamps[T_LAST] != NEVER and total == memory[LAST_SUM]
    memory[LAST_SUM] = total
    elapsed = since_last(stamps, t_ns)
    if elapsed > 0:
        share = INTERVAL_SHARE if memory[INTERVAL] > 0 else 1.0
        memory[INTERVAL] += share * (min(elapsed, MAX_INTERVAL) - memory[INTERVAL])
    return same


@compiled
def note_rejected(memory: Vector, reading: float, innovation: float) -> None:
    """Keep what a wheel reads [m/s] that is rejected in motion, and what it should have read."""
    expected = abs(reading - innovation)
    if expected < MOVING:
        return
    share = REJECTED_SHARE if memory[ACTUAL_SPEED] > 0 else 1.0
    memory[REJECTED_SPEED] += share * (abs(reading) - memory[REJECTED_SPEED])
    memory[ACTUAL_SPEED] += share * (expected - memory[ACTUAL_SPEED])


def misreading(memory: Array) -> str:
    """What a wheel that is rejected reads, for people; nothing where none was rejected in motion."""
    if memory[ACTUAL_SPEED] <= 0:
        return ""
    ratio = float(memory[REJECTED_SPEED] / memory[ACTUAL_SPEED])
    if ratio < 0.02:
        return "it reads 0 while the vehicle moves"
    for unit, factor in UNITS.items():
        if abs(ratio / factor - 1) < UNIT_SHARE:
            return f"it reads {ratio:.2f} times the vehicle's speed: is the unit {unit}?"
    return f"it reads {ratio:.2f} times the vehicle's speed"


def belief(memory: Array, stamps: Stamps, t_ns: int, since_ns: int, lies: float | None = None) -> Belief:
    """The health of a source at `t_ns`, where the filter has run since `since_ns`; `lies` is the probability that it is
    biased, where rival hypotheses decide on that.

    Absent (THEORY D2): with detection probability P_D, each expected reading that is missing has likelihood 1 - P_D.
    """
    kept = memory[BELIEF].tolist() if memory[BELIEF].any() else list(PRIOR)
    if lies is not None:
        rest = kept[0] + kept[1] + kept[3]
        kept = [p * (1 - lies) / rest if rest > 0 else 0.0 for p in kept]
        kept[2] = lies
    age = (t_ns - max(int(stamps[T_LAST]), since_ns)) * 1e-9
    expected = memory[INTERVAL] if memory[INTERVAL] > 0 else UNKNOWN_INTERVAL
    odds = ABSENT / (1 - ABSENT)
    for _ in range(min(int(age / expected), MAX_MISSES)):
        odds /= 1 - DETECTION
    absent = odds / (1 + odds)
    nominal, noisy, biased, frozen = (float(p) * (1 - absent) for p in kept)
    probabilities = (nominal, noisy, biased, frozen, absent)
    status = STATUSES[max(range(len(STATUSES)), key=probabilities.__getitem__)]
    if status == "biased" and lies is not None:
        return Belief(probabilities, status, LIAR if memory[EXCLUDED] else CONTRADICTED)
    return Belief(probabilities, status, _reason(memory, status, age))


def _reason(memory: Array, status: str, age: float) -> str:  # noqa: PLR0911 - one for each status
    """What speaks for a status, for people."""
    match status:
        case "noisy":
            return f"squared innovations {memory[MEAN_NIS]:.1f} times as large as expected"
        case "biased" | "frozen" if found := misreading(memory):
            return f"{found}; not fused"
        case "biased":
            off = max(memory[BIAS].tolist(), key=abs)
            return f"constant error of {abs(off):.0f} sigma; not fused"
        case "frozen" if memory[FROZEN_PLACE]:
            number = int(memory[FROZEN_PLACE]) - 1
            what = "sits at its largest reading: saturated" if number >= len(INERTIAL_AXES) else "repeats one reading"
            return f"{INERTIAL_AXES[number % len(INERTIAL_AXES)]} {what} while the other axes move; not fused"
        case "frozen":
            return "it repeats one reading while the vehicle moves; not fused"
        case "absent":
            return f"not received for {age:.1f} s"
    return ""
