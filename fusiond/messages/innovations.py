"""Innovations: how each measurement was judged, reported once, at the first tick after that.

The outcome is read at the tick, not at the receipt: to ask for it there would have the history run its rows again for
every late measurement, where one run before the tick serves them all. Only where ticks are so rare that the history would
forget a measurement before the next one, its row is read in time and kept here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import Measurement
from fusiond.filter.rows import Outcome
from fusiond.messages.outcomes import NAMES
from fusiond.messages.types import InnovationMessage

MAX_PENDING = 4096  # measurements that wait for the IMU; of more the oldest are reported as waiting
MARGIN = 0.1  # a row is read, at the latest, this share of the horizon before the history may forget it
AHEAD = 0.5  # and with it those that follow within this share, so that this is done seldom
NEVER_NS = 2**63 - 1

Key = tuple[int, int, int]  # stamp, source, sequence


class _Row(NamedTuple):
    outcome: Outcome
    ratio: float
    innovation: list[float]
    variance: list[float]


class Innovations:
    """Measurements received, until each is judged. The IMU has none: it carries the state, it does not correct it."""

    def __init__(self, vehicle: str, fusion: Fusion) -> None:
        plan = fusion.plan
        self._vehicle, self._history = vehicle, fusion.history
        self._imu = plan.sources[plan.imu_source]
        self._margin_ns, self._ahead_ns = int(MARGIN * plan.horizon_ns), int(AHEAD * plan.horizon_ns)
        self._pending: list[Receipt] = []
        self._read: dict[Key, _Row] = {}  # rows of pending measurements, as far as they had to be read already
        self._unread_ns = NEVER_NS  # stamp of the oldest pending measurement whose row has not been read

    def add(self, receipt: Receipt) -> None:
        """Take what was received, of any source."""
        if receipt.measurement.source != self._imu:
            self._pending.append(receipt)
            if receipt.refusal is None:
                self._unread_ns = min(self._unread_ns, receipt.measurement.t_ns)
        if self._unread_ns < self._history.settled_ns + self._margin_ns:
            self._read_in_time()

    def judged(self) -> list[InnovationMessage]:
        """Those judged since the last time, in order of receipt."""
        receipts, self._pending = self._pending, []
        rows = self._read | self._rows(receipts)
        self._read = {}
        found = []
        for left, receipt in zip(range(len(receipts), 0, -1), receipts, strict=True):
            row = rows.get(self._key(receipt.measurement)) if receipt.refusal is None else None
            if row is not None and row.outcome is Outcome.WAITING and left <= MAX_PENDING:
                self._pending.append(receipt)
            else:
                found.append(self._message(receipt, row))
        self._unread_ns = min((one.measurement.t_ns for one in self._pending), default=NEVER_NS)
        return found

    def _read_in_time(self) -> None:
        """Read the rows of all that is pending. Those about to be forgotten will not change any more."""
        self._read |= self._rows(self._pending)
        until_ns = self._history.settled_ns + self._ahead_ns
        stamps = (one.measurement.t_ns for one in self._pending if one.refusal is None)
        self._unread_ns = min((t_ns for t_ns in stamps if t_ns > until_ns), default=NEVER_NS)

    def _rows(self, receipts: list[Receipt]) -> dict[Key, _Row]:
        """What stands in the history of measurements that were received, as far as it is not forgotten there."""
        wanted = {self._key(one.measurement) for one in receipts if one.refusal is None}
        if not wanted:
            return {}
        rows = self._history.rows
        rows = rows[int(rows["t_ns"].searchsorted(min(wanted)[0])) :]
        keys = zip(rows["t_ns"].tolist(), rows["source"].tolist(), rows["sequence"].tolist(), strict=True)
        columns = (rows[name].tolist() for name in ("outcome", "ratio", "innovation", "variance"))
        found = zip(keys, *columns, strict=True)
        return {key: _Row(Outcome(outcome), *judgement) for key, outcome, *judgement in found if key in wanted}

    def _key(self, measurement: Measurement) -> Key:
        return measurement.t_ns, self._history.index[measurement.source], measurement.sequence

    def _message(self, receipt: Receipt, row: _Row | None) -> InnovationMessage:
        measurement = receipt.measurement
        ratio: float | None = None
        innovation: tuple[float, ...] = ()
        variance: tuple[float, ...] = ()
        outcome = Outcome.WAITING if receipt.refusal is None else receipt.refusal  # without a row: it waited to the end
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
