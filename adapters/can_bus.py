"""CAN live: one bus's thread, from python-can to frames in the inbox.

The bus is opened by python-can's own configuration (files, environment, `config_context`); what [can.NAME] gives goes
first. Where the interface can filter, only frames of the wheels' ids, and error frames, come in. The kernel's stamp of
a frame is mapped to the host's time line; stamps of other clocks are not used.
"""

from __future__ import annotations

from threading import Event
from typing import Any, NamedTuple

import can

from fusiond.config import Config
from fusiond.measurements import Received

from .can import EXTENDED, CanDecoder
from .host_clock import HostClock
from .inputs import POLL_S, Inbox, InputLost

ID_BITS = 0x1FFFFFFF
STANDARD_BITS = 0x7FF
BUS_OFF, RESTARTED = 0x40, 0x100  # classes of error frames, linux/can/error.h
ERROR_FLAG = 0x20000000  # in an id as candump writes it
BIT_RATE_SWITCH, ERROR_STATE = 1, 2  # flags of CAN FD, as candump writes them


class CanFrame(NamedTuple):
    """One frame as received. `fd_flags` is None for classic CAN."""

    arbitration_id: int
    is_extended: bool
    data: bytes
    fd_flags: int | None = None
    is_remote: bool = False
    is_error: bool = False


class CanBus:
    """One [can.NAME]. Raises ConfigError where its DBC files do not fit."""

    def __init__(self, config: Config, bus: str, inbox: Inbox[CanFrame], clock: HostClock) -> None:
        self.name = bus
        self.file = "can.log"
        self.inbox = inbox
        self.decoder = CanDecoder(config, bus)
        self.sessions = self.error_frames = self.remote_frames = self.bus_off = self.restarted = 0
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
        try:
            while not stop.is_set():
                message = bus.recv(POLL_S)
                if message is not None:
                    self.inbox.put(self._clock.from_wall_ns(round(message.timestamp * 1e9)), _frame(message))
        except (can.CanError, OSError) as error:
            raise InputLost(f"lost: {error}") from error
        finally:
            bus.shutdown()

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
            self.error_frames += 1
            self.bus_off += bool(item.arbitration_id & BUS_OFF)
            self.restarted += bool(item.arbitration_id & RESTARTED)
            return []
        if item.is_remote:
            self.remote_frames += 1
            return []
        return self.decoder.decode(item.arbitration_id, item.is_extended, item.data, t_ns)

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
        own = {"sessions": self.sessions, "error frames": self.error_frames, "remote frames": self.remote_frames}
        return {**own, "bus off": self.bus_off, "restarted": self.restarted, **self.decoder.counts}


def _frame(message: can.Message) -> CanFrame:
    flags = None
    if message.is_fd:
        flags = BIT_RATE_SWITCH * message.bitrate_switch + ERROR_STATE * message.error_state_indicator
    data = b"" if message.is_remote_frame else bytes(message.data)
    return CanFrame(
        message.arbitration_id, message.is_extended_id, data, flags, message.is_remote_frame, message.is_error_frame
    )
