"""What fusiond says on a MAVLink link: heartbeats, requests for messages, answers to TIMESYNC. No I/O.

`hear` takes every frame that comes in; `say` gives the frames that are due. The autopilot is asked for each message
that the configuration needs by MAV_CMD_SET_MESSAGE_INTERVAL. What it sends is counted; a message that comes at less
than ENOUGH of its rate is asked for again, ever more seldom; after a reboot (its boot time falls) everything is asked
for at once. Its system id is learnt from its HEARTBEAT, and is ours too unless configured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common

from fusiond.config import Config

from .mavlink import HEADER_1, HEADER_2, MAGIC_2, NO_AUTOPILOT, SYSTEM_TIME, TYPE_GROUND_STATION, Dialect, message_id

SECOND = 1_000_000_000  # ns
HEARTBEAT_NS = SECOND
WINDOW_NS = 3 * SECOND  # over which rates are judged
ENOUGH = 0.8  # of the rate asked for
LONGEST_PATIENCE_NS = 60 * SECOND  # between two requests for a message that does not come as it should
REBOOT_MS = 1000  # a boot time that falls by more is a reboot; less is a frame that was overtaken
SYSTEM_TIME_HZ = 1.0


@dataclass(slots=True)
class Wanted:
    """One message and how it comes."""

    rate_hz: float
    count: int = 0  # since the window began
    measured_hz: float | None = None
    asked: int = 0
    patience_ns: int = WINDOW_NS  # from a request to the next one
    ask_at_ns: int = 0
    refused: str | None = None  # MAV_RESULT of the last answer, where it was no yes

    @property
    def good(self) -> bool:
        return self.measured_hz is not None and self.measured_hz >= ENOUGH * self.rate_hz


class MavlinkTalk:
    """The talk on one [mavlink.NAME] link."""

    def __init__(self, config: Config, link: str) -> None:
        settings = config.mavlink[link]
        dialect = Dialect(settings.dialect)
        self._ids = dialect.ids
        self.target: tuple[int, int] | None = None  # system, component of the autopilot
        self.reboots = 0
        self.wanted = _wanted(config, link, dialect) if settings.request else {}
        self._by_id = {dialect.ids[name]: wanted for name, wanted in self.wanted.items()}
        self._followed = settings.system
        self._own_system, self._own_component = settings.own_system, settings.own_component
        self._voice = common.MAVLink(None, srcSystem=self._own_system or settings.system or 1,
                                     srcComponent=self._own_component)  # fmt: skip
        self._answers: list[bytes] = []
        self._next_heartbeat_ns = 0
        self._window_ns: int | None = None  # begin of the window
        self._boot_ms: int | None = None

    def hear(self, frame: bytes, t_ns: int) -> None:
        """Take a frame whose checksum is right."""
        number = message_id(frame)
        system, component = (frame[5], frame[6]) if frame[0] == MAGIC_2 else (frame[3], frame[4])
        if number == common.MAVLINK_MSG_ID_HEARTBEAT:
            self._hear_heartbeat(frame, (system, component), t_ns)
        elif number == common.MAVLINK_MSG_ID_TIMESYNC:
            self._answer_timesync(frame, t_ns)
        if self.target is None or self.target[0] != system:
            return
        if (wanted := self._by_id.get(number)) is not None:
            wanted.count += 1
        if number == common.MAVLINK_MSG_ID_SYSTEM_TIME:
            self._hear_boot_time(_fields(common.MAVLink_system_time_message, frame)["time_boot_ms"])
        elif number == common.MAVLINK_MSG_ID_COMMAND_ACK:
            self._hear_answer(_fields(common.MAVLink_command_ack_message, frame))

    def say(self, t_ns: int, *, alive: bool) -> list[bytes]:
        """The frames that are due. A heartbeat is due each second, as long as the estimator is `alive`."""
        said, self._answers = self._answers, []
        if alive and t_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = t_ns + HEARTBEAT_NS
            said.append(self._pack(common.MAVLink_heartbeat_message(
                common.MAV_TYPE_ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, common.MAV_STATE_ACTIVE, 3)))  # fmt: skip
        if self.target is not None:
            self._judge(t_ns)
            for name, wanted in self.wanted.items():
                if not wanted.good and t_ns >= wanted.ask_at_ns:
                    said.append(self._ask(name, wanted, t_ns))
        return said

    def _hear_heartbeat(self, frame: bytes, sender: tuple[int, int], t_ns: int) -> None:
        fields = _fields(common.MAVLink_heartbeat_message, frame)
        if fields["autopilot"] == NO_AUTOPILOT or fields["type"] == TYPE_GROUND_STATION:
            return
        if self.target is None and self._followed in (0, sender[0]):
            self.target = sender
            self._window_ns = t_ns
            if not self._own_system:
                self._voice.srcSystem = sender[0]

    def _answer_timesync(self, frame: bytes, t_ns: int) -> None:
        fields = _fields(common.MAVLink_timesync_message, frame)
        if fields["tc1"] == 0:
            self._answers.append(self._pack(common.MAVLink_timesync_message(t_ns, fields["ts1"])))

    def _hear_boot_time(self, boot_ms: int) -> None:
        last, self._boot_ms = self._boot_ms, boot_ms
        if last is not None and boot_ms < last - REBOOT_MS:
            self.reboots += 1
            for wanted in self.wanted.values():
                wanted.measured_hz, wanted.ask_at_ns, wanted.patience_ns = None, 0, WINDOW_NS

    def _hear_answer(self, fields: dict[str, Any]) -> None:
        if fields["command"] != common.MAV_CMD_SET_MESSAGE_INTERVAL or fields["result"] == common.MAV_RESULT_ACCEPTED:
            return
        results = common.enums["MAV_RESULT"]
        result = fields["result"]
        refused = results[result].name.removeprefix("MAV_RESULT_").lower() if result in results else f"result {result}"
        for wanted in self.wanted.values():  # the answer does not say to which of the requests
            if wanted.asked and not wanted.good:
                wanted.refused = refused

    def _judge(self, t_ns: int) -> None:
        """At the end of a window: what rates did it have?"""
        if self._window_ns is None or t_ns - self._window_ns < WINDOW_NS:
            return
        seconds = (t_ns - self._window_ns) / SECOND
        self._window_ns = t_ns
        for wanted in self.wanted.values():
            was_good = wanted.good
            wanted.measured_hz, wanted.count = wanted.count / seconds, 0
            if wanted.good:
                wanted.patience_ns, wanted.refused = WINDOW_NS, None
            elif was_good:
                wanted.ask_at_ns = t_ns

    def _ask(self, name: str, wanted: Wanted, t_ns: int) -> bytes:
        assert self.target is not None
        wanted.asked += 1
        wanted.ask_at_ns = t_ns + wanted.patience_ns
        wanted.patience_ns = min(2 * wanted.patience_ns, LONGEST_PATIENCE_NS)
        return self._pack(common.MAVLink_command_long_message(
            *self.target, common.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
            self._ids[name], round(1e6 / wanted.rate_hz), 0, 0, 0, 0, 0))  # fmt: skip

    def _pack(self, message: Any) -> bytes:
        packed: bytes = bytes(message.pack(self._voice))
        self._voice.seq = (self._voice.seq + 1) & 0xFF
        return packed


def _wanted(config: Config, link: str, dialect: Dialect) -> dict[str, Wanted]:
    """The messages that the configuration takes from a link, with the greatest rate that anyone wants."""
    rates: list[tuple[str, float]] = [(imu.message, imu.rate_hz) for imu in config.imu.values() if imu.link == link]
    rates += [(gnss.message, 1 / gnss.interval_s) for gnss in config.gnss.values() if gnss.link == link]
    if rates and SYSTEM_TIME in dialect.ids:
        rates.append((SYSTEM_TIME, SYSTEM_TIME_HZ))
    wanted: dict[str, float] = {}
    for name, rate_hz in rates:
        wanted[name] = max(rate_hz, wanted.get(name, 0.0))
    return {name: Wanted(rate_hz) for name, rate_hz in wanted.items()}


def _fields(kind: Any, frame: bytes) -> dict[str, Any]:
    """The fields of a message by name; what the frame leaves out is zero."""
    start = HEADER_2 if frame[0] == MAGIC_2 else HEADER_1
    payload = frame[start : start + frame[1]]
    size = kind.unpacker.size
    return dict(zip(kind.ordered_fieldnames, kind.unpacker.unpack(payload.ljust(size, b"\0")[:size]), strict=True))
