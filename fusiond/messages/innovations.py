"""Innovations: innovation and outcome of each measurement, published once, at the first tick after they are known.

The outcome is read at the tick, not at the receipt: reading it at the receipt would make the history run its rows again
for every late measurement, where one run before the tick is enough for all of them. If ticks are so rare that the history
would drop a measurement before the next one, its row is read earlier and kept here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import Measurement
from fusiond.filter.rows import Outcome
from fusiond.messages.outcomes import NAMES
from fusiond.messages.types import InnovationMessage

MAX_PENDING = 4096  # measurements that wait for the IMU; if there are more, the oldest are published as waiting
MARGIN = 0.1  # a row is read at least this share of the horizon before the history may drop it
AHEAD = 0.5  # together with those that follow within this share, so that it is done rarely
NEVER_NS = 2**63 - 1

Key = tuple[int, int, int]  # stamp, source, sequence


class _Row(NamedTuple):
    outcome: Outcome
    ratio: float
    innovation: list[float]
    variance: list[float]


class Innovations:
    """Measurements received, until the outcome of each is known. IMU samples propagate the state: of them only those that
    are rejected have an innovation."""

    def __init__(self, vehicle: str, fusion: Fusion) -> None:
        params = fusion.params
        self._vehicle, self._fusion, self._history = vehicle, fusion, fusion.history
        self._imu = params.sources[params.imu_source]
        self._margin_ns, self._ahead_ns = int(MARGIN * params.horizon_ns), int(AHEAD * params.horizon_ns)
        self._pending: list[Receipt] = []
        self._read: dict[Key, _Row] = {}  # rows of pending measurements that had to be read early
        self._over: list[InnovationMessage] = []  # of a session that is over, not published yet
        self._unread_ns = NEVER_NS  # stamp of the oldest pending measurement whose row has not been read yet

    def add(self, receipt: Receipt) -> None:
        """Add a receipt of any source."""
        if receipt.measurement.source != self._imu or receipt.refusal is None:
            self._pending.append(receipt)
            if receipt.refusal is None:
                self._unread_ns = min(self._unread_ns, receipt.measurement.t_ns)
        if self._unread_ns < self._history.settled_ns + self._margin_ns:
            self._read_in_time()

    def begin_session(self) -> None:
        """Go on with the history of a new session. What still waits for the IMU waits for ever, and is published so."""
        rows = self._read | self._rows(self._pending)
        self._over += [self._message(one, self._row(one, rows)) for one in self._pending]
        self._pending, self._read, self._unread_ns = [], {}, NEVER_NS
        self._history = self._fusion.history

    def published(self) -> list[InnovationMessage]:
        """The messages whose outcome has become known since the last call, in order of receipt."""
        receipts, self._pending = self._pending, []
        rows = self._read | self._rows(receipts)
        self._read = {}
        found, self._over = self._over, []
        for left, receipt in zip(range(len(receipts), 0, -1), receipts, strict=True):
            row = self._row(receipt, rows)
            if row is not None and row.outcome is Outcome.WAITING and left <= MAX_PENDING:
                self._pending.append(receipt)
            elif receipt.measurement.source != self._imu or (row is not None and row.outcome is Outcome.REJECTED):
                found.append(self._message(receipt, row))
        self._unread_ns = min((one.measurement.t_ns for one in self._pending), default=NEVER_NS)
        return found

    def _read_in_time(self) -> None:
        """Read the rows of all pending measurements. Those about to be dropped will not change any more."""
        self._read |= self._rows(self._pending)
        until_ns = self._history.settled_ns + self._ahead_ns
        stamps = (one.measurement.t_ns for one in self._pending if one.refusal is None)
        self._unread_ns = min((t_ns for t_ns in stamps if t_ns > until_ns), default=NEVER_NS)

    def _rows(self, receipts: list[Receipt]) -> dict[Key, _Row]:
        """The rows of received measurements that are still in the history."""
        wanted = {self._key(one.measurement) for one in receipts if one.refusal is None}
        if not wanted:
            return {}
        rows = self._history.rows
        rows = rows[int(rows["t_ns"].searchsorted(min(wanted)[0])) :]
        keys = zip(rows["t_ns"].tolist(), rows["source"].tolist(), rows["sequence"].tolist(), strict=True)
        columns = (rows[name].tolist() for name in ("outcome", "ratio", "innovation", "variance"))
        found = zip(keys, *columns, strict=True)
        return {key: _Row(Outcome(outcome), *values) for key, outcome, *values in found if key in wanted}

    def _row(self, receipt: Receipt, rows: dict[Key, _Row]) -> _Row | None:
        """The row of a receipt, if it has one."""
        return rows.get(self._key(receipt.measurement)) if receipt.refusal is None else None

    def _key(self, measurement: Measurement) -> Key:
        return measurement.t_ns, self._history.index[measurement.source], measurement.sequence

    def _message(self, receipt: Receipt, row: _Row | None) -> InnovationMessage:
        measurement = receipt.measurement
        ratio: float | None = None
        innovation: tuple[float, ...] = ()
        variance: tuple[float, ...] = ()
        outcome = Outcome.WAITING if receipt.refusal is None else receipt.refusal  # without a row it is still waiting
        if row is not None:
            outcome = row.outcome
            axes = sum(expected > 0 for expected in row.variance)
            if axes and all(map(math.isfinite, (*row.innovation, *row.variance))):
                innovation, variance = tuple(row.innovation[:axes]), tuple(row.variance[:axes])
                ratio = row.ratio if math.isfinite(row.ratio) else None
        return InnovationMessage(
            vehicle=self._vehicle,
            source=measurement.source,
            t_ns=measurement.t_ns,
            t_receive_ns=measurement.t_receive_ns,
            outcome=NAMES[outcome],
            test_ratio=ratio,
            innovation=innovation,
            variance=variance,
            reason=receipt.reason or None,
        )
