"""python-can: opens a bus, and reads it into an inbox.

python-can's own configuration (files, environment, `config_context`) opens the bus; [can.NAME] overrides it. If the
interface can filter, it passes only error frames and the frames of sensors. The kernel's stamp of a frame is converted to
the host's time line; stamps of other clocks are not used. On socketcan python-can opens the bus and sets its filters,
and `CanSocket` reads it, so that frames lost in the kernel's queue are counted.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event
from typing import Any

import can

from fusiond.config.schema import Can
from fusiond.config.toml import ConfigError, meant
from fusiond.ports.clock import Clock
from fusiond.ports.inputs import POLL_S, Inbox, InputLost
from fusiond.units import nanoseconds
from fusiond_adapters.can.decoder import EXTENDED, PDU2, CanDecoder
from fusiond_adapters.can.kernel_socket import CanFrame, CanSocket

PAUSE_S = 0.001  # after a garbled line: a driver that always fails must not use up the processor
MAX_LINE = 256  # bytes; slcan's longest, of 64 bytes of data, has 139
ID_BITS = 0x1FFFFFFF
STANDARD_BITS = 0x7FF
GROUP_BITS, FORMAT_BITS = 0x3FFFF00, 0x3FF0000  # bits of a J1939 id that hold its PGN, without and with a destination
BIT_RATE_SWITCH, ERROR_STATE = 1, 2  # flags of CAN FD, as candump writes them


def check_interface(settings: Can, key: str) -> None:
    """Raises ConfigError if python-can, with its plugins, has no interface of the configured name."""
    known = can.VALID_INTERFACES
    if settings.interface is not None and settings.interface not in known:
        asked = f"python-can has no interface '{settings.interface}'{meant(settings.interface, known)}"
        raise ConfigError(f"{key}: {asked}; it has: {', '.join(sorted(known))}")


class CanDriver:
    """Opens and reads a bus; `decoder` has the ids of the wanted frames."""

    def __init__(self, decoder: CanDecoder, inbox: Inbox[CanFrame], clock: Clock) -> None:
        self._decoder, self._inbox, self._clock = decoder, inbox, clock
        self.garbled = 0  # lines that were no frame

    @contextmanager
    def opened(self, settings: Can) -> Iterator[can.BusABC]:
        """The bus, open inside the block. Raises InputLost if it cannot be opened, or is lost later."""
        try:
            bus = self._open(settings)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise InputLost(f"cannot be opened: {error}") from error
        try:
            yield bus
        except (can.CanError, OSError) as error:
            raise InputLost(f"lost: {error}") from error
        finally:
            bus.shutdown()

    def read(self, bus: can.BusABC, stop: Event) -> None:
        """Put frames into the inbox until `stop` is set."""
        opened = getattr(bus, "socket", None)
        if isinstance(opened, socket.socket) and opened.family == socket.AF_CAN:
            self._read_socket(CanSocket(opened), stop)
        while not stop.is_set():
            try:
                message = bus.recv(POLL_S)
            except (can.CanError, ValueError, LookupError) as error:
                if isinstance(error, can.CanError) and not isinstance(error.__cause__, ValueError):
                    raise
                self._drop_line(bus)
                stop.wait(PAUSE_S)
                continue
            if message is not None:
                self._inbox.put(self._clock.from_wall_ns(nanoseconds(message.timestamp)), _frame(message))
            elif len(getattr(bus, "_buffer", b"")) > MAX_LINE:
                self._drop_line(bus)

    def _drop_line(self, bus: can.BusABC) -> None:
        """A text line of a serial adapter (slcan) was garbled: count it, and begin anew with the next. python-can raises
        what its parser does, keeps a line that is not ASCII, and would raise for it again for ever."""
        self.garbled += 1
        line = getattr(bus, "_buffer", None)
        if isinstance(line, bytearray):
            line.clear()

    def _read_socket(self, reader: CanSocket, stop: Event) -> None:
        before = self._inbox.missed
        while not stop.is_set():
            for wall_ns, frame in reader.read(POLL_S):
                self._inbox.put(self._clock.now_ns() if wall_ns is None else self._clock.from_wall_ns(wall_ns), frame)
            self._inbox.missed = before + reader.dropped

    def _open(self, settings: Can) -> can.BusABC:
        more: dict[str, Any] = {"fd": True} if settings.fd else {}
        if settings.bitrate is not None:
            more["bitrate"] = settings.bitrate
        filters = [
            {
                "can_id": key & ID_BITS,
                "can_mask": ID_BITS if key & EXTENDED else STANDARD_BITS,
                "extended": bool(key & EXTENDED),
            }
            for key in sorted(self._decoder.keys)
        ]
        filters += [
            {"can_id": group << 8, "can_mask": GROUP_BITS if group >> 8 & 0xFF >= PDU2 else FORMAT_BITS, "extended": True}
            for group in sorted(self._decoder.groups)
        ]
        bus: can.BusABC = can.Bus(
            interface=settings.interface,
            channel=settings.channel,
            config_context=settings.config_context,
            can_filters=filters or None,
            **more,
        )
        return bus


def _frame(message: can.Message) -> CanFrame:
    flags = None
    if message.is_fd:
        flags = BIT_RATE_SWITCH * message.bitrate_switch + ERROR_STATE * message.error_state_indicator
    data = b"" if message.is_remote_frame else bytes(message.data)
    return CanFrame(
        message.arbitration_id, message.is_extended_id, data, flags, message.is_remote_frame, message.is_error_frame
    )
