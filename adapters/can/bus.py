"""The live input of one CAN bus: its frames decoded, its error frames counted.

python-can and cantools are slow to import. Only `prepare` imports them, in the input's thread, so that after a restart
the other inputs are fused and the state is published without delay.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from operator import attrgetter
from threading import Event
from typing import TYPE_CHECKING, Any

from fusiond.config.schema import Config
from fusiond.events import Received
from fusiond.ports.clock import Clock
from fusiond.ports.inputs import Inbox, InputContext, LiveInput
from fusiond.units import MICROSECOND, SECOND
from fusiond_adapters.can.kernel_socket import CanFrame

if TYPE_CHECKING:
    from fusiond_adapters.can.decoder import CanDecoder
    from fusiond_adapters.can.driver import CanDriver

CONTROLLER, BUS_OFF, RESTARTED = 0x04, 0x40, 0x100  # classes of error frames, linux/can/error.h
OVERFLOW, WARNING, PASSIVE, ACTIVE = 0x03, 0x0C, 0x30, 0x40  # byte 1: state of the controller
ERROR_FLAG = 0x20000000  # in an id as candump writes it

log = logging.getLogger("fusiond")


class CanBus:
    """One [can.NAME]."""

    def __init__(self, config: Config, bus: str, inbox: Inbox[CanFrame], clock: Clock) -> None:
        self.name = bus
        self.file = "can.log"
        self.inbox = inbox
        self.decoder: CanDecoder | None = None  # until it is prepared
        self.state = "active"  # of the controller, by its error frames
        self.sessions = 0
        self._counts: Counter[str] = Counter()
        self._channel = config.can[bus].log_channel or bus
        self._config, self._clock = config, clock
        self._driver: CanDriver | None = None
        settings = self._settings = config.can[bus]
        where = " ".join(filter(None, (settings.interface, settings.channel, settings.config_context)))
        self.about = f"CAN {bus} ({where or 'as python-can is configured'})"

    def adopt(self, fresh: CanBus) -> None:
        """Use interface and channel of another bus from the next session."""
        self._settings, self.about = fresh._settings, fresh.about

    def prepare(self) -> None:
        """Load the DBC files. Raises ConfigError if they do not fit, or the interface is not known."""
        from fusiond_adapters.can.decoder import CanDecoder  # noqa: PLC0415 - see above
        from fusiond_adapters.can.driver import CanDriver, check_interface  # noqa: PLC0415

        self.decoder = CanDecoder(self._config, self.name)
        self._driver = CanDriver(self.decoder, self.inbox, self._clock)
        check_interface(self._settings, f"can.{self.name}.interface")

    def session(self, stop: Event) -> None:
        """Open the bus, read it until `stop` is set, close it. Raises InputLost."""
        assert self._driver is not None
        with self._driver.opened(self._settings) as bus:
            self.sessions += 1
            self.state = "active"
            self._driver.read(bus, stop)

    def decode(self, item: CanFrame, t_ns: int) -> list[Received]:
        """The events in a frame. Error frames and remote frames have none and are counted."""
        if item.is_error:
            self._count_error(item)
            return []
        if item.is_remote:
            self._counts["remote frames"] += 1
            return []
        assert self.decoder is not None  # frames come only after prepare
        return self.decoder.decode(item.arbitration_id, item.is_extended, item.data, t_ns)

    def _count_error(self, item: CanFrame) -> None:
        """Count an error frame; log a change of the controller's state."""
        self._counts["error frames"] += 1
        classes, detail = item.arbitration_id, item.data[1] if len(item.data) > 1 else 0
        controller = detail if classes & CONTROLLER else 0
        self._counts["controller overflow"] += bool(controller & OVERFLOW)
        state = self.state
        if classes & BUS_OFF:
            self._counts["bus off"] += 1
            state = "bus-off"
        elif classes & RESTARTED:
            self._counts["restarted"] += 1
            state = "active"
        elif controller & PASSIVE:
            self._counts["error passive"] += 1
            state = "error-passive"
        elif controller & WARNING:
            self._counts["error warning"] += 1
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
        seconds, rest = divmod(t_ns, SECOND)
        stamp = f"({seconds}.{rest // MICROSECOND:06d})"
        return f"{stamp} {self._channel} {number:0{8 if wide else 3}X}{marks}{item.data.hex().upper()}\n".encode()

    def counts(self) -> dict[str, int]:
        """Counts of frames and of errors of the bus so far."""
        own = {"sessions": self.sessions, "lost in the kernel's queue": self.inbox.missed}
        if self._driver and self._driver.garbled:
            own["garbled"] = self._driver.garbled
        decoded = self.decoder.counts if self.decoder else {}
        return {**own, **{name: count for name, count in self._counts.items() if count}, **decoded}


def make(config: Config, context: InputContext) -> Sequence[LiveInput[Any]]:
    """The bus of each [can.NAME]."""

    def bus(name: str) -> CanBus:
        inbox = Inbox(config.live.queue_frames, context.wake, attrgetter("arbitration_id"))
        return CanBus(config, name, inbox, context.clock)

    return [bus(name) for name in config.can]
