"""One measurement judged and fused: its noise, its health, its gate, and the reset where its source was locked out."""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter import gnss_error, rivals, source_health
from fusiond.filter.measurement_update import correlation_factor, project, update_projected, whiten
from fusiond.filter.motion_constraints import carried, disputed, is_carried
from fusiond.filter.observations import GNSS_POSITION, GNSS_VELOCITY, WHEEL_SPEED, gnss_position, observe, wheel_speed
from fusiond.filter.observations.gnss_velocity import lowest_speed
from fusiond.filter.observations.model import (
    CLUTTER,
    COMPANION,
    CORRELATION,
    NOISE_MAX,
    NOISE_MIN,
    RESETS,
    SHARED,
    Observation,
    with_rate_noise,
)
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import Row
from fusiond.filter.state import (
    ALIVE,
    BIASED,
    EXCLUDED,
    HEIGHT_OFFSET,
    HEIGHT_OFFSET_ERROR,
    INERTIAL_DOUBT,
    LAST_RATIO,
    LAST_SPEED,
    LOWEST_SPEED,
    NEVER,
    POSITION,
    STATE_DOUBT,
    SUSPECT,
    T_FUSED,
    T_LAST,
    T_POSITION,
    T_REJECTED,
    FilterState,
)
from fusiond.maths.typed import Stamps, Vector, Vector3, compiled

HORIZONTAL = 2  # axes of a fix that are judged together; its height is judged apart
DOUBT_TIME = 30.0  # s, after which a height that is rejected is fused


@compiled
def share_noise(state: FilterState, seen: Observation, parameter: Vector) -> None:
    """Add to an observation's variance what it shares with others of its group, and the gyro's noise on the lever arm."""
    for a in range(seen.m):
        seen.variance[a] *= parameter[SHARED]
    with_rate_noise(state, seen)


@compiled
def remember(memory: Vector, model: int, values: Vector) -> None:
    """Keep what the motion detector wants to know of a source's last reading."""
    if model == WHEEL_SPEED:
        memory[LAST_SPEED] = values[wheel_speed.SPEED]
    elif model == GNSS_VELOCITY:
        memory[LOWEST_SPEED] = lowest_speed(values)


@compiled
def factor_of(stamps: Stamps, model: int, values: Vector, parameter: Vector, t_ns: int) -> float:
    """How much less a reading is worth because its error is correlated with that of the one before."""
    if stamps[T_FUSED] == NEVER:
        return 1.0
    return correlation_factor((t_ns - stamps[T_FUSED]) * 1e-9, correlation_of(model, values, parameter))


@compiled
def correlation_of(model: int, values: Vector, parameter: Vector) -> float:
    """Time [s] over which a reading's error stays correlated."""
    return values[wheel_speed.CORRELATED] if model == WHEEL_SPEED else parameter[CORRELATION]


@compiled
def _carry_error(state: FilterState, source: int, values: Vector, params: Parameters) -> None:
    """Carry the slow error of positions to a fix, in the state and in its rivals."""
    gnss_error.carry(state, source, values, params)
    if state.stamps[ALIVE] > 0:
        for slot in range(rivals.RIVALS):
            if state.bank[slot, 0] > 0:
                rival = state.hypothesis(slot)
                gnss_error.carry(rival, source, values, params)
    gnss_error.note(state, source, values, params)


@compiled
def fuse_measurement(state: FilterState, row: Row, params: Parameters) -> bool:  # noqa: PLR0912, PLR0915 - one way of one measurement, top to bottom
    """Judge and fuse one measurement, a row of the table, at the state's own instant. Returns whether it was fused."""
    source, t_ns = int(row["source"]), int(row["t_ns"])
    model, values = params.models[source], row["values"]
    parameter, memory, stamps = params.model_parameters[source], state.memory[source], state.source_stamps[source]
    elapsed = source_health.since_last(stamps, t_ns)
    same = source_health.arrive(memory, stamps, values, t_ns)
    remember(memory, model, values)
    seen = Observation(state.size)
    if model == GNSS_POSITION:
        _carry_error(state, source, values, params)
    if not observe(state, model, values, parameter, seen):
        return False
    m = seen.m
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(state, seen, across, spread)
    share_noise(state, seen, parameter)
    given, learnt = np.empty(3), np.empty(3)
    factor = source_health.noise_factor(memory, parameter[NOISE_MIN], parameter[NOISE_MAX])
    for a in range(m):
        given[a] = seen.variance[a]
        learnt[a] = given[a] * factor
        row["innovation"][a] = seen.innovation[a]
        row["variance"][a] = spread[a, a] + learnt[a]
    if model == GNSS_POSITION:
        m = seen.m = HORIZONTAL
    elif state.nominal[INERTIAL_DOUBT] > rivals.FRESH and source_health.is_used(memory, True):
        for a in range(m):
            seen.variance[a] = learnt[a]
        rivals.fit_lie(state, seen, across, spread)
    weight = factor_of(stamps, model, values, parameter, t_ns)
    if stamps[T_LAST] == NEVER or t_ns - stamps[T_LAST] > source_health.OUTAGE_NS:
        stamps[T_FUSED] = NEVER
        source_health.begin(memory)
    by_rivals = model in (GNSS_POSITION, GNSS_VELOCITY)
    doubtful = disputed(state, source if model == GNSS_VELOCITY else int(parameter[COMPANION]), params)
    before = source_health.odds_of_bias(memory)
    if not doubtful:
        whitened, lasting = np.empty(3), correlation_of(model, values, parameter)
        judged, wider = seen.innovation.copy(), np.empty((3, 3))
        for a in range(m):
            for b in range(m):
                wider[a, b] = spread[a, b]
        if model == GNSS_POSITION:
            lasting = parameter[gnss_position.ERROR_TIME]
            gnss_error.with_whole_error(state, source, values, params, judged, wider)
        if whiten(wider, judged, learnt, m, whitened):
            _judge(state, source, whitened, m, same, t_ns, lasting, params)
            if model == GNSS_POSITION:
                rivals.weigh_consistency(state, source, whitened, wider, learnt)
        if model == GNSS_VELOCITY:
            rivals.lead_off(state, source, seen.innovation, elapsed, params)
        source_health.learn(memory, seen.innovation, given, spread, m, elapsed)
    trusted = source_health.is_used(memory, by_rivals)
    if model == WHEEL_SPEED and trusted:
        trusted = not carried(state, memory[LAST_SPEED], params)
    noisy = source_health.noisy_factor(memory)
    for a in range(m):
        seen.variance[a] = learnt[a] * noisy
    heard = not source_health.is_stuck(memory) and (trusted or by_rivals)
    fits = rivals.likelihood(seen.innovation, seen.variance, weight, m, spread) if heard else 0.0
    gate, clutter, scaled = params.gates[m], parameter[CLUTTER], model == WHEEL_SPEED
    ratio, fused = update_projected(state, seen, gate, weight, trusted, clutter, across, spread, scaled)
    row["ratio"] = memory[LAST_RATIO] = ratio
    gained = source_health.odds_of_bias(memory) / before if before > 0 else 1.0
    if state.stamps[ALIVE] > 0 and heard:
        unread = rivals.unread(seen.variance, weight, m, spread)
        main = fits if trusted else unread
        _weigh_rivals(state, source, values, factor * noisy, weight, main, unread, gained, ratio <= 1, params)
    if by_rivals and not doubtful:
        _suspect_receiver(state, source, values, params)
        if model == GNSS_POSITION and not fused:
            _suspect_state(state, source, values, seen, params)
    if trusted and heard and not doubtful:
        rivals.watch_inertial(state, seen, weight, spread, fits)
    if state.stamps[ALIVE] > 0:
        suspected = int(params.model_parameters[int(state.stamps[SUSPECT]), COMPANION])
        rivals.decide(state, disputed(state, suspected, params), params)
    if not fused and int(parameter[RESETS]) == HEIGHT_OFFSET_ERROR.start and memory[BIASED] > source_health.DISTRUST:
        _reset_offset(state, seen)  # a barometer that is off by a constant has another offset now: weather, a window
        source_health.begin(memory)
        fused = True
    if model == GNSS_POSITION:
        _fuse_height(state, source, values, factor * noisy, elapsed, trusted or fused, params)
        for slot in range(rivals.RIVALS):
            if state.bank[slot, 0] > 0 and rivals.uses(state, slot, source, params):
                rival = state.hypothesis(slot)
                _fuse_height(rival, source, values, factor * noisy, elapsed, True, params)
    if fused:
        stamps[T_REJECTED] = NEVER
        stamps[T_FUSED] = t_ns
        if model == GNSS_POSITION:
            state.stamps[T_POSITION] = t_ns
            state.auxiliary[STATE_DOUBT] = 0.0
    elif stamps[T_REJECTED] == NEVER:
        stamps[T_REJECTED] = t_ns
    if model == WHEEL_SPEED and not fused:
        source_health.note_rejected(memory, values[wheel_speed.SPEED], seen.innovation[0])
    return fused


@compiled
def _judge(
    state: FilterState,
    source: int,
    whitened: Vector3,
    m: int,
    same: bool,
    t_ns: int,
    correlation: float,
    params: Parameters,
) -> None:
    """Judge a source by its whitened innovation (m,). While rivals contend the others are not: nobody knows who is right.
    A receiver that was found to lie comes back when its readings are as good as the main state expects."""
    memory, stamps, model = state.memory[source], state.source_stamps[source], params.models[source]
    gnss = model in (GNSS_POSITION, GNSS_VELOCITY)
    if memory[EXCLUDED] != 0:
        if model == GNSS_VELOCITY:
            if source_health.is_due(stamps, t_ns, correlation):
                source_health.judge(memory, stamps, whitened, m, same, t_ns)
        elif rivals.fits_again(state, source, whitened, m, params):
            source_health.begin(memory)
        if source_health.odds_of_bias(memory) < rivals.BEGIN:
            memory[EXCLUDED] = 0.0
        return
    if not gnss and state.stamps[ALIVE] > 0:
        return
    if same and not source_health.is_trusted(memory):
        source_health.judge_repeated(memory, whitened, m)
        return
    wheel = model == WHEEL_SPEED and source_health.is_trusted(memory)
    if wheel and not carried(state, memory[LAST_SPEED], params) and rivals.wheels_contradict(state, params):
        rivals.suspect_motion(state, rivals.BEGIN)
        return
    if source_health.is_due(stamps, t_ns, correlation):
        source_health.judge(memory, stamps, whitened, m, same, t_ns)
    elif gnss:
        source_health.look(memory, whitened, m, same)


@compiled
def _weigh_rivals(
    state: FilterState,
    source: int,
    values: Vector,
    factor: float,
    weight: float,
    main: float,
    unread: float,
    gained: float,
    agrees: bool,
    params: Parameters,
) -> None:
    """Weigh and update the rivals by a reading, and weigh the one that calls its source a liar. `main` is the reading's
    likelihood under the main state, `unread` what it has on average where it is used, `gained` by what the source has become
    likelier to be biased, `agrees` whether the reading lies inside the main state's gate."""
    lie = gained if params.models[source] in (GNSS_POSITION, GNSS_VELOCITY) else rivals.SHARE_OF_LIAR
    shared = 0.0 if agrees else gained
    best, returned = _fuse_rivals(state, source, values, factor, weight, main, shared, params)
    lie = max(lie, returned)
    if not agrees:
        chance = rivals.SHARE_OF_LIAR * unread / main if main > 0 else 1.0
        lie = max(lie, max(chance, best))  # noqa: PLW3301 - of two, for the kernel
    rivals.weigh_liar(state, source, lie, params)


@compiled
def _fuse_rivals(
    state: FilterState,
    source: int,
    values: Vector,
    factor: float,
    weight: float,
    main: float,
    gained: float,
    params: Parameters,
) -> tuple[float, float]:
    """Weigh the rivals by a reading, whose likelihood under the main state is `main`, and update them. Where the health of a
    receiver made it likelier by `gained` that its velocity is biased against the main state, the inertial sensor's rival
    gains as much if it agrees with it. Returns the best likelihood of those that use it, and that of the one in which the
    receiver is right, over that of the main state: a lie explains no less."""
    best = returned = 0.0
    model, parameter = params.models[source], params.model_parameters[source]
    seen = Observation(state.size)
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    for slot in range(rivals.RIVALS):
        if state.bank[slot, 0] > 0:
            rival = state.hypothesis(slot)
            if not rivals.uses(state, slot, source, params) or not observe(rival, model, values, parameter, seen):
                continue
            project(rival, seen, across, spread)
            share_noise(rival, seen, parameter)
            if model == GNSS_POSITION:
                seen.m = HORIZONTAL
            for a in range(seen.m):
                seen.variance[a] *= factor
            prior = rivals.fit_lie(rival, seen, across, spread) if slot == rivals.INERTIAL else 1.0
            own = prior * rivals.likelihood(seen.innovation, seen.variance, weight, seen.m, spread)
            ratio, _fused = update_projected(
                rival, seen, params.gates[seen.m], weight, True, parameter[CLUTTER], across, spread, model == WHEEL_SPEED
            )
            if slot == rivals.INERTIAL and model == GNSS_VELOCITY and ratio <= 1:
                own = max(own, gained * main)
            if main > 0:
                best = max(best, own / main)
                if slot == rivals.RETURN and state.memory[source, EXCLUDED] == 0:
                    returned = own / main
            rivals.weigh(state, slot, own, main)
    return best, returned


@compiled
def _fuse_height(
    state: FilterState, source: int, values: Vector, stretch: float, elapsed: float, trusted: bool, params: Parameters
) -> None:
    """Fuse the height of a fix through a gate of its own: height and horizontal place may each be off alone. Its variance is
    `stretch` times the configured one. While it is rejected the own height becomes uncertain, until it fits."""
    parameter = params.model_parameters[source]
    seen = Observation(state.size)
    if not observe(state, GNSS_POSITION, values, parameter, seen):
        return
    share_noise(state, seen, parameter)
    seen.m = 1
    seen.jacobian[0] = seen.jacobian[2]
    seen.innovation[0], seen.common[0] = seen.innovation[2], seen.common[2]
    seen.variance[0] = seen.variance[2] * stretch
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(state, seen, across, spread)
    ratio, fused = update_projected(state, seen, params.gates[1], 1.0, trusted, parameter[CLUTTER], across, spread)
    if fused or not trusted or not ratio < math.inf:
        return
    grown = seen.innovation[0] * seen.innovation[0] / params.gates[1] * min(elapsed / DOUBT_TIME, 1.0)
    down = seen.jacobian[0, POSITION]
    for i in range(3):
        for j in range(3):
            state.covariance[POSITION.start + i, POSITION.start + j] += grown * (down[i] * down[j])


@compiled
def _suspect_receiver(state: FilterState, source: int, values: Vector, params: Parameters) -> None:
    """Begin the rival that does without a receiver where it may lie: its fixes have pulled the state no more than the rest
    of the vehicle allows."""
    if rivals.suspect_receiver(state, source, params) and params.models[source] == GNSS_POSITION:
        rival = state.hypothesis(rivals.RECEIVER)
        gnss_error.forget_prior(rival, source, values, params)


@compiled
def _suspect_state(state: FilterState, source: int, values: Vector, seen: Observation, params: Parameters) -> None:
    """Where a receiver that is called a liar may be right all the same, as likely as the state is wrong, begin the rival
    that is where it says. Where the receiver may not lie, it is the state that is called wrong."""
    if state.bank[rivals.RETURN, 0] > 0 or state.memory[source, EXCLUDED] != 0:
        return  # what an excluded one says was weighed when it was found to lie
    if state.bank[rivals.RECEIVER, 0] > 0:
        if state.stamps[SUSPECT] != source:
            return
        wrong = rivals.wrong(state, is_carried(state, params))
        odds = state.bank[rivals.RECEIVER, 0] * (wrong / (1 - wrong) / source_health.PRIOR_BIASED)
    elif rivals.may_lie(state, source, params):
        return
    else:
        odds = source_health.odds_of_bias(state.memory[source]) / 10
        state.stamps[SUSPECT] = source
    if odds < rivals.BEGIN * (1 + state.bank[rivals.RECEIVER, 0]):
        return
    rivals.open_slot(state, rivals.RETURN, odds)
    rival = state.hypothesis(rivals.RETURN)
    gnss_error.place(rival, source, values, seen, params)


@compiled
def _reset_offset(state: FilterState, seen: Observation) -> None:
    """Set the height offset, offset = reading - height, with the covariances that this gives it."""
    p, offset = state.covariance, HEIGHT_OFFSET_ERROR.start
    state.nominal[HEIGHT_OFFSET.start] += seen.innovation[0]
    p[offset] = 0.0
    p[:, offset] = 0.0
    cross = np.zeros(state.size)  # - H P
    for k in range(state.size):
        if seen.jacobian[0, k] != 0.0:
            cross += -seen.jacobian[0, k] * p[k]
    p[offset] = cross
    p[:, offset] = cross
    variance = seen.variance[0]
    for k in range(state.size):
        variance += -(cross[k] * seen.jacobian[0, k])
    p[offset, offset] = variance
