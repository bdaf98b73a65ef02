"""The hot loop: runs the filter over a stretch of events in their order of time. Plain arrays in, plain arrays out.

This is the NumPy twin of the compiled `fusiond._kernel`: the same functions, by which tests hold it, and what runs where
no compiler was found. `make_kernel` picks one.

One IMU drives the propagation. Between two of its samples angular rate and specific force are interpolated linearly, and
an interval is split exactly at a measurement's instant, so a measurement needs the IMU sample after it. Where that is
missing, or the two lie further apart than `imu_gap`, the state coasts.
"""

from __future__ import annotations

import math
from enum import IntEnum
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond import alignment, bank, health
from fusiond.earth import Array, mat_ne
from fusiond.motion import carried, constrain, watch
from fusiond.observe import MODELS, gnss_velocity, wheel_speed
from fusiond.observe.model import (
    CLUTTER,
    COMPANION,
    CORRELATION,
    NOISE_LEAST,
    NOISE_MOST,
    SHARED,
    VALUES,
    Observation,
    with_rate_noise,
)
from fusiond.plan import IMU, MODEL, Plan
from fusiond.state import (
    BLOWN,
    CHOOSING,
    EMPTY,
    FORCE_B,
    HEIGHT_OFFSET,
    HEIGHT_OFFSET_ERROR,
    HELD_FORCE_B,
    HELD_RATE_B,
    LAST_RATIO,
    LAST_VALUE,
    NEVER,
    PHASE,
    POSITION,
    POSITION_E,
    RATE_B,
    RATE_VARIANCE,
    RESETS,
    RUNNING,
    T_ALIKE,
    T_BACK,
    T_FUSED,
    T_IMU,
    T_LAST,
    T_POSITION,
    T_REJECTED,
    VELOCITY,
    VELOCITY_E,
    WIDE_SIZE,
    FilterState,
    T,
)
from fusiond.strapdown import coast, propagate
from fusiond.update import correlation_factor, update, whiten


class Outcome(IntEnum):
    """What became of an event. FUSED: taken into the state, be it as a measurement or to align. REJECTED: stopped by the
    innovation gate. TOO_OLD: stamped before the horizon. DUPLICATE: a second event of a source at one instant. INVALID:
    declared unusable by its protocol, not finite, or out of bounds. WAITING: stamped after the newest IMU sample."""

    FUSED = 0
    REJECTED = 1
    TOO_OLD = 2
    DUPLICATE = 3
    INVALID = 4
    WAITING = 5


ROW = np.dtype(
    [
        ("t_ns", "i8"),
        ("sequence", "i8"),
        ("t_receive_ns", "i8"),
        ("source", "i4"),
        ("outcome", "i4"),
        ("ratio", "f8"),  # test ratio, 1 at the gate; 0 before it was judged
        ("values", "f8", (VALUES,)),
        ("innovation", "f8", (3,)),
        ("variance", "f8", (3,)),  # of the innovation, diagonal
    ]
)
Rows = NDArray[Any]  # structured, of dtype ROW

LEAST_SPAN = 1e-4  # s: two inertial samples are not taken as closer
BREAK_NS = 5_000_000_000  # rejections further apart are not of one row
OUTAGE_NS = 10_000_000_000  # a source silent for longer comes back anew, and is new for as long
SUSPECT = 6  # times gnss_reset_s, where the receiver's motion is in question
RESETTABLE = {  # what a source resets that was rejected for too long: error states and nominal states
    MODEL["gnss_position"]: (POSITION, POSITION_E),
    MODEL["gnss_velocity"]: (VELOCITY, VELOCITY_E),
    MODEL["barometric_height"]: (HEIGHT_OFFSET_ERROR, HEIGHT_OFFSET),
}
NEAR = 9.0  # test ratio up to which a fix after an outage is believed soon


class Kernel:
    """The operations of the hot loop for one plan, on the memory that `attach` gives it. The history decides what to do
    when; this does it."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan

    def attach(
        self,
        head: FilterState,
        table: Rows,
        counts: NDArray[np.int64],
        kept_numbers: Array,
        kept_whole: NDArray[np.int64],
        kept_applied: NDArray[np.int64],
    ) -> None:
        """Work on this memory from now on: the head state, the table of events, the counts (sources, outcomes), and the
        snapshots: numbers, stamps and number of rows applied, one snapshot a row."""
        self.head, self.table, self.counts = head, table, counts
        self.kept_numbers, self.kept_whole, self.kept_applied = kept_numbers, kept_whole, kept_applied

    def propagate(self, state: FilterState, dt: float, force_b: Array, rate_b: Array) -> None:
        """One strapdown propagation over dt [s] (fusiond.strapdown.propagate)."""
        propagate(state, dt, force_b, rate_b, self.plan.noise)

    def predict(self, state: FilterState, t_ns: int) -> None:
        predict(state, t_ns, self.plan)

    def place(self, begin: int, end: int, t_ns: int, source: int, sequence: int) -> int:
        """Where, counted from `begin`, an event goes among the rows begin..end; if its very key is there already in row i,
        ~i, which is negative. Most events are new, so the search begins at the end."""
        i, key = end, (t_ns, source, sequence)
        while i > begin:
            row = self.table[i - 1]
            before = int(row["t_ns"]), int(row["source"]), int(row["sequence"])
            if before == key:
                return ~(i - 1 - begin)
            if before < key:
                break
            i -= 1
        return i - begin

    def insert(
        self,
        at: int,
        end: int,
        t_ns: int,
        source: int,
        sequence: int,
        t_receive_ns: int,
        outcome: int,
        values: tuple[float, ...],
    ) -> None:
        """Shift the rows at..end up by one, write an event into the gap, and count its outcome."""
        self.table[at + 1 : end + 1] = self.table[at:end]
        row = np.zeros((), dtype=ROW)
        row["t_ns"], row["source"], row["sequence"], row["t_receive_ns"] = t_ns, source, sequence, t_receive_ns
        row["outcome"] = outcome
        row["values"][: len(values)] = values
        self.table[at] = row
        self.counts[source, outcome] += 1

    def first_changed(self, begin: int, place: int) -> int:
        """The first row whose result a new event at row `place` changes: itself, but for an IMU sample all that
        interpolate between it and the sample before it, so not those at that sample's own instant."""
        models, table = self.plan.models, self.table
        i = begin + place
        if models[table[i]["source"]] != IMU:
            return place
        while i > begin and models[table[i - 1]["source"]] != IMU:
            i -= 1
        while begin < i < begin + place and table[i]["t_ns"] == table[i - 1]["t_ns"]:
            i += 1
        return i - begin

    def offer(
        self,
        begin: int,
        end: int,
        t_ns: int,
        source: int,
        sequence: int,
        t_receive_ns: int,
        values: tuple[float, ...],
    ) -> int:
        """Insert an event where it belongs among the rows begin..end, as waiting. Returns the first row, counted from
        `begin`, that it changes; a negative number if its very key is there already."""
        place = self.place(begin, end, t_ns, source, sequence)
        if place < 0:
            return place
        self.insert(begin + place, end, t_ns, source, sequence, t_receive_ns, Outcome.WAITING, values)
        return self.first_changed(begin, place)

    def restore(self, kept: int) -> None:
        """Copy the last of the snapshots ..kept into the head."""
        self.head.numbers[:], self.head.whole[:] = self.kept_numbers[kept - 1], self.kept_whole[kept - 1]

    def run(self, begin: int, end: int, applied: int, limit_ns: int, kept: int) -> tuple[int, int, bool]:
        """Apply to the head the rows from `applied` on (counted from `begin`) up to `limit_ns`, and keep snapshots.

        Returns the rows applied, the snapshots kept, and whether it is done. If not, it wants memory for snapshots, or the
        next row is one that only `run_one` can apply (the compiled kernel leaves alignment and models in Python to it).
        """
        rows, plan = self.table[begin:end], self.plan
        while applied < len(rows) and rows[applied]["t_ns"] <= limit_ns:
            if kept == len(self.kept_applied):
                return applied, kept, False
            applied = run_one(self.head, rows, applied, self.counts, plan)
            kept = keep(self.head, rows, applied, plan, (self.kept_numbers, self.kept_whole, self.kept_applied), kept)
        return applied, kept, True


def keep(
    head: FilterState,
    rows: Rows,
    applied: int,
    plan: Plan,
    memory: tuple[Array, NDArray[np.int64], NDArray[np.int64]],
    kept: int,
) -> int:
    """Keep the head in row `kept` of `memory` if a snapshot is due after `applied` rows, and lasts. Returns the number
    of snapshots kept."""
    numbers, whole, counts = memory
    due = head.stamps[T] - whole[kept - 1, T] >= plan.snapshot_interval_ns
    if not due or not settles(head, int(rows[applied - 1]["source"]), plan):
        return kept
    numbers[kept], whole[kept], counts[kept] = head.numbers, head.whole, applied
    return kept + 1


def settles(state: FilterState, source: int, plan: Plan) -> bool:
    """Whether no IMU sample still to come can change the state after an event of `source`: it is an IMU sample itself, or
    the IMU has been silent for so long that the state coasts."""
    return plan.models[source] == IMU or bool(state.stamps[T] - state.stamps[T_IMU] > plan.imu_gap_ns)


def run_one(state: FilterState, rows: Rows, index: int, counts: NDArray[np.int64], plan: Plan) -> int:
    """Apply one row, and correct the counts if its outcome changed. Returns the index of the next."""
    row, following = rows[index], index
    while following < len(rows) and plan.models[rows[following]["source"]] != IMU:
        following += 1
    before = int(row["outcome"])
    step(state, rows, index, following, plan)
    if row["outcome"] != before:
        counts[row["source"], before] -= 1
        counts[row["source"], row["outcome"]] += 1
    return index + 1


def step(state: FilterState, rows: Rows, index: int, following_imu: int, plan: Plan) -> None:
    """Take event `index` of `rows` into the state and write its outcome; `following_imu` is the index of the first IMU
    event at or after it, or len(rows)."""
    row = rows[index]
    t_ns, source, values = int(row["t_ns"]), int(row["source"]), row["values"]
    row["ratio"], row["innovation"], row["variance"] = 0.0, 0.0, 0.0  # of an earlier run
    if state.source_stamps[source, T_LAST] == t_ns:
        row["outcome"] = Outcome.DUPLICATE
        return
    stamps = state.stamps
    if stamps[PHASE] == EMPTY or t_ns - stamps[T] > plan.restart_gap_ns:
        if stamps[PHASE] == RUNNING:
            stamps[RESETS] += 1
        alignment.begin(state)
    row["outcome"] = Outcome.FUSED
    if stamps[PHASE] == CHOOSING:
        _choose(state, row, rows[following_imu] if following_imu < len(rows) else None, plan)
    elif stamps[PHASE] != RUNNING:
        alignment.gather(state, t_ns, source, values, plan)
    else:
        advance(state, t_ns, rows[following_imu] if following_imu < len(rows) else None, plan)
        if plan.models[source] == IMU:
            _hold(state, t_ns, values, plan)
        else:
            _measure(state, row, plan)
        guard(state)
    state.source_stamps[source, T_LAST] = t_ns


def advance(state: FilterState, t_ns: int, imu: Any | None, plan: Plan) -> None:
    """Carry the state to `t_ns`, on the IMU samples around it: the held one and `imu`, the next."""
    stamps, auxiliary = state.stamps, state.auxiliary
    begin = int(stamps[T])
    if t_ns <= begin:
        return
    dt = (t_ns - begin) * 1e-9
    held = int(stamps[T_IMU])
    stamps[T] = t_ns
    frozen = not health.is_trusted(state.memory[plan.imu_source])
    if imu is None or held == NEVER or imu["t_ns"] - held > plan.imu_gap_ns or frozen:
        coast(state, dt, plan.noise)
        return
    span = float(imu["t_ns"] - held)
    middle = ((begin - held) + (t_ns - held)) / 2 / span
    end = (t_ns - held) / span
    sample = imu["values"]
    force_0, rate_0 = auxiliary[HELD_FORCE_B], auxiliary[HELD_RATE_B]
    force_change, rate_change = sample[0:3] - force_0, sample[3:6] - rate_0
    propagate(state, dt, force_0 + middle * force_change, rate_0 + middle * rate_change, plan.noise)
    auxiliary[FORCE_B] = force_0 + end * force_change
    auxiliary[RATE_B] = rate_0 + end * rate_change
    auxiliary[RATE_VARIANCE] = plan.noise.gyro / (span * 1e-9) * ((1 - end) * (1 - end) + end * end)


def predict(state: FilterState, t_ns: int, plan: Plan) -> None:
    """Carry the state beyond the newest IMU sample, on that sample for at most `imu_gap`, then coasting. For publication
    and then thrown away."""
    stamps, auxiliary = state.stamps, state.auxiliary
    begin = int(stamps[T])
    if t_ns <= begin or stamps[PHASE] != RUNNING:
        return
    carried = max(begin, min(t_ns, int(stamps[T_IMU]) + plan.imu_gap_ns))
    if not health.is_trusted(state.memory[plan.imu_source]):
        carried = begin
    if carried > begin:
        propagate(state, (carried - begin) * 1e-9, auxiliary[HELD_FORCE_B], auxiliary[HELD_RATE_B], plan.noise)
    if t_ns > carried:
        coast(state, (t_ns - carried) * 1e-9, plan.noise)
    stamps[T] = t_ns


def _choose(state: FilterState, row: Any, imu: Any | None, plan: Plan) -> None:
    """Take one event into every hypothesis of the bank."""
    stamps, source, t_ns = state.stamps, int(row["source"]), int(row["t_ns"])
    begin, model, values = stamps[T], plan.models[source], row["values"]
    for i in bank.alive(state):
        stamps[T] = begin
        advance(state.hypothesis(i), t_ns, imu, plan)
    stamps[T] = max(begin, t_ns)
    if model == IMU:
        _keep_sample(state, t_ns, values, plan)
        bank.constrain(state, plan)
        return
    memory, own, parameters = state.memory[source], state.source_stamps[source], plan.parameters[source]
    health.arrive(memory, own, values, t_ns)
    remember(memory, model, values)
    if model == MODEL["wheel_speed"] and carried(state, memory[LAST_VALUE], plan):
        row["outcome"] = Outcome.REJECTED
        return
    factor = _factor(own, model, values, parameters, t_ns)
    for i in bank.alive(state):
        hypothesis = state.hypothesis(i)
        seen = MODELS[model].observe(hypothesis, values, parameters)
        assert seen is not None, "a source's model always observes"
        seen, certain = _shared(hypothesis, seen, parameters), None
        if model == MODEL["wheel_speed"]:
            certain = _shared(hypothesis, wheel_speed.observe(hypothesis, values, parameters, certain=True), parameters)
        bank.take(state, i, hypothesis, seen, plan.gates[len(seen.innovation)], factor, certain)
    own[T_FUSED] = t_ns
    if model == MODEL["gnss_position"]:
        stamps[T_POSITION] = t_ns
    bank.settle(state, plan)


def _shared(state: FilterState, seen: Observation, parameters: Array) -> Observation:
    """An observation with what it shares with others of its group, and with the gyro's noise on the lever arm."""
    return with_rate_noise(state, seen._replace(variance=seen.variance * parameters[SHARED]))


def remember(memory: Array, model: int, values: Array) -> None:
    """What the motion detector wants to know of a source's last reading."""
    if model == MODEL["wheel_speed"]:
        memory[LAST_VALUE] = values[wheel_speed.SPEED]
    elif model == MODEL["gnss_velocity"]:
        memory[LAST_VALUE] = gnss_velocity.least_speed(values)


def _factor(stamps: NDArray[np.int64], model: int, values: Array, parameters: Array, t_ns: int) -> float:
    """How much less a reading is worth because its error is like that of the one before."""
    interval = (t_ns - int(stamps[T_FUSED])) * 1e-9 if stamps[T_FUSED] != NEVER else math.inf
    return correlation_factor(interval, correlation(model, values, parameters))


def correlation(model: int, values: Array, parameters: Array) -> float:
    """Time [s] over which a reading's error stays alike."""
    return float(values[wheel_speed.ALIKE] if model == MODEL["wheel_speed"] else parameters[CORRELATION])


def _hold(state: FilterState, t_ns: int, values: Array, plan: Plan) -> None:
    """Make an IMU sample the held one, and apply the constraints that are due."""
    _keep_sample(state, t_ns, values, plan)
    constrain(state, plan)


def _keep_sample(state: FilterState, t_ns: int, values: Array, plan: Plan) -> None:
    """Make an IMU sample the held one; let it tell of standstill."""
    stamps, auxiliary = state.stamps, state.auxiliary
    dt = (t_ns - int(stamps[T_IMU])) * 1e-9 if stamps[T_IMU] != NEVER else 0.0
    memory, own = state.memory[plan.imu_source], state.source_stamps[plan.imu_source]
    same, _ = health.arrive(memory, own, values, t_ns)
    health.judge_repetition(memory, own, same, t_ns)
    stamps[T_IMU] = t_ns
    auxiliary[RATE_VARIANCE] = plan.noise.gyro / max(dt, LEAST_SPAN) if dt > 0 else 0.0
    auxiliary[HELD_FORCE_B] = auxiliary[FORCE_B] = values[0:3]
    auxiliary[HELD_RATE_B] = auxiliary[RATE_B] = values[3:6]
    watch(state, values[0:3], values[3:6], dt, plan)


def _measure(state: FilterState, row: Any, plan: Plan) -> None:
    """Judge and fuse one measurement at the state's own instant."""
    source, t_ns = int(row["source"]), int(row["t_ns"])
    model, values = plan.models[source], row["values"]
    parameters, memory, stamps = plan.parameters[source], state.memory[source], state.source_stamps[source]
    same, elapsed = health.arrive(memory, stamps, values, t_ns)
    remember(memory, model, values)
    seen = MODELS[model].observe(state, values, parameters)
    assert seen is not None, "a source's model always observes"
    m = len(seen.innovation)
    predicted = np.einsum("ij,jk,ik->i", seen.jacobian, state.covariance, seen.jacobian)
    given = _shared(state, seen, parameters).variance
    learnt = given * health.noise_factor(memory, parameters[NOISE_LEAST], parameters[NOISE_MOST])
    row["innovation"][:m], row["variance"][:m] = seen.innovation, predicted + learnt
    factor = _factor(stamps, model, values, parameters, t_ns)
    if stamps[T_LAST] == NEVER or t_ns - int(stamps[T_LAST]) > OUTAGE_NS:
        stamps[T_FUSED], stamps[T_BACK] = NEVER, t_ns
        health.begin(memory)
    known = stamps[T_FUSED] != NEVER and health.tells(predicted, learnt)
    if known and health.is_due(stamps, t_ns, correlation(model, values, parameters)):
        whitened = whiten(state, seen._replace(variance=learnt))
        if whitened is not None:
            health.judge(memory, stamps, health.Judgement(whitened, same, t_ns))
    health.learn(memory, (seen.innovation, given), predicted, elapsed)
    companion = int(parameters[COMPANION])
    trusted = health.is_trusted(memory) and (companion < 0 or health.is_trusted(state.memory[companion]))
    trusted = trusted and not (model == MODEL["wheel_speed"] and carried(state, memory[LAST_VALUE], plan))
    seen = seen._replace(variance=learnt * health.noisy_factor(memory))
    ratio, fused = update(state, seen, plan.gates[m], factor, trusted, float(parameters[CLUTTER]))
    row["ratio"] = memory[LAST_RATIO] = ratio
    if not fused and model in RESETTABLE and _locked_out(state, source, seen, t_ns, plan):
        _reset_block(state, seen, model)
        health.begin(memory)
        fused = True
    if fused:
        stamps[T_REJECTED] = stamps[T_ALIKE] = NEVER
        stamps[T_FUSED] = t_ns
        if model == MODEL["gnss_position"]:
            state.stamps[T_POSITION] = t_ns
        return
    row["outcome"] = Outcome.REJECTED
    if stamps[T_REJECTED] == NEVER:
        stamps[T_REJECTED] = t_ns


def _locked_out(state: FilterState, source: int, seen: Observation, t_ns: int, plan: Plan) -> bool:
    """Whether a GNSS source has been rejected for so long, off alike all the time, that the state is the more likely
    culprit: soon after an outage; later otherwise; and much later for a velocity, or a position whose velocity is not
    trusted, because the rest of the vehicle then contradicts the receiver's motion, as in a drift-off."""
    memory, stamps = state.memory[source], state.source_stamps[source]
    gate = plan.gates[len(seen.innovation)]
    off = health.moved(memory, seen.innovation, seen.variance, gate)
    if off or stamps[T_ALIKE] == NEVER or t_ns - int(stamps[T_LAST]) > BREAK_NS:
        stamps[T_ALIKE] = t_ns
        return False
    wait = plan.gnss_reset_ns
    companion = int(plan.parameters[source, COMPANION])
    returns = stamps[T_FUSED] == NEVER or stamps[T_ALIKE] - stamps[T_BACK] <= OUTAGE_NS
    if returns and memory[LAST_RATIO] <= NEAR:
        wait = plan.gnss_return_ns
    elif source in plan.velocities or (companion >= 0 and not health.is_trusted(state.memory[companion])):
        wait = SUSPECT * wait
    return t_ns - int(stamps[T_ALIKE]) >= wait


def _reset_block(state: FilterState, seen: Observation, model: int) -> None:
    """Put position or velocity where the receiver says, with the receiver's uncertainty, and count the jump. A barometer
    puts its own offset where the height says: that is no jump."""
    block, nominal = RESETTABLE[model]
    if model == MODEL["barometric_height"]:
        _reset_offset(state, seen)
        return
    to_n = mat_ne(state.nominal[POSITION_E])
    axes = len(seen.innovation)
    state.nominal[nominal] += to_n[:axes].T @ seen.innovation
    spread = to_n @ state.covariance[block, block] @ to_n.T
    spread[:axes, :] = spread[:, :axes] = 0.0
    spread[:axes, :axes] = np.diag(seen.variance)
    state.covariance[block, :] = 0.0
    state.covariance[:, block] = 0.0
    state.covariance[block, block] = to_n.T @ spread @ to_n
    state.stamps[RESETS] += 1


def _reset_offset(state: FilterState, seen: Observation) -> None:
    """The height offset (1,) anew, offset = reading - height, with the covariances that this gives it."""
    state.nominal[HEIGHT_OFFSET] += seen.innovation
    state.covariance[HEIGHT_OFFSET_ERROR, :] = state.covariance[:, HEIGHT_OFFSET_ERROR] = 0.0
    cross = -seen.jacobian @ state.covariance
    state.covariance[HEIGHT_OFFSET_ERROR, :] = cross
    state.covariance[:, HEIGHT_OFFSET_ERROR] = cross.T
    state.covariance[HEIGHT_OFFSET_ERROR, HEIGHT_OFFSET_ERROR] = -cross @ seen.jacobian.T + seen.variance


def guard(state: FilterState) -> None:
    """If the state is no longer finite, empty it and align anew. Never expected; counted where it happens."""
    if np.isfinite(state.nominal).all() and np.isfinite(np.diag(state.covariance)).all():
        return
    resets, blown = int(state.stamps[RESETS]), int(state.stamps[BLOWN])
    state.copy_from(FilterState(len(state.memory), state.size))
    state.stamps[RESETS], state.stamps[BLOWN] = resets + 1, blown + 1


AnyKernel = Any  # Kernel or the compiled fusiond._kernel.Kernel


def compiled_available() -> bool:
    """Whether the compiled kernel was built."""
    return find_spec("fusiond._kernel") is not None


def make_kernel(plan: Plan, compiled: bool | None = None) -> AnyKernel:
    """The compiled kernel, or its twin where it was not built; `compiled` asks for one of the two. ImportError if the
    compiled one is asked for and was not built."""
    if compiled is None:
        compiled = compiled_available()
    if not compiled:
        return Kernel(plan)
    return import_module("fusiond._kernel_wide" if plan.size == WIDE_SIZE else "fusiond._kernel").Kernel(plan)
