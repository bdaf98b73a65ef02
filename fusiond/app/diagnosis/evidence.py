"""What a replay gathers for its diagnosis: the sensors' own readings, and what the filter expected of them."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusiond.app.mounting.windows import Gathering
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Receipt
from fusiond.estimator.history import History
from fusiond.events import GnssPosition, GnssVelocity, GnssYaw, ImuSample, WheelSpeed
from fusiond.filter.rows import Outcome
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import radii
from fusiond.units import SECOND

MAX_READINGS = 200_000  # of a receiver: hours; what comes later is not gathered
INTERVALS = 1000  # inertial samples whose spacing is looked at
LOOK_NS = 3 * SECOND  # between two looks at the filter's expectations of the last second: a sample is enough
JUDGED = (Outcome.FUSED, Outcome.REJECTED)


class Readings:
    """The readings of one source: stamps and numbers, bounded."""

    def __init__(self, width: int) -> None:
        self._width, self._stamps, self._numbers = width, array("q"), array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, t_ns: int, *numbers: float) -> None:
        if len(self._stamps) < MAX_READINGS:
            self._stamps.append(t_ns)
            self._numbers.extend(numbers)

    def arrays(self) -> tuple[Array, Array]:
        """Times (K,) [s], in order and without repetition, and the numbers (K, width)."""
        stamps: NDArray[np.int64] = np.array(self._stamps, dtype=np.int64)
        numbers = np.array(self._numbers, dtype=np.float64).reshape(-1, self._width)
        stamps, chosen = np.unique(stamps, return_index=True)
        return stamps / SECOND, numbers[chosen]


@dataclass
class Expected:
    """What the filter expected of the readings of one source that it judged."""

    readings: int = 0
    ratios: list[float] = field(default_factory=list)  # median test ratio of each look
    sigmas: list[float] = field(default_factory=list)  # of the innovation, the largest of its axes, in the source's unit


class Evidence:
    """All that is gathered of one replay."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.gathering = Gathering(config)
        self.velocities = {name: Readings(2) for name in config.gnss}  # m/s north, east, by receiver
        self.positions = {name: Readings(2) for name in config.gnss}  # m north, east of the first fix, by receiver
        self.yaws = {name: Readings(1) for name in config.dual_antenna}  # rad
        self.expected: dict[str, Expected] = {}  # by source
        self.spacing: list[float] = []  # s, of the first inertial samples
        self.fix_types: Counter[int] = Counter()
        self._place: tuple[float, float, float, float] | None = None  # latitude, longitude of the first fix; radii there
        self._last_imu_ns: int | None = None
        self._looked_ns: int | None = None
        self._read_ns = 0  # stamp of the newest row that was read

    def add(self, receipt: Receipt) -> None:
        """Gather what was received."""
        if receipt.refusal is Outcome.INVALID:
            return
        measurement = receipt.measurement
        self.gathering.add(measurement)
        payload, t_ns = measurement.payload, measurement.t_ns + self.gathering.moved_ns
        if isinstance(payload, WheelSpeed):  # the most frequent first
            pass
        elif isinstance(payload, ImuSample):
            if len(self.spacing) < INTERVALS and self._last_imu_ns is not None:
                self.spacing.append((t_ns - self._last_imu_ns) / SECOND)
            self._last_imu_ns = t_ns
        elif isinstance(payload, GnssVelocity):
            self.velocities[measurement.source.partition(".")[0]].add(t_ns, payload.north, payload.east)
        elif isinstance(payload, GnssPosition):
            self.fix_types[payload.fix_type] += 1
            self.positions[measurement.source.partition(".")[0]].add(t_ns, *self._metres(payload))
        elif isinstance(payload, GnssYaw):
            self.yaws[measurement.source].add(t_ns, payload.yaw)
        if self._looked_ns is None or measurement.t_receive_ns - self._looked_ns >= LOOK_NS:
            self._looked_ns = measurement.t_receive_ns
            self._look(receipt.history)

    def begin_session(self, t_receive_ns: int) -> None:
        """Receipts have stepped back, to this one."""
        self.gathering.begin_session(t_receive_ns)
        self._last_imu_ns = self._looked_ns = None
        self._read_ns = 0

    def _look(self, history: History) -> None:
        """Read the rows that have been judged since the last look. A late event may change one of them afterwards; over a
        drive that does not matter."""
        rows = history.rows
        rows = rows[(rows["t_ns"] > self._read_ns) & (rows["t_ns"] <= history.applied_ns) & np.isin(rows["outcome"], JUDGED)]
        if not len(rows):
            return
        self._read_ns = int(rows["t_ns"].max())
        for number in np.unique(rows["source"]).tolist():
            mine = rows[rows["source"] == number]
            variances = mine["variance"].max(axis=1)
            usable = np.isfinite(variances) & (variances > 0) & np.isfinite(mine["ratio"])
            found = self.expected.setdefault(history.params.sources[number], Expected())
            found.readings += int(usable.sum())
            if usable.any():
                found.ratios.append(float(np.median(mine["ratio"][usable])))
                found.sigmas.append(float(np.sqrt(np.median(variances[usable]))))

    def _metres(self, fix: GnssPosition) -> tuple[float, float]:
        if self._place is None:
            meridian, normal = radii(fix.latitude)
            self._place = fix.latitude, fix.longitude, meridian, normal * math.cos(fix.latitude)
        latitude, longitude, north_m, east_m = self._place
        return (fix.latitude - latitude) * north_m, math.remainder(fix.longitude - longitude, 2 * math.pi) * east_m
