"""Housekeeping of a MAVLink link: heartbeats, requests for messages, TIMESYNC both ways. No I/O except signing keys.

`receive` reads every incoming frame; `due` returns the frames to send. Each message that the configuration needs is
requested from the autopilot by MAV_CMD_SET_MESSAGE_INTERVAL, one after another, as an answer does not name the message.
Received messages are counted. A message that comes at less than ENOUGH of its rate is requested again, at growing intervals.
After a reboot (the boot time falls) everything is requested at once.

ArduPilot denies an interval, in whole milliseconds, of less than 1.25 periods of its loop (GCS_Common.cpp); the loop has at
least 50 Hz (SCHED_LOOP_RATE). So where an interval is denied, the next longer one is requested, up to 25 ms. A longer one
that is denied was not denied because of its length: it is not requested again.

The autopilot's system id is learnt from its HEARTBEAT; fusiond uses the same id unless configured. What is sent is addressed
to one component, and what is addressed to another is left alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common

from fusiond.config.schema import Config
from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.mavlink.decoder import (
    HEADER_1,
    HEADER_2,
    MAGIC_2,
    NO_AUTOPILOT,
    SYSTEM_TIME,
    TIMESYNC_MARK,
    TIMESYNC_STEP,
    TYPE_GROUND_STATION,
    Dialect,
    message_id,
)
from fusiond_adapters.mavlink.signing import Signing
from fusiond_adapters.mavlink.timesync import Timesync

HEARTBEAT_NS = SECOND
WINDOW_NS = 3 * SECOND  # over which rates are judged
ENOUGH = 0.8  # of the requested rate
MAX_INTERVAL_NS = 60 * SECOND  # longest interval between two requests for a message
ANSWER_NS = SECOND // 2  # a request without an answer for this long has none
INTERVAL_STEP_US = 1000  # of an interval that was denied, to the next longer one
LONGEST_PERIODS_US = 25_000  # 1.25 periods of the slowest loop of ArduPilot
PER_PERIOD = 1.25
WHEEL_DISTANCE = "WHEEL_DISTANCE"
REBOOT_MS = 1000  # a boot time that falls by more is a reboot; less is a reordered frame
SYSTEM_TIME_HZ = 1.0
STATUS_HZ = 1.0
STATUS_OF = {"ardupilot": "EKF_STATUS_REPORT", "px4": "ESTIMATOR_STATUS"}  # an autopilot's reports on its estimator
STATUS_IDS = {"EKF_STATUS_REPORT": 193, "ESTIMATOR_STATUS": 230}  # the first is not in the dialect `common`
TIMESYNC_NS = SECOND  # between two TIMESYNC requests, in the mean
TIMESYNC_FIRST, TIMESYNC_FIRST_NS = 20, SECOND // 10  # number and interval of the first ones, also after a reboot
BEAT_NS = 20 * MILLISECOND  # of the slowest loop of ArduPilot
GOLDEN_NS = 12_360_680  # the golden ratio of it: each request comes at another instant of the loop, and waits differently


@dataclass(slots=True)
class Wanted:
    """A requested message and the rate at which it arrives."""

    rate_hz: float  # as the sensors want it
    interval_us: int  # as requested; longer than wanted where the autopilot denied that
    count: int = 0  # in the present window
    measured_hz: float | None = None
    requests: int = 0
    interval_ns: int = WINDOW_NS  # until the next request
    request_at_ns: int = 0
    refused: str | None = None  # MAV_RESULT of the last answer, unless it was accepted
    denials: int = 0
    denied: bool = False  # for good
    hint: str = ""  # what the user can do about it
    reported: bool | None = None  # `good` as last reported

    @property
    def requested_hz(self) -> float:
        return min(self.rate_hz, 1e6 / self.interval_us)

    @property
    def good(self) -> bool:
        return self.measured_hz is not None and self.measured_hz >= ENOUGH * self.requested_hz

    def start(self) -> None:
        """Begin anew, after a reboot of the autopilot."""
        self.measured_hz, self.request_at_ns, self.interval_ns = None, 0, WINDOW_NS
        self.interval_us, self.refused, self.denied = round(1e6 / self.rate_hz), None, False

    def change(self) -> str | None:
        """Its rate in words, if `good` has changed since the last report."""
        if self.reported == self.good or (self.reported is None and self.good):
            self.reported = self.good
            return None
        self.reported = self.good
        refused = f", refused: {self.refused}" if self.refused and not self.good else ""
        hint = f"; {self.hint}" if self.hint and (self.measured_hz or 0) < ENOUGH * self.rate_hz else ""
        return f"comes at {self.measured_hz or 0:.3g} Hz, wanted at {self.rate_hz:.3g} Hz{refused}{hint}"


class Housekeeping:
    """The housekeeping of one [mavlink.NAME] link."""

    def __init__(self, config: Config, link: str) -> None:
        settings = config.mavlink[link]
        dialect = Dialect(settings.dialect)
        self._ids = {**STATUS_IDS, **dialect.ids}
        self.target: tuple[int, int] | None = None  # system, component of the autopilot
        self.reboots = 0
        self.changes: list[str] = []  # changes to log, in words; the reader clears it
        self.wanted = _wanted(config, link, dialect) if settings.request else {}
        self._by_id = {self._ids[name]: wanted for name, wanted in self.wanted.items()}
        self._asked: str | None = None  # the message of the request that has no answer yet
        self._answer_by_ns = 0  # when that is given up
        self._sends_timesync = settings.timesync
        self._timesync_count, self._next_timesync_ns = 0, 0  # since the start or a reboot
        self.signing = Signing(config, link) if settings.signing_key_file is not None else None
        self._system, self._component = settings.system, settings.component
        self._own_system, self._own_component = settings.own_system, settings.own_component
        self._own_sender = common.MAVLink(None, srcSystem=self._own_system or settings.system or 1,
                                          srcComponent=self._own_component)  # fmt: skip
        self._replies: list[bytes] = []
        self._next_heartbeat_ns = 0
        self._window_ns: int | None = None  # begin of the window
        self._boot_ms: int | None = None

    @property
    def identity(self) -> tuple[int, int]:
        """System and component that fusiond sends as; the system is 1 until the autopilot's is known."""
        return self._own_sender.srcSystem, self._own_sender.srcComponent

    def pack(self, message: Any, sender: Any = None) -> bytes:
        """The next frame of a message, from fusiond or another sender. Not for two threads at once."""
        sender = self._own_sender if sender is None else sender
        if self.signing:
            self.signing.prepare(sender)
        packed: bytes = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) & 0xFF
        return packed

    def receive(self, frame: bytes, t_ns: int) -> None:
        """Read a frame whose checksum is right."""
        number = message_id(frame)
        system, component = (frame[5], frame[6]) if frame[0] == MAGIC_2 else (frame[3], frame[4])
        if number == common.MAVLINK_MSG_ID_HEARTBEAT:
            self._read_heartbeat(frame, (system, component), t_ns)
        elif number == common.MAVLINK_MSG_ID_TIMESYNC:
            self._answer_timesync(frame, (system, component), t_ns)
        if self.target is None or self.target[0] != system:
            return
        if (wanted := self._by_id.get(number)) is not None:
            wanted.count += 1
        if number == common.MAVLINK_MSG_ID_SYSTEM_TIME:
            self._read_boot_time(_fields(common.MAVLink_system_time_message, frame)["time_boot_ms"])
        elif number == common.MAVLINK_MSG_ID_COMMAND_ACK and self.target == (system, component):
            self._read_acknowledgement(_fields(common.MAVLink_command_ack_message, frame))

    def due(self, t_ns: int, *, alive: bool) -> list[bytes]:
        """The frames to send now. A heartbeat is due each second while the estimator is `alive`."""
        frames, self._replies = self._replies, []
        if alive and t_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = t_ns + HEARTBEAT_NS
            frames.append(self.pack(common.MAVLink_heartbeat_message(
                common.MAV_TYPE_ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, common.MAV_STATE_ACTIVE, 3)))  # fmt: skip
        if self.target is not None:
            if self._sends_timesync and t_ns >= self._next_timesync_ns:
                frames.append(self._timesync_request(t_ns))
            self._measure_rates(t_ns)
            if self._asked is None or t_ns >= self._answer_by_ns:
                for name, wanted in self.wanted.items():
                    if not (wanted.good or wanted.denied) and t_ns >= wanted.request_at_ns:
                        frames.append(self._request(name, wanted, t_ns))
                        break
        return frames

    def wait_ns(self, t_ns: int) -> int:
        """How long a request for the autopilot's time can wait."""
        waits = self._sends_timesync and self.target is not None
        return max(0, self._next_timesync_ns - t_ns) if waits else SECOND

    def _is_to_us(self, fields: dict[str, Any]) -> bool:
        """Whether a message is addressed to fusiond, or to all."""
        system, component = self.identity
        return fields["target_system"] in (0, system) and fields["target_component"] in (0, component)

    def _read_heartbeat(self, frame: bytes, sender: tuple[int, int], t_ns: int) -> None:
        fields = _fields(common.MAVLink_heartbeat_message, frame)
        if fields["autopilot"] == NO_AUTOPILOT or fields["type"] == TYPE_GROUND_STATION:
            return
        if self.target is None and self._system in (0, sender[0]) and self._component in (0, sender[1]):
            self.target = sender
            self.changes.append(f"the autopilot is system {sender[0]}, component {sender[1]}")
            self._window_ns = t_ns
            if fields["autopilot"] == common.MAV_AUTOPILOT_ARDUPILOTMEGA:
                for name, wanted in self.wanted.items():
                    wanted.hint = _hint(name, wanted)
            if not self._own_system:
                self._own_sender.srcSystem = sender[0]

    def _answer_timesync(self, frame: bytes, sender: tuple[int, int], t_ns: int) -> None:
        fields = _fields(Timesync, frame)
        if fields["tc1"] == 0 and self._is_to_us(fields) and sender != self.identity:
            self._replies.append(self.pack(Timesync(t_ns, fields["ts1"], *sender)))

    def _timesync_request(self, t_ns: int) -> bytes:
        """A request whose answer the decoder recognises by its mark; it is stamped with the time of packing, within 1 us."""
        assert self.target is not None
        number = self._timesync_count
        off_beat_ns = (number + 1) * GOLDEN_NS % BEAT_NS - number * GOLDEN_NS % BEAT_NS
        self._next_timesync_ns = t_ns + (TIMESYNC_FIRST_NS if number < TIMESYNC_FIRST else TIMESYNC_NS) + off_beat_ns
        self._timesync_count += 1
        sent_ns = t_ns // TIMESYNC_STEP * TIMESYNC_STEP + TIMESYNC_MARK
        return self.pack(Timesync(0, sent_ns, *self.target))

    def _read_boot_time(self, boot_ms: int) -> None:
        last, self._boot_ms = self._boot_ms, boot_ms
        if last is not None and boot_ms < last - REBOOT_MS:
            self.reboots += 1
            self.changes.append("the autopilot has rebooted")
            self._timesync_count = self._next_timesync_ns = 0
            self._asked = None
            for wanted in self.wanted.values():
                wanted.start()

    def _read_acknowledgement(self, fields: dict[str, Any]) -> None:
        result = fields["result"]
        if fields["command"] != common.MAV_CMD_SET_MESSAGE_INTERVAL or self._asked is None or not self._is_to_us(fields):
            return
        name, self._asked = self._asked, None
        wanted = self.wanted[name]
        if result == common.MAV_RESULT_ACCEPTED:
            if wanted.refused is not None and wanted.requested_hz < wanted.rate_hz:
                found = f"{name} is denied at {wanted.rate_hz:.3g} Hz, given at {wanted.requested_hz:.3g} Hz"
                self.changes.append(f"{found}; {wanted.hint}" if wanted.hint else found)
            wanted.refused = None
            return
        results = common.enums["MAV_RESULT"]
        named = result in results
        wanted.refused = results[result].name.removeprefix("MAV_RESULT_").lower() if named else f"result {result}"
        if result == common.MAV_RESULT_DENIED:
            wanted.denials += 1
            if wanted.interval_us < LONGEST_PERIODS_US:
                wanted.interval_us = (wanted.interval_us // INTERVAL_STEP_US + 1) * INTERVAL_STEP_US
                wanted.request_at_ns = 0
            else:
                wanted.denied = True

    def _measure_rates(self, t_ns: int) -> None:
        """At the end of a window: the rates in it."""
        if self._window_ns is None or t_ns - self._window_ns < WINDOW_NS:
            return
        seconds = (t_ns - self._window_ns) / SECOND
        self._window_ns = t_ns
        for name, wanted in self.wanted.items():
            was_good = wanted.good
            wanted.measured_hz, wanted.count = wanted.count / seconds, 0
            if (change := wanted.change()) is not None:
                self.changes.append(f"{name} {change}")
            if wanted.good:
                wanted.interval_ns, wanted.refused, wanted.denied = WINDOW_NS, None, False
            elif was_good:
                wanted.request_at_ns = t_ns

    def _request(self, name: str, wanted: Wanted, t_ns: int) -> bytes:
        assert self.target is not None
        wanted.requests += 1
        self._asked, self._answer_by_ns = name, t_ns + ANSWER_NS
        wanted.request_at_ns = t_ns + wanted.interval_ns
        wanted.interval_ns = min(2 * wanted.interval_ns, MAX_INTERVAL_NS)
        return self.pack(common.MAVLink_command_long_message(
            *self.target, common.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
            self._ids[name], wanted.interval_us, 0, 0, 0, 0, 0))  # fmt: skip


def _hint(name: str, wanted: Wanted) -> str:
    """What to set in ArduPilot where a message does not come as often as wanted."""
    if name == WHEEL_DISTANCE:
        return f"ArduPilot sends it with its stream EXTRA3: set SRn_EXTRA3 of the port to {math.ceil(wanted.rate_hz)}"
    loop_hz = math.ceil(PER_PERIOD * wanted.rate_hz)
    return f"ArduPilot sends at most 0.8 SCHED_LOOP_RATE: set SCHED_LOOP_RATE to {loop_hz} or more"


def _wanted(config: Config, link: str, dialect: Dialect) -> dict[str, Wanted]:
    """The messages that the configuration needs from a link, each at the highest rate that a sensor wants."""
    rates = [wanted for _, _, section in config.sensors(link=link) for wanted in section.messages().items()]
    if rates and SYSTEM_TIME in dialect.ids:
        rates.append((SYSTEM_TIME, SYSTEM_TIME_HZ))
    if config.autopilot.link == link:
        rates.append((STATUS_OF[config.autopilot.kind], STATUS_HZ))
    wanted: dict[str, float] = {}
    for name, rate_hz in rates:
        wanted[name] = max(rate_hz, wanted.get(name, 0.0))
    return {name: Wanted(rate_hz, round(1e6 / rate_hz)) for name, rate_hz in wanted.items()}


def _fields(kind: Any, frame: bytes) -> dict[str, Any]:
    """The fields of a message by name; those missing from the frame are zero."""
    start = HEADER_2 if frame[0] == MAGIC_2 else HEADER_1
    payload = frame[start : start + frame[1]]
    size = kind.unpacker.size
    return dict(zip(kind.ordered_fieldnames, kind.unpacker.unpack(payload.ljust(size, b"\0")[:size]), strict=True))
