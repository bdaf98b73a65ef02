"""The local frame that positions are sent to an autopilot in, and the `reset_counter` that tells it of jumps.

An autopilot keeps its estimator running when fusiond is restarted, so the frame must outlive a run. Its origin is the one
that the autopilot reports (GPS_GLOBAL_ORIGIN); until it reports one, that of the last run; without either, the first state
that is sent. The counter begins half way round from the last run's, so that it differs whatever was counted since that
was written, and it goes on with every reset of the state and every change of the origin. ArduPilot resets its position to
the next one that comes with another counter (AP_VisualOdom_Backend::get_reset_timestamp_ms, SelectVelPosFusion).
"""

from __future__ import annotations

import math

from fusiond.messages.types import State
from fusiond.ports.outputs import KeptFrame
from fusiond.units import SECOND
from fusiond_adapters.mavlink.outgoing import Origin, Projection

COUNTS = 256  # values of a reset_counter
TICK_NS = SECOND // 10  # without a last run, the counter begins with the time in these
SAME_M = 0.1  # origins closer than this are one: reported ones are rounded to 1e-7 deg and 1 cm
REACH_M = 50_000.0  # an origin of the last run that is further away is not used: single precision is 4 mm there


class SharedFrame:
    """The frame of one run. `kept` is that of the last run, and is kept up to date for the next."""

    def __init__(self, kept: KeptFrame, project: Projection, now_ns: int) -> None:
        last = kept.reset_counter
        self._begin = now_ns // TICK_NS if last is None else last + COUNTS // 2
        self._kept, self._project = kept, project
        self._before = None if kept.origin is None else Origin(*kept.origin)  # of the last run
        self._reported: Origin | None = None  # the report that `origin` is of
        self._jumps = 0  # changes of the origin
        self.origin: Origin | None = None
        self.count(0)

    def at(self, state: State, reported: Origin | None, geoid_m: float) -> Origin:
        """The origin for a state that is sent now; `reported` is the autopilot's own, its height above the sea."""
        if reported is not None and reported != self._reported:
            self._reported = reported
            self._move(reported._replace(height_m=reported.height_m + geoid_m))
        if self.origin is None:
            here = Origin.of(state)
            near = self._before is not None and self._apart(self._before, here) <= REACH_M
            self._move(self._before if near and self._before is not None else here)
        assert self.origin is not None
        return self.origin

    def count(self, resets: int) -> int:
        """The reset_counter after so many resets of the state in this run."""
        counter = (self._begin + resets + self._jumps) % COUNTS
        self._kept.reset_counter = counter
        return counter

    @property
    def is_reported(self) -> bool:
        """Whether the origin is the autopilot's own."""
        return self._reported is not None

    def _move(self, origin: Origin) -> None:
        if self.origin is not None:
            if self._apart(self.origin, origin) <= SAME_M:
                return
            self._jumps += 1
        self.origin = origin
        self._kept.origin = (origin.latitude_deg, origin.longitude_deg, origin.height_m)

    def _apart(self, one: Origin, other: Origin) -> float:
        north, east = self._project(one, other.latitude_deg, other.longitude_deg)
        return math.hypot(north, east, other.height_m - one.height_m)
