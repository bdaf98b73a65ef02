"""A configuration, an autopilot's frames and a daemon in a thread, for the tests of the live daemon."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Queue
from threading import Condition, Thread

import can
from pymavlink.dialects.v20 import common

from fusiond.app.live.daemon import Daemon
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode
from fusiond.messages.types import StateMessage
from fusiond.ports.outputs import LiveOutput
from fusiond.units import MICROSECOND
from tests.helpers.network import DEADLINE, Send

SYSTEM, COMPONENT = 7, 1
DBC = """VERSION ""
BU_: ECU
BO_ 256 AXLE: 8 ECU
 SG_ LEFT : 0|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
 SG_ RIGHT : 16|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
"""


def configuration(folder: Path, connection: str, more: str = "", channel: str = "none", link: str = "") -> Config:
    """One link (with more keys in `link`), one virtual bus, a vehicle at rest with a given heading."""
    (folder / "axle.dbc").write_text(DBC)
    text = f"""
[vehicle]
name = "test"
[filter]
heading_deg = 30.0
[publish]
rate_hz = 100.0
[live]
reopen_max_s = 0.2
[mavlink.fc]
connection = "{connection}"
{link}
[can.car]
dbc = ["axle.dbc"]
interface = "virtual"
channel = "{channel}"
[imu.imu0]
link = "fc"
[gnss.gps0]
link = "fc"
stamp = "arrival"
[wheel.left]
bus = "car"
message = "AXLE"
signal = "LEFT"
[wheel.right]
bus = "car"
message = "AXLE"
signal = "RIGHT"
{more}
"""
    (folder / "live.toml").write_text(text)
    return config.load(folder / "live.toml")


class Autopilot:
    """Frames of an autopilot at rest, in MAVLink 2."""

    def __init__(self) -> None:
        self._link = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)

    @property
    def time_us(self) -> int:
        """Time since the boot: that of this machine."""
        return time.monotonic_ns() // MICROSECOND

    def pack(self, message: common.MAVLink_message) -> bytes:
        packed = bytes(message.pack(self._link))
        self._link.seq = (self._link.seq + 1) & 0xFF
        return packed

    def heartbeat(self) -> bytes:
        kind, maker = common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_GENERIC
        return self.pack(common.MAVLink_heartbeat_message(kind, maker, 0, 0, common.MAV_STATE_ACTIVE, 3))

    def imu(self) -> bytes:
        wobble = 0.01 * math.sin(self.time_us)
        return self.pack(common.MAVLink_highres_imu_message(
            self.time_us, wobble, 0.0, -9.81, 1e-4, wobble / 10, 0.0, *(0.0,) * 7, 0x3F, 0))  # fmt: skip

    def gps(self) -> bytes:
        return self.pack(common.MAVLink_gps_raw_int_message(
            self.time_us, 3, 481374300, 115754900, 563000, 80, 120, 0, 0, 14, 563000, 500, 800, 50))  # fmt: skip

    def system_time(self, boot_ms: int) -> bytes:
        return self.pack(common.MAVLink_system_time_message(0, boot_ms))


def parsed(data: bytes) -> list[common.MAVLink_message]:
    """The messages in bytes from fusiond; pymavlink checks them."""
    return common.MAVLink(None).parse_buffer(data) or []


class Running:
    """A daemon in a thread of its own, and what it published."""

    def __init__(
        self,
        settings: Config,
        load: Callable[[], Config] | None = None,
        *,
        outputs: Sequence[LiveOutput] = (),
        zenoh: bool = False,
    ) -> None:
        self.daemon = Daemon(settings, load, [self._add], outputs, zenoh=zenoh)
        self.messages: list[StateMessage] = []
        self._changed = Condition()
        self._loops: Queue[asyncio.AbstractEventLoop] = Queue()
        self._errors: list[BaseException] = []
        self._thread = Thread(target=self._run)

    def _run(self) -> None:
        async def main() -> None:
            self._loops.put(asyncio.get_running_loop())
            await self.daemon.run()

        try:
            asyncio.run(main())
        except BaseExceptionGroup as error:
            self._errors.append(error)

    def _add(self, message: StateMessage) -> None:
        with self._changed:
            self.messages.append(message)
            self._changed.notify_all()

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition holds; it is checked whenever a state is published, and ten times a second."""
        end = time.monotonic() + DEADLINE
        with self._changed:
            while not condition():
                assert time.monotonic() < end, f"not reached: {self.daemon.status()}, {self.daemon.losses()}"
                self._changed.wait(0.1)

    def call(self, action: Callable[[], None]) -> None:
        """Call a function in the daemon's loop."""
        self.loop.call_soon_threadsafe(action)

    def start(self) -> None:
        self._thread.start()
        self.loop = self._loops.get(timeout=DEADLINE)

    def stop(self) -> None:
        if self._thread.is_alive():
            self.call(self.daemon.stop)
        self.join()

    def join(self) -> None:
        """Wait for the end. Raises the daemon's exception."""
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive(), "the daemon does not end"
        if self._errors:
            raise self._errors[0]


@contextmanager
def running(
    settings: Config,
    load: Callable[[], Config] | None = None,
    *,
    outputs: Sequence[LiveOutput] = (),
    zenoh: bool = False,
) -> Iterator[Running]:
    """A daemon that runs inside the block and has ended after it."""
    run = Running(settings, load, outputs=outputs, zenoh=zenoh)
    run.start()
    try:
        yield run
    finally:
        run.stop()


def axle(left: int = 0, right: int = 0) -> can.Message:
    data = left.to_bytes(2, "little") + right.to_bytes(2, "little") + bytes(4)
    return can.Message(arbitration_id=256, is_extended_id=False, data=data)


def drive(run: Running, send: Send, bus: can.BusABC | None, until: Callable[[], bool], autopilot: Autopilot) -> None:
    """Play an autopilot and wheels until a condition holds: one IMU sample after each publication."""
    link = run.daemon.inputs["mavlink.fc"]
    run.until(lambda: link.counts()["sessions"] == 1)
    for round_ in range(1500):
        if until():
            return
        published = len(run.messages)
        send(autopilot.imu())
        if round_ % 20 == 0:
            send(autopilot.heartbeat() + autopilot.gps())
        if bus is not None and round_ % 2 == 0:
            bus.send(axle())
        run.until(lambda published=published: len(run.messages) > published)
    raise AssertionError(f"not reached: {run.daemon.status()} {run.daemon.losses()}")


def aligned(run: Running) -> bool:
    return bool(run.messages) and run.messages[-1].mode is Mode.NOMINAL


def fused(run: Running, source: str) -> int:
    return run.daemon.live.engine.fusion.outcomes()[source]["FUSED"]
