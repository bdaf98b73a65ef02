"""The way to the receiving host: latency, jitter, loss, reordering, and the autopilot's own clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.typed import Array
from fusiond.simulation.scenario import Autopilot, Interval, Transport
from fusiond.units import MILLISECOND, nanoseconds

Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Passage:
    """The transport of N messages: when each left, when it arrived [ns, true Unix time], and whether it arrived at all.

    Where messages keep their order the jitter is that of the sender's schedule, else that of the way.
    """

    t_depart_ns: Stamps
    t_receive_ns: Stamps
    arrived: Mask


def carry(t_origin_ns: Stamps, transport: Transport, random: np.random.Generator) -> Passage:
    """Send messages on their way; the draws depend on their number only."""
    jitter = random.exponential(1.0, len(t_origin_ns)) * transport.jitter_ms
    arrived = random.random(len(t_origin_ns)) >= transport.loss
    t_depart_ns = t_origin_ns + round(transport.latency_ms * MILLISECOND)
    t_receive_ns = t_depart_ns + np.rint(jitter * MILLISECOND).astype(np.int64)
    if not transport.reorder:
        t_depart_ns = t_receive_ns = np.maximum.accumulate(t_receive_ns)
    return Passage(t_depart_ns, t_receive_ns, arrived)


class BootClock:
    """The autopilot's clock: from 0 at each boot, a little fast or slow; times are true Unix time [ns]."""

    def __init__(self, autopilot: Autopilot, start_ns: int) -> None:
        boots = [start_ns - nanoseconds(autopilot.boot_s)]
        silences = [0]
        for reboot in sorted(autopilot.reboot, key=lambda reboot: reboot.at_s):
            boots.append(start_ns + nanoseconds(reboot.at_s))
            silences.append(nanoseconds(reboot.silence_s))
        self._boots, self._silences = np.array(boots, np.int64), np.array(silences, np.int64)
        self._rate = 1 + autopilot.drift_ppm * 1e-6

    def session(self, t_ns: Stamps) -> Stamps:
        """The number of the boot at each time, from 0."""
        found: Stamps = np.maximum(np.searchsorted(self._boots, t_ns, side="right") - 1, 0)
        return found

    def read(self, t_ns: Stamps) -> Stamps:
        """The clock's reading [ns]."""
        since: Stamps = t_ns - self._boots[self.session(t_ns)]
        reading: Stamps = np.rint(since * self._rate).astype(np.int64)
        return reading

    def running(self, t_ns: Stamps) -> Mask:
        """Whether the autopilot sends at that time."""
        session = self.session(t_ns)
        return t_ns >= self._boots[session] + self._silences[session]


def within(t: Array, intervals: list[Interval]) -> Mask:
    """Which of the times (N,) [s] lie in one of the intervals."""
    inside = np.zeros(len(t), np.bool_)
    for start, stop in intervals:
        inside |= (t >= start) & (t < stop)
    return inside
