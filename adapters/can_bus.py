"""CAN live: one bus's thread, from python-can to frames in the inbox.

The bus is opened by python-can's own configuration (files, environment, `config_context`); what [can.NAME] gives goes
first. Where the interface can filter, only frames of the wheels' ids, and error frames, come in. The kernel's stamp of
a frame is mapped to the host's time line; stamps of other clocks are not used. On socketcan python-can opens the bus and
sets its filters, and `CanSocket` reads it, so that frames lost in the kernel's queue are seen.
"""

from __future__ import annotations

import logging
import socket
from collections import Counter
from threading import Event
from typing import Any

import can

from fusiond.measurements import Received
from fusiond.sections import Config

from .can import EXTENDED, PDU2, CanDecoder
from .can_socket import CanFrame, CanSocket
from .host_clock import HostClock
from .inputs import POLL_S, Inbox, InputLost

ID_BITS = 0x1FFFFFFF
STANDARD_BITS = 0x7FF
GROUP_BITS, FORMAT_BITS = 0x3FFFF00, 0x3FF0000  # what of a J1939 id tells its PGN, without and with a destination
CONTROLLER, BUS_OFF, RESTARTED = 0x04, 0x40, 0x100  # classes of error frames, linux/can/error.h
OVERFLOW, WARNING, PASSIVE, ACTIVE = 0x03, 0x0C, 0x30, 0x40  # what byte 1 says of the controller
ERROR_FLAG = 0x20000000  # in an id as candump writes it
BIT_RATE_SWITCH, ERROR_STATE = 1, 2  # flags of CAN FD, as candump writes them

log = logging.getLogger("fusiond")


class CanBus:
    """One [can.NAME]. Raises ConfigError where its DBC files do not fit."""

    def __init__(self, config: Config, bus: str, inbox: Inbox[CanFrame], clock: HostClock) -> None:
        self.name = bus
        self.file = "can.log"
        self.inbox = inbox
        self.decoder = CanDecoder(config, bus)
        self.state = "active"  # of the controller, by its error frames
        self.sessions = 0
        self._seen: Counter[str] = Counter()
        self._channel = config.can[bus].log_channel or bus
        self._clock = clock
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Take interface and channel of a configuration, for the sessions to come."""
        settings = self._settings = config.can[self.name]
        where = " ".join(filter(None, (settings.interface, settings.channel, settings.config_context)))
        self.about = f"CAN {self.name} ({where or 'as python-can is configured'})"

    def session(self, stop: Event) -> None:
        """Open the bus, read it until told to stop, close it. Raises InputLost."""
        try:
            bus = self._open()
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise InputLost(f"cannot be opened: {error}") from error
        self.sessions += 1
        self.state = "active"
        try:
            opened = getattr(bus, "socket", None)
            if isinstance(opened, socket.socket) and opened.family == socket.AF_CAN:
                self._read_socket(CanSocket(opened), stop)
            while not stop.is_set():
                message = bus.recv(POLL_S)
                if message is not None:
                    self.inbox.put(self._clock.from_wall_ns(round(message.timestamp * 1e9)), _frame(message))
        except (can.CanError, OSError) as error:
            raise InputLost(f"lost: {error}") from error
        finally:
            bus.shutdown()

    def _read_socket(self, reader: CanSocket, stop: Event) -> None:
        before = self.inbox.missed
        while not stop.is_set():
            for wall_ns, frame in reader.read(POLL_S):
                self.inbox.put(self._clock.now_ns() if wall_ns is None else self._clock.from_wall_ns(wall_ns), frame)
            self.inbox.missed = before + reader.dropped

    def _open(self) -> can.BusABC:
        settings = self._settings
        more: dict[str, Any] = {"fd": True} if settings.fd else {}
        if settings.bitrate is not None:
            more["bitrate"] = settings.bitrate
        filters = [
            {
                "can_id": key & ID_BITS,
                "can_mask": ID_BITS if key & EXTENDED else STANDARD_BITS,
                "extended": bool(key & EXTENDED),
            }
            for key in sorted(self.decoder.keys)
        ]
        filters += [
            {"can_id": group << 8, "can_mask": GROUP_BITS if group >> 8 & 0xFF >= PDU2 else FORMAT_BITS, "extended": True}
            for group in sorted(self.decoder.groups)
        ]
        bus: can.BusABC = can.Bus(
            interface=settings.interface,
            channel=settings.channel,
            config_context=settings.config_context,
            can_filters=filters or None,
            **more,
        )
        return bus

    def decode(self, item: CanFrame, t_ns: int) -> list[Received]:
        """The wheels in a frame; an error frame has none, and is counted."""
        if item.is_error:
            self._take_error(item)
            return []
        if item.is_remote:
            self._seen["remote frames"] += 1
            return []
        return self.decoder.decode(item.arbitration_id, item.is_extended, item.data, t_ns)

    def _take_error(self, item: CanFrame) -> None:
        """Count an error frame; one line in the log when the controller's state changes."""
        self._seen["error frames"] += 1
        classes, detail = item.arbitration_id, item.data[1] if len(item.data) > 1 else 0
        controller = detail if classes & CONTROLLER else 0
        self._seen["controller overflow"] += bool(controller & OVERFLOW)
        state = self.state
        if classes & BUS_OFF:
            self._seen["bus off"] += 1
            state = "bus-off"
        elif classes & RESTARTED:
            self._seen["restarted"] += 1
            state = "active"
        elif controller & PASSIVE:
            self._seen["error passive"] += 1
            state = "error-passive"
        elif controller & WARNING:
            self._seen["error warning"] += 1
            state = "error-warning"
        elif controller & ACTIVE:
            state = "active"
        if state != self.state:
            log.log(logging.INFO if state == "active" else logging.WARNING, "%s: the controller is %s", self.about, state)
            self.state = state

    def record(self, item: CanFrame, t_ns: int) -> bytes:
        """A line of `candump -L`."""
        number = item.arbitration_id | (ERROR_FLAG if item.is_error else 0)
        wide = item.is_extended or item.is_error
        marks = "#R" if item.is_remote else "#" if item.fd_flags is None else f"##{item.fd_flags:X}"
        seconds, rest = divmod(t_ns, 10**9)
        stamp = f"({seconds}.{rest // 1000:06d})"
        return f"{stamp} {self._channel} {number:0{8 if wide else 3}X}{marks}{item.data.hex().upper()}\n".encode()

    def counts(self) -> dict[str, int]:
        """What became of the frames so far, and of the bus."""
        own = {"sessions": self.sessions, "lost in the kernel's queue": self.inbox.missed}
        return {**own, **{name: count for name, count in self._seen.items() if count}, **self.decoder.counts}


def _frame(message: can.Message) -> CanFrame:
    flags = None
    if message.is_fd:
        flags = BIT_RATE_SWITCH * message.bitrate_switch + ERROR_STATE * message.error_state_indicator
    data = b"" if message.is_remote_frame else bytes(message.data)
    return CanFrame(
        message.arbitration_id, message.is_extended_id, data, flags, message.is_remote_frame, message.is_error_frame
    )
