"""The loop over many events in the interpreter: what runs where the compiled kernel was not built, and the same bits.

Plain arrays in, plain arrays out. `make_kernel` picks one of the two.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.filter.north_east_down import to_north_east_down
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import ROW, Outcome, Rows
from fusiond.filter.smoothing import LINKS, Link, follow, go_back
from fusiond.filter.state import WIDE_SIZE, FilterState, T
from fusiond.filter.step import can_step, first_changed, is_final, place, predict, run_one
from fusiond.filter.strapdown import propagate
from fusiond.maths.typed import Array, Stamps

Memory = tuple[Array, NDArray[np.int64], NDArray[np.int64]]  # snapshots: numbers, stamps, rows applied; one a row


class Kernel:
    """The operations of the hot loop for one set of parameters, on the memory that `attach` gives it. The history decides
    what to do when; this does it."""

    def __init__(self, params: Parameters) -> None:
        self.params = params

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
        self._memory = kept_numbers, kept_whole, kept_applied

    def propagate(self, state: FilterState, dt: float, force_b: Array, rate_b: Array) -> None:
        """One strapdown propagation over dt [s] (fusiond.filter.strapdown.propagate)."""
        propagate(state, dt, force_b, rate_b, self.params.noise)

    def predict(self, state: FilterState, t_ns: int) -> None:
        """Carry a state to an instant for publication (fusiond.filter.step.predict)."""
        predict(state, t_ns, self.params)

    def follow(self, state: FilterState, rows: Rows, judged: Stamps, looks: Array) -> int:
        """Take a stretch of rows into a tracked state, and keep its links (fusiond.filter.smoothing.follow)."""
        self._links = [Link(state.size) for _ in range(LINKS * len(rows) + 1)]
        return follow(state, rows, len(rows), judged, looks, self._links, self.params)

    def go_back(
        self,
        state: FilterState,
        count: int,
        rows: Rows,
        judged: Stamps,
        vector: Array,
        matrix: Array,
        looks: Array,
        look: int,
    ) -> None:
        """Carry the adjoint back over the links of the stretch that was followed last (fusiond.filter.smoothing.go_back)."""
        go_back(state, self._links, count, rows, judged, vector, matrix, looks, look, self.params)

    def to_north_east_down(self, nominal: Array, covariance: Array) -> Array:
        """The state in north-east-down (fusiond.filter.north_east_down.to_north_east_down)."""
        return to_north_east_down(nominal, covariance)

    def place(self, begin: int, end: int, t_ns: int, source: int, sequence: int) -> int:
        """Where an event goes in the table (fusiond.filter.step.place)."""
        return place(self.table, begin, end, t_ns, source, sequence)

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
        new = self.place(begin, end, t_ns, source, sequence)
        if new < 0:
            return new
        self.insert(begin + new, end, t_ns, source, sequence, t_receive_ns, Outcome.WAITING, values)
        return first_changed(self.table, begin, new, self.params)

    def restore(self, kept: int) -> None:
        """Copy the last of the snapshots ..kept into the head."""
        numbers, whole, _ = self._memory
        self.head.numbers[:], self.head.whole[:] = numbers[kept - 1], whole[kept - 1]

    def run(self, begin: int, end: int, applied: int, limit_ns: int, kept: int) -> tuple[int, int, bool]:
        """Apply to the head the rows from `applied` on (counted from `begin`) up to `limit_ns`, and keep snapshots.

        Returns the rows applied, the snapshots kept, and whether it is done. If not, it wants memory for snapshots, or the
        next row is one that only `run_one` can apply.
        """
        rows, params = self.table[begin:end], self.params
        while applied < len(rows) and rows[applied]["t_ns"] <= limit_ns:
            if kept == len(self._memory[2]) or not can_step(self.head, rows[applied], params):
                return applied, kept, False
            applied = run_one(self.head, rows, applied, self.counts, params)
            kept = keep(self.head, rows, applied, params, self._memory, kept)
        return applied, kept, True


def keep(head: FilterState, rows: Rows, applied: int, params: Parameters, memory: Memory, kept: int) -> int:
    """Keep the head in row `kept` of `memory` if a snapshot is due after `applied` rows, and final. Returns the number
    of snapshots kept."""
    numbers, whole, counts = memory
    due = head.stamps[T] - whole[kept - 1, T] >= params.snapshot_interval_ns
    if not due or not is_final(head, int(rows[applied - 1]["source"]), params):
        return kept
    numbers[kept], whole[kept], counts[kept] = head.numbers, head.whole, applied
    return kept + 1


AnyKernel = Any  # Kernel or a compiled one


def compiled_available() -> bool:
    """Whether the compiled kernel was built."""
    return find_spec("fusiond.filter.kernel.narrow") is not None


def make_kernel(params: Parameters, compiled: bool | None = None) -> AnyKernel:
    """The compiled kernel, or the interpreted one where it was not built; `compiled` asks for one of the two. ImportError if
    the compiled one is asked for and was not built."""
    if compiled is None:
        compiled = compiled_available()
    if not compiled:
        return Kernel(params)
    return import_module(f"fusiond.filter.kernel.{'wide' if params.size == WIDE_SIZE else 'narrow'}").Kernel(params)
