"""The fixed-interval smoother, as a filter that goes over a stretch of rows forward and an adjoint that comes back.

Forward, the rows of a drive go through a plain filter on the models and the propagation of the live one, without rivals and
health: which measurements are used was decided before. Of each measurement a link is kept: what became of an error since the
link before (the transition A, with the reset Jacobians of the closed loop), and the update. Backward, the adjoint (lambda,
Lambda) of what all later measurements say is carried from link to link, and smoothed = filtered (+) P lambda, of covariance
P - P Lambda P: the modified Bryson-Frazier form of the Rauch-Tung-Striebel smoother (Bierman 1977, Factorization Methods,
section X; Simon 2006, section 9.4.3). It inverts no covariance, so calibrations that are frozen do not matter.

On its way back the adjoint judges each measurement by all others, before and after it: D^-1 u, with u = S^-1 d - K' lambda
and D = S^-1 + K' Lambda K, is what the measurement is off the state that the drive without it gives (de Jong and Penzer
1998, Diagnosing shocks in time series). One that the filter believed, because it knew no better yet, is unmasked so.
"""

from __future__ import annotations

import numpy as np

from fusiond.filter import gnss_error, source_health
from fusiond.filter.measurement import HORIZONTAL, factor_of, remember, share_noise
from fusiond.filter.measurement_update import (
    cholesky,
    inject,
    joseph,
    make_gain,
    project,
    turn_along,
    turn_rows,
    whiten,
)
from fusiond.filter.motion_constraints import (
    NON_HOLONOMIC,
    ZERO_ROTATION,
    ZERO_VELOCITY,
    constraints_due,
    observe_constraint,
    rests,
)
from fusiond.filter.observations import GNSS_POSITION, IMU, observe
from fusiond.filter.observations.model import NOISE_MAX, NOISE_MIN, Observation, with_rate_noise
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import Row, Rows
from fusiond.filter.state import (
    FORCE_B,
    NEVER,
    NOMINAL_SIZE,
    RATE_B,
    T_FUSED,
    T_IMU,
    T_LAST,
    T_POSITION,
    FilterState,
    T,
    is_sound,
)
from fusiond.filter.step import advance, coasts, keep_sample
from fusiond.maths.linear import dot, mirror
from fusiond.maths.typed import (
    Array,
    Covariance,
    ErrorRows3,
    ErrorVector,
    Matrix3,
    Stamps,
    Transition,
    Vector,
    Vector3,
    compiled,
)

LOOK = -1  # source of a row that is no event, but an instant at which the smoothed state is wanted
PARTS = 3  # of a row that are judged apart: a fix horizontally and its height; the constraints at an inertial sample
LINKS = 4  # of a row at most
OPEN, USED, LEFT = 0, 1, 2  # verdicts on a part: the gate decides; it is used; it is left out
FURTHER = 8  # numbers of a look after state and covariance: rate, force; age of the inertial sample and the fix [s]
END = -2  # part of the link at the end of a stretch
UNSOUND = -1  # instead of a number of links


class Link:
    """One link of the chain: what becomes of an error since the link before, and then a measurement of `m` axes; none at the
    end of a stretch and at a look. `fused` says whether it was taken into the state."""

    __slots__ = (
        "across",
        "fused",
        "gain",
        "innovation",
        "m",
        "part",
        "row",
        "sight",
        "spread",
        "transition",
        "variance",
        "weight",
    )

    def __init__(self, size: int) -> None:
        """Room for `size` error states."""
        self.row = self.part = self.m = 0  # place of its row, its part of that, its axes
        self.fused = False
        self.weight = 1.0  # what the variance is taken times in the update: errors that are correlated
        self.innovation: Array = np.zeros(3)
        self.variance: Array = np.zeros(3)
        self.spread: Array = np.zeros((3, 3))  # H P H'
        self.sight: Array = np.zeros((3, size))  # H
        self.across: Array = np.zeros((3, size))  # H P
        self.gain: Array = np.zeros((3, size))  # K'
        self.transition: Array = np.eye(size)


Links = list[Link]


# --- Forward


@compiled
def follow(
    state: FilterState, rows: Rows, count: int, judged: Stamps, looks: Vector, links: Links, params: Parameters
) -> int:
    """Take a stretch of `count` rows, in order, into a state that is tracked, and write its links. `judged` holds the
    verdict on each part of each row. At each look the state's numbers go into `looks`, one block after the other. Returns
    the number of links, or UNSOUND where the state was lost."""
    found = following = look = 0
    for i in range(count):
        row = rows[i]
        following = max(following, i)
        while following < count and not _is_inertial(rows[following], params):
            following += 1
        t_ns, source = int(row["t_ns"]), int(row["source"])
        coasted = coasts(state, t_ns, params)
        imu = rows[following] if following < count else None
        advance(state, t_ns, imu, params)
        if source == LOOK:
            _note_look(state, look, looks)
            _begin_link(state, links[found], i, LOOK)
            look += 1
            found += 1
        elif params.models[source] == IMU:
            keep_sample(state, row, params)
            found += _constrain(state, i, True, judged, links, found, params)
            state.source_stamps[source, T_LAST] = t_ns
        else:
            found += _measure(state, row, i, judged, links, found, params)
            state.source_stamps[source, T_LAST] = t_ns
            if coasted and not rests(state, params):
                found += _constrain(state, i, False, judged, links, found, params)
        if not is_sound(state):
            return UNSOUND
    _begin_link(state, links[found], count, END)
    return found + 1


@compiled
def _is_inertial(row: Row, params: Parameters) -> bool:
    source = int(row["source"])
    return source != LOOK and params.models[source] == IMU


@compiled
def _note_look(state: FilterState, look: int, looks: Vector) -> None:
    """Write nominal state, covariance, angular rate and specific force into the next block."""
    at = look * (NOMINAL_SIZE + state.size * state.size + FURTHER)
    for k in range(NOMINAL_SIZE):
        looks[at + k] = state.nominal[k]
    at += NOMINAL_SIZE
    for i in range(state.size):
        for k in range(state.size):
            looks[at + i * state.size + k] = state.covariance[i, k]
    at += state.size * state.size
    for k in range(3):
        looks[at + k] = state.auxiliary[RATE_B.start + k]
        looks[at + 3 + k] = state.auxiliary[FORCE_B.start + k]
    looks[at + 6] = (state.stamps[T] - state.stamps[T_IMU]) * 1e-9
    looks[at + 7] = (state.stamps[T] - state.stamps[T_POSITION]) * 1e-9


@compiled
def _begin_link(state: FilterState, link: Link, row: int, part: int) -> None:
    """Keep what has become of an error since the link before, and begin anew."""
    link.row, link.part, link.m, link.fused = row, part, 0, False
    for i in range(state.size):
        link.transition[i] = state.transition[i]
        state.transition[i] = 0.0
        state.transition[i, i] = 1.0


@compiled
def _measure(
    state: FilterState, row: Row, place: int, judged: Stamps, links: Links, found: int, params: Parameters
) -> int:
    """Fuse one measurement, at the state's own instant. Returns the number of its links."""
    source, t_ns = int(row["source"]), int(row["t_ns"])
    model, values = params.models[source], row["values"]
    parameter, memory, stamps = params.model_parameters[source], state.memory[source], state.source_stamps[source]
    source_health.arrive(memory, stamps, values, t_ns)
    remember(memory, model, values)
    seen = Observation(state.size)
    if model == GNSS_POSITION:
        gnss_error.carry(state, source, values, params)
        gnss_error.note(state, source, values, params)
    if not observe(state, model, values, parameter, seen):
        return 0
    share_noise(state, seen, parameter)
    factor = source_health.noise_factor(memory, parameter[NOISE_MIN], parameter[NOISE_MAX])
    for a in range(seen.m):
        seen.variance[a] *= factor
    if stamps[T_LAST] == NEVER or t_ns - stamps[T_LAST] > source_health.OUTAGE_NS:
        stamps[T_FUSED] = NEVER
    weight = factor_of(stamps, model, values, parameter, t_ns)
    if model == GNSS_POSITION:
        seen.m = HORIZONTAL
    if _take(state, seen, weight, judged[PARTS * place], place, 0, links[found], params):
        stamps[T_FUSED] = t_ns
        if model == GNSS_POSITION:
            state.stamps[T_POSITION] = t_ns
    if model != GNSS_POSITION:
        return 1
    if not observe(state, model, values, parameter, seen):
        return 1
    share_noise(state, seen, parameter)
    seen.m = 1
    seen.jacobian[0] = seen.jacobian[2]
    seen.innovation[0], seen.common[0], seen.variance[0] = seen.innovation[2], seen.common[2], seen.variance[2] * factor
    _take(state, seen, 1.0, judged[PARTS * place + 1], place, 1, links[found + 1], params)
    return 2


@compiled
def _constrain(
    state: FilterState, place: int, sensed: bool, judged: Stamps, links: Links, found: int, params: Parameters
) -> int:
    """Apply the motion constraints that are due; without the inertial sensor, which shows standstill, only that wheels roll.
    Returns the number of their links."""
    still, rolling = constraints_due(state, params)
    still = still and sensed
    seen = Observation(state.size)
    taken, stands, made = False, False, 0
    if still and observe_constraint(state, ZERO_VELOCITY, params, seen):
        with_rate_noise(state, seen)
        stands = _take(
            state, seen, params.zero_velocity_factor, judged[PARTS * place], place, 0, links[found], params
        )
        made = 1
    if stands and observe_constraint(state, ZERO_ROTATION, params, seen):
        with_rate_noise(state, seen)
        taken = _take(state, seen, 1.0, judged[PARTS * place + 1], place, 1, links[found + made], params)
        made += 1
    if rolling and not still and not taken and observe_constraint(state, NON_HOLONOMIC, params, seen):
        with_rate_noise(state, seen)
        _take(state, seen, 1.0, judged[PARTS * place + 2], place, 2, links[found + made], params)
        made += 1
    return made


@compiled
def _take(
    state: FilterState,
    seen: Observation,
    weight: float,
    verdict: int,
    place: int,
    part: int,
    link: Link,
    params: Parameters,
) -> bool:
    """Write the link of an observation, and fuse it where the verdict says so. Returns whether it was fused."""
    p, m = state.covariance, seen.m
    _begin_link(state, link, place, part)
    project(state, seen, link.across, link.spread)
    whitened, distance = np.empty(3), 0.0
    if not whiten(link.spread, seen.innovation, seen.variance, m, whitened):
        return False
    for a in range(m):
        distance += whitened[a] * whitened[a]
        link.innovation[a], link.variance[a] = seen.innovation[a], seen.variance[a]
        link.sight[a] = seen.jacobian[a]
    link.m, link.weight = m, weight
    if verdict == LEFT or (verdict == OPEN and not distance <= params.gates[m]):
        return False
    if not make_gain(p, seen, weight, False, link.across, link.spread, link.gain):
        return False
    link.fused = True
    joseph(p, seen, weight, link.across, link.gain)
    error = np.zeros(state.size)
    for a in range(m):
        error += seen.innovation[a] * link.gain[a]
    turn_along(p, error)
    turn_rows(state.transition, error)
    inject(state, error)
    return True


# --- Backward


@compiled
def go_back(
    state: FilterState,
    links: Links,
    count: int,
    rows: Rows,
    judged: Stamps,
    vector: ErrorVector,
    matrix: Covariance,
    looks: Vector,
    look: int,
    params: Parameters,
) -> None:
    """Carry the adjoint, `vector` (n,) and `matrix` (n, n), back over the links of a stretch. Each row gets the innovation
    and variance that it has against all others, and each part its verdict; each of the `look` blocks becomes the smoothed
    state. `state` is room to work in."""
    for i in range(count - 1, -1, -1):
        link = links[i]
        if link.m > 0:
            _judge(link, rows[link.row], judged, vector, matrix, params)
            if link.fused:
                through_update(link, vector, matrix)
        elif link.part == LOOK:
            look -= 1
            _smooth_look(state, vector, matrix, looks, look)
        through_transition(link.transition, vector, matrix)


@compiled
def _judge(
    link: Link, row: Row, judged: Stamps, vector: ErrorVector, matrix: Covariance, params: Parameters
) -> None:
    """Judge a measurement by all others, and write verdict, innovation and variance."""
    m = link.m
    innovation, variance = np.zeros(3), np.zeros((3, 3))
    if not against_others(link, vector, matrix, innovation, variance):
        return
    lower, none, whitened = np.empty((3, 3)), np.zeros(3), np.empty(3)
    if not cholesky(variance, none, 1.0, m, lower) or not whiten(variance, innovation, none, m, whitened):
        return
    distance = 0.0
    for a in range(m):
        distance += whitened[a] * whitened[a]
    verdict = USED if distance <= params.gates[m] else LEFT
    judged[PARTS * link.row + link.part] = verdict
    if params.models[int(row["source"])] == IMU:
        return
    if link.part == 0:
        row["ratio"] = distance / params.gates[m]
        for a in range(m):
            row["innovation"][a], row["variance"][a] = innovation[a], variance[a, a]
    elif link.part == 1:
        row["innovation"][2], row["variance"][2] = innovation[0], variance[0, 0]


@compiled
def against_others(
    link: Link, vector: ErrorVector, matrix: Covariance, innovation: Vector3, variance: Matrix3
) -> bool:
    """What a measurement (m,) is off the state that all others, before and after, give, and the covariance (m, m) of that.
    False where that is not positive definite."""
    if link.fused:
        return _against_others_fused(link, vector, matrix, innovation, variance)
    along, back = np.zeros(3), np.zeros((3, 3))  # H P lambda, H P Lambda P H'
    _seen_by(link.across, link.m, vector, matrix, along, back)
    for a in range(link.m):
        innovation[a] = link.innovation[a] - along[a]
        for b in range(link.m):
            variance[a, b] = link.spread[a, b] - back[a, b]
        variance[a, a] += link.variance[a]
    return True


@compiled
def _against_others_fused(
    link: Link, vector: ErrorVector, matrix: Covariance, innovation: Vector3, variance: Matrix3
) -> bool:
    """The same of a measurement that was fused: its own part is taken out again."""
    m, along, back = link.m, np.zeros(3), np.zeros((3, 3))  # K' lambda, K' Lambda K
    whole, known, none = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    _seen_by(link.gain, m, vector, matrix, along, back)
    if not inverse(link.spread, link.variance, link.weight, m, whole):
        return False
    for a in range(m):
        for b in range(m):
            known[a, b] = whole[a, b] + back[a, b]
    if not inverse(known, none, 1.0, m, variance):
        return False
    for a in range(m):
        innovation[a] = 0.0
        for b in range(m):
            u = -along[b]
            for c in range(m):
                u += whole[b, c] * link.innovation[c]
            innovation[a] += variance[a, b] * u
    for a in range(m):
        variance[a, a] -= (link.weight - 1) * link.variance[a]
    return True


@compiled
def _seen_by(
    by: ErrorRows3, m: int, vector: ErrorVector, matrix: Covariance, along: Vector3, back: Matrix3
) -> None:
    """The adjoint along the first rows (m, n): B lambda into `along`, B Lambda B' into `back`."""
    product = np.empty(len(vector))
    for a in range(m):
        along[a] = dot(by[a], vector)
        product[:] = 0.0
        for k in range(len(vector)):
            if by[a, k] != 0.0:
                product += by[a, k] * matrix[k]
        for b in range(m):
            back[a, b] = dot(product, by[b])


@compiled
def inverse(spread: Matrix3, variance: Vector3, factor: float, m: int, found: Matrix3) -> bool:
    """Write the inverse of spread + factor * diag(variance), (m, m), into `found`; False where that is not positive
    definite."""
    lower, column = np.empty((3, 3)), np.empty(3)
    if not cholesky(spread, variance, factor, m, lower):
        return False
    for b in range(m):
        for i in range(m):
            column[i] = 1.0 if i == b else 0.0
            for k in range(i):
                column[i] -= lower[i, k] * column[k]
            column[i] /= lower[i, i]
        for i in range(m - 1, -1, -1):
            for k in range(i + 1, m):
                column[i] -= lower[k, i] * column[k]
            column[i] /= lower[i, i]
        for i in range(m):
            found[i, b] = column[i]
    return True


@compiled
def through_update(link: Link, vector: ErrorVector, matrix: Covariance) -> None:
    """lambda = lambda + H' u and Lambda = (I - K H)' Lambda (I - K H) + H' S^-1 H, with u = S^-1 d - K' lambda."""
    m, whole, both = link.m, np.zeros((3, 3)), np.zeros((3, 3))
    if not inverse(link.spread, link.variance, link.weight, m, whole):
        return
    by_gain = np.empty((3, len(vector)))  # K' Lambda
    for a in range(m):
        by_gain[a] = 0.0
        for k in range(len(vector)):
            if link.gain[a, k] != 0.0:
                by_gain[a] += link.gain[a, k] * matrix[k]
    for a in range(m):
        for b in range(m):
            both[a, b] = whole[a, b] + dot(by_gain[a], link.gain[b])
    u = np.zeros(3)
    for a in range(m):
        u[a] = -dot(link.gain[a], vector)
        for b in range(m):
            u[a] += whole[a, b] * link.innovation[b]
    for a in range(m):
        vector += u[a] * link.sight[a]
        for k in range(len(vector)):
            matrix[k] += -by_gain[a, k] * link.sight[a]
            if link.sight[a, k] != 0.0:
                matrix[k] += -link.sight[a, k] * by_gain[a]
                for b in range(m):
                    matrix[k] += (link.sight[a, k] * both[a, b]) * link.sight[b]
    mirror(matrix)


@compiled
def through_transition(  # noqa: PLR0912 - loops
    transition: Transition, vector: ErrorVector, matrix: Covariance
) -> None:
    """lambda = A' lambda and Lambda = A' Lambda A. Most rows of A are those of the identity."""
    before, moved = np.empty(len(vector)), np.zeros(len(vector))
    for k in range(len(vector)):
        before[k] = vector[k]
        same = transition[k, k] == 1.0
        for i in range(len(vector)):
            if i != k and transition[k, i] != 0.0:
                same = False
        moved[k] = 0.0 if same else 1.0
    for k in range(len(vector)):  # A = I + X
        if moved[k] != 0.0:
            vector += before[k] * transition[k]
            vector[k] -= before[k]
    product = np.empty((len(vector), len(vector)))
    for i in range(len(vector)):
        product[i] = matrix[i]
        for k in range(len(vector)):
            if moved[k] != 0.0:
                product[i] += matrix[i, k] * transition[k]
                product[i, k] -= matrix[i, k]
    for i in range(len(vector)):
        matrix[i] = product[i]
    for k in range(len(vector)):
        if moved[k] != 0.0:
            for i in range(len(vector)):
                by = transition[k, i] - (1.0 if i == k else 0.0)
                if by != 0.0:
                    matrix[i] += by * product[k]
    mirror(matrix)


@compiled
def _smooth_look(state: FilterState, vector: ErrorVector, matrix: Covariance, looks: Vector, look: int) -> None:
    """Make the filtered state of a look the smoothed one: x (+) P lambda, P - P Lambda P."""
    size = state.size
    at = look * (NOMINAL_SIZE + size * size + FURTHER)
    covariance = at + NOMINAL_SIZE
    for k in range(NOMINAL_SIZE):
        state.nominal[k] = looks[at + k]
    for i in range(state.size):
        for k in range(state.size):
            state.covariance[i, k] = looks[covariance + i * size + k]
    smooth(state, vector, matrix)
    for k in range(NOMINAL_SIZE):
        looks[at + k] = state.nominal[k]
    for i in range(state.size):
        for k in range(state.size):
            looks[covariance + i * size + k] = state.covariance[i, k]


@compiled
def smooth(state: FilterState, vector: ErrorVector, matrix: Covariance) -> None:
    """Make a filtered state the smoothed one, by the adjoint of what comes after it."""
    p = state.covariance
    error, known, gone = np.empty(state.size), np.empty((state.size, state.size)), np.empty((state.size, state.size))
    for i in range(state.size):
        error[i] = dot(p[i], vector)
        known[i] = 0.0
        for k in range(state.size):
            if p[i, k] != 0.0:
                known[i] += p[i, k] * matrix[k]
    for i in range(state.size):
        gone[i] = 0.0
        for k in range(state.size):
            if known[i, k] != 0.0:
                gone[i] += known[i, k] * p[k]
    for i in range(state.size):
        p[i] += -1.0 * gone[i]
    mirror(p)
    turn_along(p, error)
    inject(state, error)
