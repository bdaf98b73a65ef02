"""One event into the state: the state is carried to its instant, then it is held, fused, or gathered for the start.

One IMU drives the propagation. Between two of its samples angular rate and specific force are interpolated linearly, and
an interval is split exactly at a measurement's instant, so a measurement needs the IMU sample after it. Where that is
missing, or the two lie further apart than `imu_gap`, the state coasts.

`step` takes nearly every event, and runs compiled. What begins or ends a drive is `step_rarely`'s: the first event, a hole
in the data, a start from what was gathered, the first proof of a given heading, an IMU that is back after so long that the
heading may be lost. It needs the stored state of an earlier run, and runs in the interpreter.
"""

from __future__ import annotations

import math

from fusiond.filter import gnss_error, heading_bank, inertial_sample, initial_alignment, source_health
from fusiond.filter.hot_start import has_state
from fusiond.filter.inertial_delay import catch_up
from fusiond.filter.measurement import factor_of, fuse_measurement, remember
from fusiond.filter.motion_constraints import GNSS_FRESH_NS, carried, constrain, doubt_turn, rests, roll, watch
from fusiond.filter.observations import GNSS_POSITION, GNSS_VELOCITY, GNSS_YAW, IMU, WHEEL_SPEED, gnss_velocity
from fusiond.filter.parameters import Parameters
from fusiond.filter.rivals import RIVALS, close_all, mix
from fusiond.filter.rows import Outcome, Row, Rows
from fusiond.filter.state import (
    ALIGNING,
    ALIVE,
    ATTITUDE,
    BLOWN,
    CHOOSING,
    COASTING,
    EMPTY,
    FORCE_B,
    HELD_FORCE_B,
    HELD_RATE_B,
    HYPOTHESES,
    LAST_SPEED,
    NEVER,
    PHASE,
    POSITION_E,
    RATE_B,
    RATE_VARIANCE,
    RESETS,
    RUNNING,
    T_FIRST_VELOCITY,
    T_FUSED,
    T_IMU,
    T_LAST,
    T_POSITION,
    FilterState,
    ResetReason,
    T,
    count_reset,
    is_sound,
)
from fusiond.filter.strapdown import COAST_SWAY, COAST_TURN, add_white_noise, coast, end_coasting, propagate
from fusiond.maths.portable import square
from fusiond.maths.typed import Stamps, Vector, compiled

LOST_HEADING = math.radians(12.0)  # sigma, after coasting: the filter may not recover from such errors: it aligns again


@compiled
def step(state: FilterState, row: Row, imu: Row | None, params: Parameters) -> None:
    """Take an event into the state and write its outcome; `imu` is the first IMU event at or after it, if there is one. Only
    where `can_step`."""
    t_ns, source = int(row["t_ns"]), int(row["source"])
    _forget_judgement(row)
    if state.source_stamps[source, T_LAST] == t_ns:
        row["outcome"] = Outcome.DUPLICATE
        return
    row["outcome"] = Outcome.FUSED
    if state.stamps[PHASE] == ALIGNING:
        initial_alignment.gather_motion(state, row, params)
    elif state.stamps[PHASE] == CHOOSING:
        _choose(state, row, imu, params)
        guard(state)
    else:
        coasted = coasts(state, t_ns, params)
        advance_all(state, t_ns, imu, params)
        if params.models[source] == IMU:
            keep_sample(state, row, params)
            constrain(state, params)
        else:
            variance = yaw_variance(state) if coasted else 0.0
            lost = variance > square(LOST_HEADING)
            if not (_fuse_while_lost(state, row, params, variance) if lost else fuse_measurement(state, row, params)):
                row["outcome"] = Outcome.REJECTED
            if coasted and not lost:
                roll(state, params)
        guard(state)
    _name_gathered(state, row, params)
    state.source_stamps[source, T_LAST] = t_ns


@compiled
def can_step(state: FilterState, row: Row, params: Parameters) -> bool:
    """Whether `step` can take an event; if not, `step_rarely` must."""
    stamps, phase = state.stamps, int(state.stamps[PHASE])
    t_ns, model = int(row["t_ns"]), int(params.models[int(row["source"])])
    if phase == EMPTY or t_ns - stamps[T] > params.restart_gap_ns:
        return False
    if phase == ALIGNING:
        return model not in (GNSS_POSITION, GNSS_VELOCITY)
    if phase == RUNNING and stamps[T_FIRST_VELOCITY] == NEVER:
        values = row["values"]
        tells = model == GNSS_VELOCITY and initial_alignment.tells_course(values, values[gnss_velocity.VARIANCE], params)
        if tells or model == GNSS_YAW:
            return False
    if phase == RUNNING and model == IMU and coasts(state, t_ns, params):
        if not inertial_sample.is_believed(state, row["values"], t_ns, params):
            return True
        grown = square(COAST_TURN) * ((t_ns - stamps[T]) * 1e-9)
        return not yaw_variance(state) + grown > square(LOST_HEADING) / 2
    return True


def step_rarely(state: FilterState, row: Row, imu: Row | None, params: Parameters) -> None:
    """Take an event that begins or ends something into the state, and write its outcome."""
    t_ns, source, stamps = int(row["t_ns"]), int(row["source"]), state.stamps
    _forget_judgement(row)
    if state.source_stamps[source, T_LAST] == t_ns:
        row["outcome"] = Outcome.DUPLICATE
        return
    if stamps[PHASE] == EMPTY or t_ns - stamps[T] > params.restart_gap_ns:
        if stamps[PHASE] == RUNNING:
            count_reset(state, ResetReason.DATA_GAP)
        initial_alignment.begin(state)
    row["outcome"] = Outcome.FUSED
    if stamps[PHASE] == ALIGNING:
        initial_alignment.gather(state, row, params)
    elif params.models[source] != IMU:
        _prove_heading(state, row, imu, params)
    else:  # the IMU is back
        advance_all(state, t_ns, imu, params)
        if yaw_variance(state) > square(LOST_HEADING) and _heard_gnss(state, params):
            count_reset(state, ResetReason.HEADING_LOST)
            initial_alignment.begin(state)
            initial_alignment.gather(state, row, params)
        else:
            keep_sample(state, row, params)
            constrain(state, params)
        guard(state)
    _name_gathered(state, row, params)
    state.source_stamps[source, T_LAST] = t_ns


def _prove_heading(state: FilterState, row: Row, imu: Row | None, params: Parameters) -> None:
    """Take a measurement that may confirm a heading that was only given. One that contradicts it drops it, and the filter
    aligns anew."""
    step(state, row, imu, params)
    if params.models[int(row["source"])] == GNSS_YAW:
        agrees = row["outcome"] == Outcome.FUSED
        if agrees:
            state.stamps[T_FIRST_VELOCITY] = state.stamps[T]
    else:
        agrees = initial_alignment.prove(state, row["values"], params)
    if not agrees:
        count_reset(state, ResetReason.HEADING_DECIDED)
        initial_alignment.begin(state)
        initial_alignment.gather(state, row, params)


def begin_session(state: FilterState) -> None:
    """Begin anew on a time line that has stepped back: keep biases, calibrations and counts, and align."""
    if state.stamps[PHASE] == RUNNING:
        count_reset(state, ResetReason.TIME_STEPPED_BACK)
    initial_alignment.begin(state)
    state.bank[:] = 0.0


def _heard_gnss(state: FilterState, params: Parameters) -> bool:
    """Whether GNSS velocities came until the IMU fell silent, and so will again: without them an alignment would not end."""
    return any(state.stamps[T_IMU] - state.source_stamps[i, T_LAST] <= GNSS_FRESH_NS for i in params.velocities)


@compiled
def _forget_judgement(row: Row) -> None:
    """Clear what an earlier run of the event has written."""
    row["ratio"] = 0.0
    row["innovation"][:] = 0.0
    row["variance"][:] = 0.0


@compiled
def _name_gathered(state: FilterState, row: Row, params: Parameters) -> None:
    """What was taken in is not fused where there is no state that it went into."""
    if row["outcome"] == Outcome.FUSED and not has_state(state, params):
        row["outcome"] = Outcome.GATHERED


@compiled
def _fuse_while_lost(state: FilterState, row: Row, params: Parameters, variance: float) -> bool:
    """Fuse a measurement when the heading, of so much variance after coasting, is lost. It may correct position and
    velocity; what it says of a heading that is so far off is not to be relied on. When the IMU is back, an alignment finds
    it. Returns whether it was fused."""
    fused = fuse_measurement(state, row, params)
    gained = variance - yaw_variance(state)
    if gained > 0:
        r, phi = state.nominal[POSITION_E], ATTITUDE.start
        gained /= r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        for i in range(3):
            for j in range(3):
                state.covariance[phi + i, phi + j] += r[i] * r[j] * gained
    return fused


@compiled
def coasts(state: FilterState, t_ns: int, params: Parameters) -> bool:
    """Whether the IMU has been silent for longer than `imu_gap` at an instant, so that the state coasts."""
    return t_ns - state.stamps[T_IMU] > params.imu_gap_ns


@compiled
def is_final(state: FilterState, source: int, params: Parameters) -> bool:
    """Whether no IMU sample still to come can change the state after an event of `source`: it is an IMU sample itself, or
    the state coasts."""
    return params.models[source] == IMU or coasts(state, state.stamps[T], params)


@compiled
def yaw_variance(state: FilterState) -> float:
    """Of the attitude about the vertical [rad^2]."""
    r, phi = state.nominal[POSITION_E], ATTITUDE.start
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += r[i] * state.covariance[phi + i, phi + j] * r[j]
    return total / (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])


@compiled
def advance_all(state: FilterState, t_ns: int, imu: Row | None, params: Parameters) -> None:
    """Carry the state and its rivals to `t_ns`."""
    begin = int(state.stamps[T])
    advance(state, t_ns, imu, params)
    if state.stamps[ALIVE] > 0 and state.auxiliary[COASTING] != 0:
        close_all(state)  # they share one angular rate, which is estimated now
    if state.stamps[ALIVE] > 0:
        for slot in range(RIVALS):
            if state.bank[slot, 0] > 0:
                state.stamps[T] = begin
                rival = state.hypothesis(slot)
                advance(rival, t_ns, imu, params)
        state.stamps[T] = max(begin, t_ns)


@compiled
def advance(state: FilterState, t_ns: int, imu: Row | None, params: Parameters) -> None:
    """Carry the state to `t_ns`, on the IMU samples around it: the held one and `imu`, the next."""
    stamps, a = state.stamps, state.auxiliary
    begin, held = int(stamps[T]), int(stamps[T_IMU])
    if t_ns <= begin:
        return
    dt = (t_ns - begin) * 1e-9
    stamps[T] = t_ns
    frozen = not source_health.is_trusted(state.memory[params.imu_source])
    if imu is None or held == NEVER or imu["t_ns"] - held > params.imu_gap_ns or frozen:
        coast(state, dt, params.noise, rests(state, params))
        a[RATE_VARIANCE] = COAST_SWAY * COAST_SWAY
        return
    sample, until = imu["values"], int(imu["t_ns"])
    believed = inertial_sample.is_believed(state, sample, until, params)
    accel, gyro = inertial_sample.doubt(state, sample, t_ns, until, believed, params)
    span = float(until - held)
    middle = end = 0.0  # the held sample alone
    if believed:
        middle = float((begin - held) + (t_ns - held)) / 2 / span
        end = float(t_ns - held) / span
    force_change, rate_change = sample[0:3] - a[HELD_FORCE_B], sample[3:6] - a[HELD_RATE_B]
    force_b, rate_b = a[HELD_FORCE_B] + middle * force_change, a[HELD_RATE_B] + middle * rate_change
    a[FORCE_B] = a[HELD_FORCE_B] + end * force_change
    a[RATE_B] = a[HELD_RATE_B] + end * rate_change
    a[RATE_VARIANCE] = params.noise.gyro / (span * 1e-9) * ((1 - end) * (1 - end) + end * end)
    propagate(state, dt, force_b, rate_b, params.noise)
    if believed:
        share = float(t_ns - begin) / span
        catch_up(state, share * force_change, share * rate_change)
    if accel > 0:
        add_white_noise(state.covariance, dt, accel, gyro)
        a[RATE_VARIANCE] += gyro / (span * 1e-9)


@compiled
def predict(state: FilterState, t_ns: int, params: Parameters) -> None:
    """Carry the state beyond the newest IMU sample, on that sample for at most `imu_gap`, then coasting; where there are
    rivals, make it the mixture's. For publication and then thrown away."""
    stamps = state.stamps
    begin = int(stamps[T])
    if stamps[PHASE] != RUNNING:
        return
    _predict(state, t_ns, params)
    if stamps[ALIVE] > 0:
        for slot in range(RIVALS):
            if state.bank[slot, 0] > 0:
                stamps[T] = begin
                rival = state.hypothesis(slot)
                _predict(rival, t_ns, params)
        mix(state, params.estimate)


@compiled
def _predict(state: FilterState, t_ns: int, params: Parameters) -> None:
    stamps, a = state.stamps, state.auxiliary
    begin = int(stamps[T])
    if t_ns <= begin:
        return
    until = max(begin, min(t_ns, int(stamps[T_IMU] + params.imu_gap_ns)))
    if not source_health.is_trusted(state.memory[params.imu_source]):
        until = begin
    if until > begin:
        propagate(state, (until - begin) * 1e-9, a[HELD_FORCE_B], a[HELD_RATE_B], params.noise)
    if t_ns > until:
        coast(state, (t_ns - until) * 1e-9, params.noise, rests(state, params))
    stamps[T] = t_ns


@compiled
def _choose(state: FilterState, row: Row, imu: Row | None, params: Parameters) -> None:
    """Take one event into every hypothesis of the bank."""
    stamps, source, t_ns = state.stamps, int(row["source"]), int(row["t_ns"])
    begin, model, values = int(stamps[T]), int(params.models[source]), row["values"]
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            stamps[T] = begin
            hypothesis = state.hypothesis(i)
            advance(hypothesis, t_ns, imu, params)
    stamps[T] = max(begin, t_ns)
    if model == IMU:
        keep_sample(state, row, params)
        heading_bank.constrain(state, params)
        return
    memory, own, parameter = state.memory[source], state.source_stamps[source], params.model_parameters[source]
    source_health.arrive(memory, own, values, t_ns)
    remember(memory, model, values)
    if model == WHEEL_SPEED and carried(state, memory[LAST_SPEED], params):
        row["outcome"] = Outcome.REJECTED
        return
    factor = factor_of(own, model, values, parameter, t_ns)
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            if model == GNSS_POSITION:
                hypothesis = state.hypothesis(i)
                gnss_error.carry(hypothesis, source, values, params)
            heading_bank.fuse_measurement(state, i, model, values, parameter, factor, params)
    own[T_FUSED] = t_ns
    if model == GNSS_POSITION:
        gnss_error.note(state, source, values, params)
        stamps[T_POSITION] = t_ns
    heading_bank.collapse_if_close(state, params)


@compiled
def keep_sample(state: FilterState, row: Row, params: Parameters) -> None:
    """Judge an IMU sample; if it is believed, make it the held one, and let it show standstill."""
    stamps, a, t_ns = state.stamps, state.auxiliary, int(row["t_ns"])
    dt = (t_ns - stamps[T_IMU]) * 1e-9 if stamps[T_IMU] != NEVER else 0.0
    memory, own = state.memory[params.imu_source], state.source_stamps[params.imu_source]
    trusted, believed = source_health.is_trusted(memory), inertial_sample.judge(state, row, params)
    source_health.arrive(memory, own, row["values"], t_ns)
    inertial_sample.judge_sensor(state, row["values"], t_ns, params)
    if not (believed and trusted and source_health.is_trusted(memory)):
        row["outcome"] = Outcome.REJECTED
        return
    end_coasting(state)
    hold(state, row["values"], t_ns)
    a[RATE_VARIANCE] = params.noise.gyro / max(dt, inertial_sample.MIN_SPAN) if dt > 0 else 0.0
    watch(state, a[HELD_FORCE_B], a[HELD_RATE_B], dt, params)
    doubt_turn(state, a[HELD_RATE_B], dt, params)


@compiled
def hold(state: FilterState, values: Vector, t_ns: int) -> None:
    """Make an inertial sample the held one, at the state's instant. While the state coasts all the same, the angular rate is
    not the sample's."""
    a = state.auxiliary
    state.stamps[T_IMU] = t_ns
    for i in range(3):
        a[HELD_FORCE_B.start + i] = a[FORCE_B.start + i] = values[i]
        a[HELD_RATE_B.start + i] = values[3 + i]
        if a[COASTING] == 0.0:
            a[RATE_B.start + i] = values[3 + i]


@compiled
def guard(state: FilterState) -> None:
    """If the state is no longer sound, or no hypothesis is left, empty it and align again. Never expected; counted."""
    if state.stamps[PHASE] == CHOOSING:
        for i in range(HYPOTHESES):
            if state.bank[i, 0] > 0:
                return
    elif is_sound(state):
        return
    resets, blown = int(state.stamps[RESETS]), int(state.stamps[BLOWN])
    state.clear()
    state.stamps[RESETS], state.stamps[BLOWN] = resets, blown + 1
    count_reset(state, ResetReason.NOT_FINITE)


# --- The table of events


@compiled
def place(rows: Rows, begin: int, end: int, t_ns: int, source: int, sequence: int) -> int:
    """Where, counted from `begin`, an event goes among the rows begin..end; if its very key is there already in row i,
    ~i, which is negative. Most events are new, so the search begins at the end."""
    i = end
    while i > begin:
        row = rows[i - 1]
        if row["t_ns"] < t_ns:
            break
        if row["t_ns"] == t_ns:
            if row["source"] < source:
                break
            if row["source"] == source:
                if row["sequence"] == sequence:
                    return ~(i - 1 - begin)
                if row["sequence"] < sequence:
                    break
        i -= 1
    return i - begin


@compiled
def first_changed(rows: Rows, begin: int, new: int, params: Parameters) -> int:
    """The first row whose result a new event at row `new` changes: itself, but for an IMU sample all that interpolate
    between it and the sample before it, so not those at that sample's own instant."""
    i = begin + new
    if params.models[int(rows[i]["source"])] != IMU:
        return new
    while i > begin and params.models[int(rows[i - 1]["source"])] != IMU:
        i -= 1
    while begin < i < begin + new and rows[i]["t_ns"] == rows[i - 1]["t_ns"]:
        i += 1
    return i - begin


def run_one(state: FilterState, rows: Rows, index: int, counts: Stamps, params: Parameters) -> int:
    """Apply one row, and correct the counts (sources, outcomes) if its outcome changed. Returns the index of the next."""
    row, following = rows[index], index
    while following < len(rows) and params.models[rows[following]["source"]] != IMU:
        following += 1
    before, imu = int(row["outcome"]), rows[following] if following < len(rows) else None
    (step if can_step(state, row, params) else step_rarely)(state, row, imu, params)
    if row["outcome"] != before:
        counts[row["source"], before] -= 1
        counts[row["source"], row["outcome"]] += 1
    return index + 1
