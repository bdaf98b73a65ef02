"""The smoothed track of an archived drive: at each instant the state from all that was measured, before and after it.

Theory of operation. The rows of a run go forward through a plain filter (fusiond.filter.smoothing); of each stretch only the
state before it is kept. Then the stretches are gone through again, the last one first: forward, with links, and back by the
adjoint. So the memory is that of one stretch and of a state for every some hundred rows, whatever the length of the drive.

Each pass judges each measurement against all others, those that the live filter rejected too. The next pass uses those that
fit. The first uses those that the live filter used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimator.archive import Archive, Run, Spool, Stretch
from fusiond.estimator.fusion import LOST_IMU_NS, to_solution
from fusiond.estimator.solution import Mode, Solution
from fusiond.filter.kernel.interpreted import AnyKernel, make_kernel
from fusiond.filter.north_east_down import STATE_N_SIZE
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import ROW, Rows
from fusiond.filter.smoothing import FURTHER, LOOK, PARTS, UNSOUND
from fusiond.filter.state import ALIVE, INERTIAL_DOUBT, NOMINAL_SIZE, RESETS, FilterState, T
from fusiond.maths.typed import Array, Stamps
from fusiond.units import SECOND

PASSES = 4  # over a run: most verdicts stay after the second
NUMBER = np.dtype(np.float64).itemsize  # bytes


class Judged(NamedTuple):
    """A stretch of rows, each with innovation, variance and ratio against all others, and the verdict on each of its parts
    (fusiond.filter.smoothing). The inertial sensor's have none."""

    rows: Rows
    verdicts: NDArray[np.int8]  # (rows, PARTS)


class Pass(NamedTuple):
    """What one pass over a run has changed."""

    parts: int  # of rows, that were judged
    changed: int  # whose verdict became another


@dataclass
class SmoothedRun:
    """What smoothing gave of a run, the time from an alignment to the next."""

    begin_ns: int
    end_ns: int
    passes: list[Pass] = field(default_factory=list)
    lost: bool = False  # its numbers were no longer finite: it has no smoothed states


class SmoothedState(NamedTuple):
    """A smoothed state: for publication, and its numbers (fusiond.filter.state)."""

    solution: Solution
    nominal: Array  # (NOMINAL_SIZE,), earth-fixed axes
    variances: Array  # (n,), of the error states


class Smoother:
    """Smooths the runs of an archive at given instants."""

    def __init__(
        self,
        archive: Archive,
        instants_ns: Stamps,
        *,
        spool: Spool | None = None,
        compiled: bool | None = None,
        passes: int = PASSES,
    ) -> None:
        """`instants_ns` rise; those outside the runs are left out. `spool`, which nothing else uses, takes the smoothed
        states; by default memory does."""
        self.params: Parameters = archive.params
        self.runs: list[SmoothedRun] = []
        self._archive, self._passes = archive, passes
        self._instants: Stamps = np.asarray(instants_ns, dtype=np.int64)
        self._kernel: AnyKernel = make_kernel(archive.params, compiled)
        self._spool = spool or Spool.in_memory()
        self._found: list[list[tuple[int, int]]] = []  # by run: place and number of the states of each stretch, last first
        size = archive.params.size
        self._look = NOMINAL_SIZE + size * size + FURTHER  # numbers of a look
        self._ends = np.cumsum([2, NOMINAL_SIZE, STATE_N_SIZE, size, FURTHER])  # of the parts of a state that is kept

    def smooth(self, judge: Callable[[Judged], None] | None = None) -> None:
        """Smooth all runs. `judge` gets the stretches of the last pass over each, the last stretch first."""
        for run in self._archive.runs:
            report, found = SmoothedRun(run.begin_ns, run.end_ns), list[tuple[int, int]]()
            begin = self._spool.end
            for number in range(self._passes):
                self._spool.cut(begin)
                found.clear()
                made = self._pass(run, found, judge if number == self._passes - 1 else None)
                if made is None:
                    report.lost = True
                    break
                report.passes.append(made)
            self.runs.append(report)
            self._found.append(found)

    def solutions(self) -> Iterator[Solution]:
        """The smoothed states for publication, in order of time within each run."""
        return (state.solution for state in self.states())

    def states(self) -> Iterator[SmoothedState]:
        """The smoothed states, in order of time within each run."""
        for run, found in zip(self._archive.runs, self._found, strict=True):
            for place, count in reversed(found):
                numbers = self._spool.read(place, np.float64, count * self._ends[-1]).reshape(count, -1)
                yield from (self._state(run, row) for row in numbers)

    # --- One pass

    def _pass(self, run: Run, found: list[tuple[int, int]], judge: Callable[[Judged], None] | None) -> Pass | None:
        """Smooth a run once; None where the state was lost."""
        state, before = _begin(run), list[_Kept]()
        for stretch in run.stretches:
            before.append(_Kept(state))
            rows, verdicts = self._archive.rows(stretch), stretch.verdicts.astype(np.int64)
            if self._follow(state, stretch, rows, verdicts, np.zeros(1)) == UNSOUND:
                return None
        parts = changed = 0
        vector, matrix = np.zeros(state.size), np.zeros((state.size, state.size))
        room = FilterState(state.sources, state.size)
        for stretch, kept in zip(reversed(run.stretches), reversed(before), strict=True):
            kept.restore(state)
            rows, verdicts, looking = self._with_looks(stretch, int(state.stamps[T]))
            looks = np.zeros((int(looking.sum()) or 1, self._look))
            count = self._follow(state, stretch, rows, verdicts, looks)
            if count == UNSOUND:
                return None
            flat = verdicts.ravel()
            self._kernel.go_back(room, count, rows, flat, vector, matrix, looks.ravel(), int(looking.sum()))
            judged = verdicts[~looking].astype(np.int8)
            parts += judged.size
            changed += int(np.count_nonzero(judged != stretch.verdicts))
            stretch.verdicts = judged
            if judge:
                judge(Judged(rows[~looking], judged))
            if looking.any():
                found.append((self._keep(rows["t_ns"][looking], looks), len(looks)))
        return Pass(parts, changed)

    def _with_looks(self, stretch: Stretch, begin_ns: int) -> tuple[Rows, Stamps, NDArray[np.bool_]]:
        """The rows of a stretch with the instants in it, the verdicts (rows, PARTS), and which are looks. An instant at the
        very begin belongs to the stretch before."""
        rows, verdicts = self._archive.rows(stretch), stretch.verdicts.astype(np.int64)
        first, last = np.searchsorted(self._instants, [begin_ns, stretch.until_ns], "right")
        looks = np.zeros(last - first, dtype=ROW)
        looks["t_ns"], looks["source"] = self._instants[first:last], LOOK
        rows = np.concatenate([rows, looks])
        order = np.argsort(rows["t_ns"], kind="stable")
        verdicts = np.concatenate([verdicts, np.zeros((len(looks), PARTS), dtype=np.int64)])
        return rows[order], verdicts[order], rows["source"][order] == LOOK

    def _follow(self, state: FilterState, stretch: Stretch, rows: Rows, verdicts: Stamps, looks: Array) -> int:
        """Take a stretch into the state. Returns the number of links, or UNSOUND."""
        state.memory[:] = stretch.memory
        state.nominal[INERTIAL_DOUBT] = max(state.nominal[INERTIAL_DOUBT], stretch.doubt)
        return int(self._kernel.follow(state, rows, verdicts.ravel(), looks.ravel()))

    # --- Smoothed states in the spool

    def _keep(self, instants: Stamps, looks: Array) -> int:
        """Write the smoothed states of a stretch; returns their place."""
        size, kept = self.params.size, np.empty((len(looks), self._ends[-1]))
        for numbers, look, t_ns in zip(kept, looks, instants.tolist(), strict=True):
            nominal, covariance = look[:NOMINAL_SIZE].copy(), look[NOMINAL_SIZE:-FURTHER].reshape(size, size).copy()
            state_n = self._kernel.to_north_east_down(nominal, covariance)
            parts = (divmod(t_ns, SECOND), nominal, state_n, covariance.diagonal(), look[-FURTHER:])
            numbers[:] = np.concatenate(parts)
        return self._spool.append(kept)

    def _state(self, run: Run, numbers: Array) -> SmoothedState:
        """A state as it was kept."""
        (seconds, rest), nominal, state_n, variances, further = np.split(numbers, self._ends[:-1])
        rate_b, force_b, (imu_age, fix_age) = np.split(further, [3, 6])
        state = to_solution(nominal, state_n, variances, rate_b, force_b)
        north, east, _ = state.sigma_position_n()
        mode = Mode.NOMINAL
        if not math.hypot(north, east) <= self.params.filter.lost_sigma_m or imu_age > LOST_IMU_NS / SECOND:
            mode = Mode.LOST
        elif fix_age > self.params.filter.position_timeout_s:
            mode = Mode.DEAD_RECKONING
        t_ns, age_ns = int(seconds) * SECOND + int(rest), round(imu_age * SECOND)
        return SmoothedState(Solution(t_ns, mode, age_ns, int(run.start.stamps[RESETS]), state), nominal, variances)


class _Kept:
    """The numbers of a state before a stretch, without its bank."""

    def __init__(self, state: FilterState) -> None:
        self._core, self._whole = state.core.copy(), state.whole.copy()

    def restore(self, state: FilterState) -> None:
        state.core[:], state.whole[:] = self._core, self._whole
        state.track()


def _begin(run: Run) -> FilterState:
    """The state that a pass over a run begins with: the live filter's, without its rivals."""
    state = run.start.copy()
    state.bank[:] = 0.0
    state.stamps[ALIVE] = 0
    state.track()
    return state
