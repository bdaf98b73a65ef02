"""A stand-in for ArduPilot Rover with the parameters that it comes with, on a simulated drive and in its time.

What it does as the autopilot does: everything happens in its loop (SCHED_LOOP_RATE 50 Hz), so that a request waits for the
next turn, and a message is sent in a turn. An interval of less than 1.25 periods of the loop, in whole milliseconds, is
denied, and so is an interval for WHEEL_DISTANCE, which comes with a stream (GCS_Common.cpp). HIGHRES_IMU has passed two-pole
low-pass filters (INS_GYRO_FILTER 4 Hz, INS_ACCEL_FILTER 10 Hz; LowPassFilter2p.cpp), and is stamped when it is sent. Stamps
count from the boot. The answer to TIMESYNC leaves late in the turn, so that a round trip takes 8 to 28 ms. SYSTEM_TIME is
0.6 s wrong.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.events import Received
from fusiond.maths.typed import Array
from fusiond.messages import Message
from fusiond.simulation.drive import Drive
from fusiond.simulation.wire import LINK, SYSTEM
from fusiond.units import MICROSECOND, MILLISECOND, SECOND
from fusiond_adapters.mavlink.decoder import MavlinkDecoder
from fusiond_adapters.mavlink.housekeeping import Housekeeping
from fusiond_adapters.mavlink.timesync import Timesync

COMPONENT = 1
WIRE_NS = MILLISECOND // 2  # from one to the other
ANSWER_NS = 7 * MILLISECOND  # from the begin of a turn until what it sends leaves, but for sensors
STEP_NS = 4 * MILLISECOND  # between two looks of fusiond at what it has to send
MILLI_G = 9.80665e-3  # m/s^2
OWN_HZ = {"HEARTBEAT": 1.0, "WHEEL_DISTANCE": 1.0}  # what comes without a request: SRn_EXTRA3 is 1 Hz
Frames = Iterator[tuple[int, bytes]]  # time of arrival [ns], frame


def low_passed(values: Array, rate_hz: float, cutoff_hz: float | None) -> Array:
    """A Butterworth low pass of two poles over (N, 3) values, as ArduPilot's LowPassFilter2p; it begins settled."""
    if cutoff_hz is None:
        return values
    ohm = math.tan(math.pi * cutoff_hz / rate_hz)
    c = 1 + 2 * math.cos(math.pi / 4) * ohm + ohm * ohm
    b0, a1, a2 = ohm * ohm / c, 2 * (ohm * ohm - 1) / c, (1 - 2 * math.cos(math.pi / 4) * ohm + ohm * ohm) / c
    filtered = np.empty_like(values)
    before = last = values[0] / (1 + a1 + a2)
    for k, value in enumerate(values):
        now = value - last * a1 - before * a2
        filtered[k] = b0 * (now + 2 * last + before)
        before, last = last, now
    return filtered


class StockRover:
    """The autopilot of a drive, whose inertial samples come more often than its loop turns. `filters_hz`: of the gyro and of
    the accelerometer; None: none."""

    def __init__(
        self,
        drive: Drive,
        *,
        loop_hz: float = 50.0,
        filters_hz: tuple[float | None, float | None] = (4.0, 10.0),
        system_time_off_s: float = 0.6,
    ) -> None:
        self.period_ns = round(SECOND / loop_hz)
        self.refusals = 0
        imu, scenario = drive.imu, drive.scenario
        self._drive, self._off_us = drive, round(system_time_off_s * 1e6)
        self._boot_ns = scenario.start_ns - round(scenario.autopilot.boot_s * SECOND)
        self._rate = low_passed(imu.angular_rate_b.astype(float), scenario.imu.rate_hz, filters_hz[0])
        self._force = low_passed(imu.specific_force_b.astype(float), scenario.imu.rate_hz, filters_hz[1])
        self._sampled_ns = imu.t_receive_us * MICROSECOND
        self._sender = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._parser = common.MAVLink(None)
        self._interval_ns = {name: round(SECOND / rate_hz) for name, rate_hz in OWN_HZ.items()}
        self._next_ns = dict.fromkeys(self._interval_ns, scenario.start_ns)
        self._received: list[tuple[int, bytes]] = []
        self._fix = 0  # number of the next
        self._travelled = np.cumsum(np.abs(drive.truth.speed)) / scenario.imu.rate_hz

    def receive(self, frame: bytes, t_ns: int) -> None:
        """A frame that arrives."""
        heapq.heappush(self._received, (t_ns, frame))

    def turn(self, t_ns: int) -> Frames:
        """One turn of the loop: what it sends."""
        while self._received and self._received[0][0] <= t_ns:
            for message in self._parser.parse_buffer(heapq.heappop(self._received)[1]) or []:
                if (answer := self._answer(message, t_ns)) is not None:
                    yield self._sent(answer, t_ns + ANSWER_NS)
        for name, interval_ns in self._interval_ns.items():
            if t_ns >= self._next_ns[name]:
                self._next_ns[name] = max(self._next_ns[name] + interval_ns, t_ns + 1)
                if (message := getattr(self, f"_{name.lower()}")(t_ns)) is not None:
                    yield self._sent(message, t_ns)

    def _sent(self, message: Any, t_ns: int) -> tuple[int, bytes]:
        frame = bytes(message.pack(self._sender))
        self._sender.seq = (self._sender.seq + 1) & 0xFF
        return t_ns + WIRE_NS, frame

    def _answer(self, message: Any, t_ns: int) -> Any:
        sender = message.get_srcSystem(), message.get_srcComponent()
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            return Timesync(self._boot_us(t_ns) * 1000, message.ts1, *sender)
        if message.get_type() == "COMMAND_LONG" and message.command == common.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(int(message.param1), int(message.param2), t_ns)
            return common.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
        return None

    def _set_interval(self, number: int, interval_us: int, t_ns: int) -> int:
        name = common.mavlink_map[number].msgname
        interval_ms = interval_us // 1000
        if not hasattr(self, f"_{name.lower()}") or name in OWN_HZ or interval_ms * 800 < self.period_ns // 1000:
            self.refusals += 1
            return int(common.MAV_RESULT_DENIED)
        self._interval_ns[name], self._next_ns[name] = interval_ms * MILLISECOND, t_ns
        return int(common.MAV_RESULT_ACCEPTED)

    def _boot_us(self, t_ns: int) -> int:
        return (t_ns - self._boot_ns) // MICROSECOND

    def _row(self, t_ns: int) -> int:
        """The newest inertial sample."""
        return max(0, int(np.searchsorted(self._sampled_ns, t_ns, side="right")) - 1)

    # --- Messages

    def _heartbeat(self, _t_ns: int) -> Any:
        return common.MAVLink_heartbeat_message(
            common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, common.MAV_STATE_ACTIVE, 3)  # fmt: skip

    def _system_time(self, t_ns: int) -> Any:
        return common.MAVLink_system_time_message(t_ns // MICROSECOND - self._off_us, self._boot_us(t_ns) // 1000)

    def _highres_imu(self, t_ns: int) -> Any:
        row = self._row(t_ns)
        values = *self._force[row].tolist(), *self._rate[row].tolist()
        return common.MAVLink_highres_imu_message(self._boot_us(t_ns), *values, *(0.0,) * 7, 0x3F, 0)

    def _scaled_imu(self, t_ns: int) -> Any:
        row = self._row(t_ns)
        force, rate = self._force[row] / MILLI_G, self._rate[row] * 1e3
        counts = *np.rint(force).astype(int).tolist(), *np.rint(rate).astype(int).tolist()
        return common.MAVLink_scaled_imu_message(self._boot_us(t_ns) // 1000, *counts, 0, 0, 0)

    def _gps_raw_int(self, t_ns: int) -> Any:
        """The newest fix, stamped with its arrival in whole milliseconds; none if it has been sent."""
        gnss, fixes = self._drive.gnss, self._drive.gnss.fixes
        newest = int(np.searchsorted(gnss.t_receive_us, t_ns // MICROSECOND, side="right")) - 1
        if newest < self._fix:
            return None
        self._fix = newest + 1
        names = ("fix_type", "lat", "lon", "alt", "vel", "cog", "alt_ellipsoid", "h_acc", "v_acc")
        of = {name: int(getattr(fixes, name)[newest]) for name in names}
        time_us = self._boot_us(int(gnss.t_receive_us[newest]) * MICROSECOND) // 1000 * 1000
        return common.MAVLink_gps_raw_int_message(
            time_usec=time_us, eph=80, epv=120, satellites_visible=14, vel_acc=fixes.vel_acc, **of)  # fmt: skip

    def _wheel_distance(self, t_ns: int) -> Any:
        distance = float(self._travelled[self._row(t_ns)])
        return common.MAVLink_wheel_distance_message(self._boot_us(t_ns) // 1000 * 1000, 1, [distance] + [0.0] * 15)


class Rehearsal:
    """fusiond beside an autopilot: link, decoder and engine, without threads or sockets."""

    def __init__(self, config: Config, rover: StockRover, rate_hz: float = 10.0) -> None:
        self.housekeeping = Housekeeping(config, LINK)
        self.decoder = MavlinkDecoder(config, LINK)
        self.published: list[Message] = []
        self.engine = Engine(config, self.published.append, rate_hz=rate_hz)
        self._rover = rover
        self._sources = frozenset(config.streams())

    def run(self, start_ns: int, stop_ns: int, others: Iterable[Received] = ()) -> None:
        """Let the time pass; `others` are events of other inputs, in their order of receipt."""
        arriving: list[tuple[int, bytes]] = []
        rest = iter(others)
        waiting = next(rest, None)
        for t_ns in range(start_ns, stop_ns, self._rover.period_ns):
            for arrival in self._rover.turn(t_ns):
                heapq.heappush(arriving, arrival)
            for now_ns in range(t_ns + STEP_NS, t_ns + self._rover.period_ns + STEP_NS, STEP_NS):
                while arriving and arriving[0][0] < now_ns:
                    self._receive(*heapq.heappop(arriving))
                while waiting is not None and waiting.t_receive_ns < now_ns:
                    if waiting.source in self._sources:
                        self.engine.feed(waiting)
                    waiting = next(rest, None)
                for frame in self.housekeeping.due(now_ns, alive=True):
                    self._rover.receive(frame, now_ns + WIRE_NS)
        self.engine.finish()

    def _receive(self, t_ns: int, frame: bytes) -> None:
        self.housekeeping.receive(frame, t_ns)
        for event in self.decoder.decode(frame, t_ns):
            self.engine.feed(event)
