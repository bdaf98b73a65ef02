"""The data for a picture of a replay: samples of the published states and the GNSS fixes, thinned to a bounded number."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from fusiond.app.replay.comparison import Errors
from fusiond.app.replay.truth import displacement
from fusiond.estimator.fusion import Receipt
from fusiond.estimator.solution import Mode
from fusiond.events import GnssPosition
from fusiond.filter.rows import Outcome
from fusiond.messages.types import StateMessage
from fusiond.units import MILLISECOND

CAPACITY = 6000  # samples kept of each kind: more than a picture has pixels across
MAX_UNREAD_NS = 250 * MILLISECOND  # a fix is looked up in the history at most this long after its receipt

Item = TypeVar("Item")


class Thinned(Generic[Item]):
    """A list that keeps every n-th item; n doubles whenever it is full."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.items: list[Item] = []
        self._capacity, self._every, self._offered = capacity, 1, 0

    def add(self, item: Item) -> None:
        if self._offered % self._every == 0:
            if len(self.items) == self._capacity:
                del self.items[1::2]
                self._every *= 2
            if self._offered % self._every == 0:
                self.items.append(item)
        self._offered += 1


class TickSample(NamedTuple):
    """One publication; positions are in metres north and east of the trace's origin, the first position of all."""

    since_ns: int  # from the first event
    north_m: float
    east_m: float
    yaw_deg: float
    sigma_north_m: float
    sigma_east_m: float
    sigma_yaw_deg: float
    reckoned: bool  # dead reckoning
    errors: Errors | None
    true_north_m: float  # nan without errors
    true_east_m: float


class FixSample(NamedTuple):
    """One GNSS position as received."""

    since_ns: int  # from the first event to the instant of the measurement
    north_m: float
    east_m: float


class Trace:
    """Collects the samples of one replay. `origin_ns` returns the instant of its first event on the present time line."""

    def __init__(self, origin_ns: Callable[[], int]) -> None:
        self._origin_ns = origin_ns
        self.ticks: Thinned[TickSample] = Thinned()
        self.fixes: Thinned[FixSample] = Thinned()
        self.rejected: Thinned[FixSample] = Thinned()  # separate, so that thinning does not lose the few
        self._unread: list[tuple[Receipt, FixSample]] = []  # fixes whose outcome has not been read
        self.origin: tuple[float, float, float] | None = None  # lat, lon [deg], height [m]; the first position of all

    def add_tick(self, message: StateMessage, errors: Errors | None) -> None:
        self.read_outcomes()
        state = message.state
        if state is None:
            return
        north, east = self._place(state.lat_deg, state.lon_deg, state.height_m)
        true = (math.nan, math.nan)
        if errors:
            true = self._place(errors.true.lat_deg, errors.true.lon_deg, errors.true.height_m)
        sigma_north, sigma_east, _ = state.sigma_position_ned_m
        reckoned = message.mode is Mode.DEAD_RECKONING
        sigmas = (sigma_north, sigma_east, state.sigma_yaw_deg)
        since_ns = message.t_ns - self._origin_ns()
        self.ticks.add(TickSample(since_ns, north, east, state.yaw_deg, *sigmas, reckoned, errors, *true))

    def add_receipt(self, receipt: Receipt) -> None:
        """The outcome is read later: reading it here would make the history run its rows again for each late fix."""
        measurement, fix = receipt.measurement, receipt.measurement.payload
        if self._unread and abs(measurement.t_receive_ns - self._unread[0][0].measurement.t_receive_ns) > MAX_UNREAD_NS:
            self.read_outcomes()
        if isinstance(fix, GnssPosition) and receipt.refusal is not Outcome.INVALID:
            north, east = self._place(math.degrees(fix.latitude), math.degrees(fix.longitude), fix.height)
            self._unread.append((receipt, FixSample(measurement.t_ns - self._origin_ns(), north, east)))

    def read_outcomes(self) -> None:
        """Read the outcomes of the latest fixes; call it at the end, too."""
        for receipt, sample in self._unread:
            try:
                rejected = receipt.outcome is Outcome.REJECTED
            except LookupError:  # no longer in the history: it came just inside the horizon
                rejected = False
            (self.rejected if rejected else self.fixes).add(sample)
        self._unread.clear()

    def _place(self, lat_deg: float, lon_deg: float, height_m: float) -> tuple[float, float]:
        if self.origin is None:
            self.origin = lat_deg, lon_deg, height_m
        lat, lon, height = self.origin
        return displacement(lat_deg, lon_deg, (lat, lon), height)
