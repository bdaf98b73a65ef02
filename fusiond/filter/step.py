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

from fusiond.filter import heading_bank as bank
from fusiond.filter import initial_alignment as alignment
from fusiond.filter import source_health as health
from fusiond.filter.measurement import factor_of, measure, remember, shared
from fusiond.filter.motion_constraints import GNSS_FRESH_NS, carried, constrain, rests, watch
from fusiond.filter.north_east_down import answer
from fusiond.filter.observations import MODELS, wheel_speed
from fusiond.filter.observations.model import VALUES
from fusiond.filter.parameters import IMU, MODEL, Plan
from fusiond.filter.state import (
    ATTITUDE,
    BLOWN,
    CHOOSING,
    EMPTY,
    FORCE_B,
    HELD_FORCE_B,
    HELD_RATE_B,
    LAST_VALUE,
    NEVER,
    PHASE,
    POSITION_E,
    RATE_B,
    RATE_VARIANCE,
    RESETS,
    RUNNING,
    T_FUSED,
    T_IMU,
    T_LAST,
    T_POSITION,
    WIDE_SIZE,
    FilterState,
    T,
)
from fusiond.filter.strapdown import COAST_RATE, coast, propagate
from fusiond.maths.wgs84 import Array


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

COAST_RATE_VARIANCE = COAST_RATE * COAST_RATE
LOST_HEADING = math.radians(12.0)  # sigma, after coasting: the filter may not find back from such errors, but aligns anew
LEAST_SPAN = 1e-4  # s: two inertial samples are not taken as closer


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
        """One strapdown propagation over dt [s] (fusiond.filter.strapdown.propagate)."""
        propagate(state, dt, force_b, rate_b, self.plan.noise)

    def predict(self, state: FilterState, t_ns: int) -> None:
        predict(state, t_ns, self.plan)

    def answer(self, nominal: Array, covariance: Array) -> Array:
        """The state in north-east-down (fusiond.filter.north_east_down.answer)."""
        return answer(nominal, covariance)

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
        coasted = t_ns - int(stamps[T_IMU]) > plan.imu_gap_ns
        advance(state, t_ns, rows[following_imu] if following_imu < len(rows) else None, plan)
        variance = yaw_variance(state) if coasted else 0.0
        lost, model = variance > LOST_HEADING * LOST_HEADING, plan.models[source]
        if model == IMU and lost and heard_gnss(state, plan):
            stamps[RESETS] += 1
            alignment.begin(state)
            alignment.gather(state, t_ns, source, values, plan)
        elif model == IMU:
            _hold(state, t_ns, values, plan)
        elif not (measure_lost(state, row, plan, variance) if lost else measure(state, row, plan)):
            row["outcome"] = Outcome.REJECTED
        guard(state)
    state.source_stamps[source, T_LAST] = t_ns


def measure_lost(state: FilterState, row: Any, plan: Plan, variance: float) -> bool:
    """Fuse a measurement when the heading, of so much variance after coasting, is lost. It tells of position and velocity;
    what it would tell of a heading that is so far off is not to be relied on. When the IMU is back, an alignment finds it.
    Returns whether it was fused."""
    fused = measure(state, row, plan)
    told = max(0.0, variance - yaw_variance(state))
    up_e = state.nominal[POSITION_E]
    state.covariance[ATTITUDE, ATTITUDE] += np.outer(up_e, up_e) * (told / float(up_e @ up_e))
    return fused


def heard_gnss(state: FilterState, plan: Plan) -> bool:
    """Whether GNSS told velocities until the IMU fell silent, and so will again: without it an alignment would not end."""
    return any(state.stamps[T_IMU] - state.source_stamps[i, T_LAST] <= GNSS_FRESH_NS for i in plan.velocities)


def yaw_variance(state: FilterState) -> float:
    """Of the attitude about the vertical [rad^2]."""
    up_e = state.nominal[POSITION_E]
    return float(up_e @ state.covariance[ATTITUDE, ATTITUDE] @ up_e) / float(up_e @ up_e)


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
        coast(state, dt, plan.noise, rests=rests(state, plan))
        auxiliary[RATE_VARIANCE] = COAST_RATE_VARIANCE
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
        coast(state, (t_ns - carried) * 1e-9, plan.noise, rests=rests(state, plan))
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
    factor = factor_of(own, model, values, parameters, t_ns)
    for i in bank.alive(state):
        hypothesis = state.hypothesis(i)
        seen = MODELS[model].observe(hypothesis, values, parameters)
        assert seen is not None, "a source's model always observes"
        seen, certain = shared(hypothesis, seen, parameters), None
        if model == MODEL["wheel_speed"]:
            certain = shared(hypothesis, wheel_speed.observe(hypothesis, values, parameters, certain=True), parameters)
        bank.take(state, i, hypothesis, seen, plan.gates[len(seen.innovation)], factor, certain)
    own[T_FUSED] = t_ns
    if model == MODEL["gnss_position"]:
        stamps[T_POSITION] = t_ns
    bank.settle(state, plan)


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
    return find_spec("fusiond.filter.kernel.narrow") is not None


def make_kernel(plan: Plan, compiled: bool | None = None) -> AnyKernel:
    """The compiled kernel, or its twin where it was not built; `compiled` asks for one of the two. ImportError if the
    compiled one is asked for and was not built."""
    if compiled is None:
        compiled = compiled_available()
    if not compiled:
        return Kernel(plan)
    return import_module(f"fusiond.filter.kernel.{'wide' if plan.size == WIDE_SIZE else 'narrow'}").Kernel(plan)
