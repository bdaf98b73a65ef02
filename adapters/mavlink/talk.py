"""What fusiond says on a MAVLink link: heartbeats, requests for messages, TIMESYNC both ways. No I/O but a signing key's.

`hear` takes every frame that comes in; `say` gives the frames that are due. The autopilot is asked for each message
that the configuration needs by MAV_CMD_SET_MESSAGE_INTERVAL. What it sends is counted; a message that comes at less
than ENOUGH of its rate is asked for again, ever more seldom; after a reboot (its boot time falls) everything is asked
for at once. Its system id is learnt from its HEARTBEAT, and is ours too unless configured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common

from fusiond.config.schema import Config
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

SECOND = 1_000_000_000  # ns
HEARTBEAT_NS = SECOND
WINDOW_NS = 3 * SECOND  # over which rates are judged
ENOUGH = 0.8  # of the rate asked for
LONGEST_PATIENCE_NS = 60 * SECOND  # between two requests for a message that does not come as it should
REBOOT_MS = 1000  # a boot time that falls by more is a reboot; less is a frame that was overtaken
SYSTEM_TIME_HZ = 1.0
STATUS_HZ = 1.0
STATUS_OF = {"ardupilot": "EKF_STATUS_REPORT", "px4": "ESTIMATOR_STATUS"}  # reports on its estimator
STATUS_IDS = {"EKF_STATUS_REPORT": 193, "ESTIMATOR_STATUS": 230}  # the first is not in the dialect `common`
TIMESYNC_NS = SECOND  # between two questions
TIMESYNC_FIRST, TIMESYNC_FIRST_NS = 20, SECOND // 10  # so many, so close, at the start and after a reboot


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
    reported: bool | None = None  # the state of `good` in the last news

    @property
    def good(self) -> bool:
        return self.measured_hz is not None and self.measured_hz >= ENOUGH * self.rate_hz

    def news(self) -> str | None:
        """How it comes, in words, once that has changed."""
        if self.reported == self.good or (self.reported is None and self.good):
            self.reported = self.good
            return None
        self.reported = self.good
        refused = f", refused: {self.refused}" if self.refused and not self.good else ""
        return f"comes at {self.measured_hz or 0:.3g} Hz, wanted at {self.rate_hz:.3g} Hz{refused}"


class MavlinkTalk:
    """The talk on one [mavlink.NAME] link."""

    def __init__(self, config: Config, link: str) -> None:
        settings = config.mavlink[link]
        dialect = Dialect(settings.dialect)
        self._ids = {**STATUS_IDS, **dialect.ids}
        self.target: tuple[int, int] | None = None  # system, component of the autopilot
        self.reboots = 0
        self.news: list[str] = []  # what has changed, in words; who reports it clears it
        self.wanted = _wanted(config, link, dialect) if settings.request else {}
        self._by_id = {self._ids[name]: wanted for name, wanted in self.wanted.items()}
        self._asks_time = settings.timesync
        self._time_asked, self._next_timesync_ns = 0, 0  # since the start or a reboot
        self.signing = Signing(config, link) if settings.signing_key_file is not None else None
        self._followed, self._component = settings.system, settings.component
        self._own_system, self._own_component = settings.own_system, settings.own_component
        self._voice = common.MAVLink(None, srcSystem=self._own_system or settings.system or 1,
                                     srcComponent=self._own_component)  # fmt: skip
        self._answers: list[bytes] = []
        self._next_heartbeat_ns = 0
        self._window_ns: int | None = None  # begin of the window
        self._boot_ms: int | None = None

    @property
    def identity(self) -> tuple[int, int]:
        """System and component that fusiond speaks as; the system is 1 until the autopilot's is known."""
        return self._voice.srcSystem, self._voice.srcComponent

    def pack(self, message: Any, voice: Any = None) -> bytes:
        """The next frame of a message, as fusiond or with another voice. Not for two threads at once."""
        voice = self._voice if voice is None else voice
        if self.signing:
            self.signing.prepare(voice)
        packed: bytes = bytes(message.pack(voice))
        voice.seq = (voice.seq + 1) & 0xFF
        return packed

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
            said.append(self.pack(common.MAVLink_heartbeat_message(
                common.MAV_TYPE_ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, common.MAV_STATE_ACTIVE, 3)))  # fmt: skip
        if self.target is not None:
            if self._asks_time and t_ns >= self._next_timesync_ns:
                said.append(self._ask_time(t_ns))
            self._judge(t_ns)
            for name, wanted in self.wanted.items():
                if not wanted.good and t_ns >= wanted.ask_at_ns:
                    said.append(self._ask(name, wanted, t_ns))
        return said

    def _hear_heartbeat(self, frame: bytes, sender: tuple[int, int], t_ns: int) -> None:
        fields = _fields(common.MAVLink_heartbeat_message, frame)
        if fields["autopilot"] == NO_AUTOPILOT or fields["type"] == TYPE_GROUND_STATION:
            return
        if self.target is None and self._followed in (0, sender[0]) and self._component in (0, sender[1]):
            self.target = sender
            self.news.append(f"the autopilot is system {sender[0]}, component {sender[1]}")
            self._window_ns = t_ns
            if not self._own_system:
                self._voice.srcSystem = sender[0]

    def _answer_timesync(self, frame: bytes, t_ns: int) -> None:
        fields = _fields(common.MAVLink_timesync_message, frame)
        if fields["tc1"] == 0:
            self._answers.append(self.pack(common.MAVLink_timesync_message(t_ns, fields["ts1"])))

    def _ask_time(self, t_ns: int) -> bytes:
        """A question whose answer the decoder knows by its mark; the stamp is that of the packing, give or take 1 us."""
        assert self.target is not None
        self._next_timesync_ns = t_ns + (TIMESYNC_FIRST_NS if self._time_asked < TIMESYNC_FIRST else TIMESYNC_NS)
        self._time_asked += 1
        asked_ns = t_ns // TIMESYNC_STEP * TIMESYNC_STEP + TIMESYNC_MARK
        return self.pack(common.MAVLink_timesync_message(0, asked_ns))

    def _hear_boot_time(self, boot_ms: int) -> None:
        last, self._boot_ms = self._boot_ms, boot_ms
        if last is not None and boot_ms < last - REBOOT_MS:
            self.reboots += 1
            self.news.append("the autopilot has rebooted")
            self._time_asked = self._next_timesync_ns = 0
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
        for name, wanted in self.wanted.items():
            was_good = wanted.good
            wanted.measured_hz, wanted.count = wanted.count / seconds, 0
            if (news := wanted.news()) is not None:
                self.news.append(f"{name} {news}")
            if wanted.good:
                wanted.patience_ns, wanted.refused = WINDOW_NS, None
            elif was_good:
                wanted.ask_at_ns = t_ns

    def _ask(self, name: str, wanted: Wanted, t_ns: int) -> bytes:
        assert self.target is not None
        wanted.asked += 1
        wanted.ask_at_ns = t_ns + wanted.patience_ns
        wanted.patience_ns = min(2 * wanted.patience_ns, LONGEST_PATIENCE_NS)
        return self.pack(common.MAVLink_command_long_message(
            *self.target, common.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
            self._ids[name], round(1e6 / wanted.rate_hz), 0, 0, 0, 0, 0))  # fmt: skip


def _wanted(config: Config, link: str, dialect: Dialect) -> dict[str, Wanted]:
    """The messages that the configuration takes from a link, each at the highest rate that a sensor wants."""
    rates = [wanted for _, _, section in config.sensors(link=link) for wanted in section.messages().items()]
    if rates and SYSTEM_TIME in dialect.ids:
        rates.append((SYSTEM_TIME, SYSTEM_TIME_HZ))
    if config.autopilot.link == link:
        rates.append((STATUS_OF[config.autopilot.kind], STATUS_HZ))
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
