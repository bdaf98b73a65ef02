"""The archive of a drive: every row that the filter has run, in order, and what the filter knew of the sources meanwhile.

It holds what a smoother needs, in stretches of a few hundred rows: the rows are in a file, so that an hour's log fits, and
of the state only the first of each run and what it remembers of each source. A run is the time from an alignment to the
next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fusiond.filter.observations import IMU
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import ROW, Outcome, Rows
from fusiond.filter.smoothing import LEFT, OPEN, PARTS, USED
from fusiond.filter.state import INERTIAL_DOUBT, PHASE, RUNNING, T_START, FilterState, T
from fusiond.maths.typed import Array

STRETCH = 256  # rows
TAKEN = (Outcome.FUSED, Outcome.REJECTED)  # outcomes of rows that a smoother may use


class Spool:
    """Arrays in a file, each read back by its place."""

    def __init__(self, file: BinaryIO) -> None:
        """`file` is open for reading and writing, and empty."""
        self._file = file
        self.end = 0  # bytes

    @classmethod
    def in_memory(cls) -> Spool:
        """One that holds its arrays in memory."""
        return cls(BytesIO())

    def append(self, numbers: NDArray[Any]) -> int:
        """Write an array behind the others; returns its place."""
        place = self.end
        self._file.seek(place)
        self.end += self._file.write(np.ascontiguousarray(numbers).tobytes())
        return place

    def read(self, place: int, kind: DTypeLike, count: int) -> NDArray[Any]:
        """A copy of `count` numbers of a kind at a place."""
        self._file.seek(place)
        return np.frombuffer(self._file.read(count * np.dtype(kind).itemsize), kind).copy()

    def cut(self, place: int) -> None:
        """Forget all from a place on."""
        self.end = place


@dataclass
class Stretch:
    """Some hundred rows, one after the other, and what the filter knew before them."""

    place: int  # in the spool
    count: int  # of rows
    until_ns: int  # instant of the state after them
    memory: Array  # of each source
    doubt: float  # INERTIAL_DOUBT of the nominal state
    verdicts: NDArray[np.int8]  # (count, PARTS), see fusiond.filter.smoothing


@dataclass
class Run:
    """The stretches from an alignment to the next, and the state before them."""

    start: FilterState
    stretches: list[Stretch] = field(default_factory=list)

    @property
    def begin_ns(self) -> int:
        """Instant of its first state."""
        return int(self.start.stamps[T])

    @property
    def end_ns(self) -> int:
        """Instant of its last state."""
        return self.stretches[-1].until_ns if self.stretches else self.begin_ns


class Archive:
    """Collects the rows of a drive: its `add` is the archive of a History."""

    def __init__(self, params: Parameters, spool: Spool) -> None:
        self.params, self.spool = params, spool
        self.runs: list[Run] = []
        self._pending: list[Rows] = []
        self._waiting = 0  # rows that are pending
        self._before: FilterState | None = None  # the state before the pending rows, of the run that goes on
        self._after: FilterState | None = None  # and after them

    def add(self, rows: Rows, state: FilterState) -> None:
        """Take rows and the state after them, which is not to change any more."""
        runs = bool(state.stamps[PHASE] == RUNNING)
        before = self._before
        if before is not None:
            now, then = state.stamps, before.stamps
            if runs and now[T_START] == then[T_START] and now[T] >= then[T]:
                self._pending.append(rows.copy())
                self._waiting += len(rows)
                self._after = state
                if self._waiting >= STRETCH:
                    self._keep()
                return
            self.finish()
        if runs:
            self._before = state
            self.runs.append(Run(state.copy()))

    def finish(self) -> None:
        """End the run: keep what is pending."""
        if self._waiting:
            self._keep()
        self._before = None

    def rows(self, stretch: Stretch) -> Rows:
        """A copy of a stretch's rows."""
        return self.spool.read(stretch.place, ROW, stretch.count)

    def __iter__(self) -> Iterator[tuple[Run, Stretch]]:
        for run in self.runs:
            for stretch in run.stretches:
                yield run, stretch

    def _keep(self) -> None:
        """Make the pending rows a stretch."""
        before, state = self._before, self._after
        assert before is not None and state is not None
        rows = np.concatenate(self._pending)
        rows = rows[np.isin(rows["outcome"], TAKEN)]
        self._pending, self._waiting = [], 0
        verdicts = np.full((len(rows), PARTS), OPEN, dtype=np.int8)
        measured = np.array(self.params.models)[rows["source"]] != IMU
        verdicts[measured, 0] = np.where(rows["outcome"][measured] == Outcome.FUSED, USED, LEFT)
        stretch = Stretch(
            self.spool.append(rows),
            len(rows),
            int(state.stamps[T]),
            before.memory.copy(),
            float(before.nominal[INERTIAL_DOUBT]),
            verdicts,
        )
        self.runs[-1].stretches.append(stretch)
        self._before = state
