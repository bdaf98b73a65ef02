"""One time line for all sources: that of the receiving host's clock.

A stamp is t = aligned stamp - the source's delay; without a stamp, t = receipt - delay. Every clock that sensors stamp
with (`Received.clock`) has one `Aligner`, shared by all sources that read it, so that the quickest message serves them
all. Invalid payloads are stamped, but nothing is learnt from them.

Round trips leave the offset of a clock between two bounds (THEORY A6). An event of another clock than the inertial
sensor's is told how far off its samples it may lie: errors that both clocks share do not count.
"""

from __future__ import annotations

import math

from fusiond.config.schema import Config
from fusiond.events import HOST_CLOCK, UNIX_CLOCK, ClockPair, Invalid, Measurement, Received
from fusiond.sessions import Receipts
from fusiond.timeline.aligner import Aligner, ClockReport
from fusiond.units import SECOND

ABSURD = "sensor stamp is not positive"


class Clock:
    """Turns received events into measurements on one time line."""

    def __init__(self, config: Config) -> None:
        self._delays = {name: source.delay_ns for name, source in config.streams().items()}
        self._aligners = {UNIX_CLOCK: Aligner(None)}
        self._arrivals = 0
        self._receipts = Receipts()
        self._imus, self._imu_clock = frozenset(config.imu), ""  # the clock that stamps the inertial sensor's samples

    def steps_back(self, received: Received) -> bool:
        """Whether the receipts have stepped back with this event, so that nothing learnt so far is of use: see `forget`."""
        return self._receipts.steps_back(received.source, received.t_receive_ns)

    def forget(self) -> None:
        """Begin a new session: forget every alignment, but not the counts."""
        self._receipts.clear()
        for aligner in self._aligners.values():
            aligner.forget()

    def align(self, received: Received) -> Measurement | None:
        """The measurement; its payload is Invalid if the stamp is unusable. None for a ClockPair."""
        payload = received.payload
        self._receipts.add(received.source, received.t_receive_ns)
        if isinstance(payload, ClockPair):
            self._learn(received, payload)
            return None
        source, receive, stamp = received.source, received.t_receive_ns, received.t_sensor_ns
        t_ns, clock = receive, received.clock if stamp is not None else ""
        if source in self._imus:
            self._imu_clock = clock
        if stamp is None or not received.clock:
            self._arrivals += 1
        elif isinstance(payload, Invalid):
            t_ns = self._aligner(received.clock).peek(stamp, receive) if stamp > 0 else receive
        else:
            placed = self._aligner(received.clock).place(source, stamp, receive) if stamp > 0 else ABSURD
            if isinstance(placed, int):
                t_ns = placed
            else:
                payload = Invalid(placed)
        sigma = 0.0 if clock == self._imu_clock else self._stamp_sigma(clock)
        return Measurement(t_ns - self._delays.get(source, 0), source, received.sequence, receive, payload, sigma)

    def _stamp_sigma(self, clock: str) -> float:
        """Sigma [s] of what a clock and the inertial sensor's may be off against each other: each lies anywhere within its
        bounds. Where Unix time comes by way of the inertial sensor's clock, both are off alike."""
        own, imu = self._half_width(clock), self._half_width(self._imu_clock)
        if own and imu and UNIX_CLOCK in (clock, self._imu_clock):
            return 0.0
        return math.sqrt((own * own + imu * imu) / 3) / SECOND

    def _half_width(self, clock: str) -> int:
        """Of the bounds of a clock's offset [ns]; 0 where it has none."""
        aligner = self._aligners.get(clock)
        return aligner.half_width if aligner is not None else 0

    def report(self) -> dict[str, ClockReport]:
        """How each clock is aligned, by name; "arrival" is for events without a stamp."""
        reports = {name: aligner.report() for name, aligner in sorted(self._aligners.items()) if aligner.samples}
        if self._arrivals:
            reports["arrival"] = ClockReport("arrival", 0, 0.0, 0, 0, 0, self._arrivals)
        return reports

    def _aligner(self, clock: str) -> Aligner:
        aligner = self._aligners.get(clock)
        if aligner is None:
            aligner = self._aligners[clock] = Aligner(self._aligners[UNIX_CLOCK])
        return aligner

    def _learn(self, received: Received, pair: ClockPair) -> None:
        """Learn from a pair: each stamp for its own clock, and their difference if both fit."""
        stamp = received.t_sensor_ns
        if pair.clock == HOST_CLOCK and received.clock and stamp is not None and stamp > 0:
            asked = self._aligner(received.clock)
            asked.learn_trip(stamp, pair.t_ns, received.t_receive_ns)
            asked.bridge_to(self._aligners[UNIX_CLOCK], received.t_receive_ns)
            return
        if received.clock != UNIX_CLOCK or pair.clock == UNIX_CLOCK or stamp is None or min(stamp, pair.t_ns) <= 0:
            return
        boot = self._aligner(pair.clock)
        unix_placed = self._aligner(UNIX_CLOCK).place(received.source, stamp, received.t_receive_ns)
        boot_placed = boot.place(received.source, pair.t_ns, received.t_receive_ns)
        if isinstance(unix_placed, str):
            boot.complaint = f"SYSTEM_TIME refused: {unix_placed}"
        elif not isinstance(boot_placed, str):
            boot.learn_pair(stamp - pair.t_ns, received.t_receive_ns)
