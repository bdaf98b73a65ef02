"""Innovations: how each measurement was judged, told once, as soon as it was."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import ImuSample
from fusiond.filter.rows import Outcome
from fusiond.messages.types import InnovationMessage, OutcomeName

NAMES: dict[Outcome, OutcomeName] = {
    Outcome.FUSED: "fused",
    Outcome.REJECTED: "rejected",
    Outcome.TOO_OLD: "too_old",
    Outcome.DUPLICATE: "duplicate",
    Outcome.INVALID: "invalid",
    Outcome.WAITING: "waiting",
}
KEPT = (Outcome.FUSED, Outcome.REJECTED, Outcome.WAITING)  # what stands in the history; of the rest there is no more to say
MOST_PENDING = 4096  # measurements that wait for the IMU; of more the oldest are told as waiting


class _Row(NamedTuple):
    outcome: Outcome
    ratio: float
    innovation: list[float]
    variance: list[float]


class Innovations:
    """Measurements received, until each is judged. IMU samples are not: they carry the state, they do not correct it."""

    def __init__(self, vehicle: str, fusion: Fusion) -> None:
        self._vehicle, self._fusion = vehicle, fusion
        self._pending: list[tuple[Receipt, Outcome]] = []  # with the outcome when it was received

    def add(self, receipt: Receipt) -> None:
        """Take what was received."""
        if not isinstance(receipt.measurement.payload, ImuSample):
            self._pending.append((receipt, receipt.outcome))

    def judged(self) -> Iterator[InnovationMessage]:
        """Those judged since the last time, in order of receipt."""
        receipts, self._pending = self._pending, []
        kept = [receipt.measurement for receipt, outcome in receipts if outcome in KEPT]
        rows = self._rows(min(measurement.t_ns for measurement in kept)) if kept else {}
        for left, (receipt, outcome) in zip(range(len(receipts), 0, -1), receipts, strict=True):
            measurement = receipt.measurement
            key = measurement.t_ns, self._fusion.history.index[measurement.source], measurement.sequence
            row = rows.get(key) if outcome in KEPT else None
            if row is not None and row.outcome is Outcome.WAITING and left <= MOST_PENDING:
                self._pending.append((receipt, outcome))
            else:
                yield self._message(receipt, outcome if row is None else row.outcome, row)

    def _rows(self, since_ns: int) -> dict[tuple[int, int, int], _Row]:
        """What stands in the history since an instant, by stamp, source and sequence."""
        rows = self._fusion.history.rows
        rows = rows[int(rows["t_ns"].searchsorted(since_ns)) :]
        keys = zip(rows["t_ns"].tolist(), rows["source"].tolist(), rows["sequence"].tolist(), strict=True)
        names = ("outcome", "ratio", "innovation", "variance")
        columns = (rows[name].tolist() for name in names)
        return {key: _Row(Outcome(outcome), *told) for key, outcome, *told in zip(keys, *columns, strict=True)}

    def _message(self, receipt: Receipt, outcome: Outcome, row: _Row | None) -> InnovationMessage:
        measurement = receipt.measurement
        ratio: float | None = None
        innovation: tuple[float, ...] = ()
        variance: tuple[float, ...] = ()
        if row is not None:
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
