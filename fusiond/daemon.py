"""The daemon: `fusiond run`. Inputs, each in a thread of its own under a supervisor; one task that is the estimator.

The estimator's task also feeds systemd's watchdog and lets the heartbeats go out, so that both stop when it does. An
input that fails is opened again after a pause that grows; it takes nothing else down. So is Zenoh. The end is orderly:
inputs first, then what they left is fused, recorded and published, then the outputs.
"""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from threading import Event
from typing import Any

from fusiond.config import Config
from fusiond.live import LiveEngine
from fusiond.messages import StateMessage
from fusiond.reload import changes
from fusiond.toml_file import ConfigError
from fusiond_adapters.can_bus import CanBus
from fusiond_adapters.host_clock import HostClock
from fusiond_adapters.inputs import Inbox, InputLost, LiveInput
from fusiond_adapters.logs.record import Recorder
from fusiond_adapters.mavlink_link import MavlinkLink
from fusiond_adapters.systemd import Notifier, watchdog_s
from fusiond_adapters.zenoh import PublishError, ZenohStatePublisher, open_session

SECOND = 1_000_000_000  # ns
IDLE_S = 0.25  # the estimator looks around at least this often
LATE_NS = 5_000_000  # a tick later than this waits for the inputs, which were held up as well
CATCH_UP_S = 0.002  # so long
STALLED_NS = 2 * SECOND  # an estimator that has not come round for so long sends no heartbeats
FIRST_PAUSE_S = 0.1  # before a lost input is opened again; doubled each time, up to live.reopen_max_s
STEADY_S = 10.0  # an input that lasted so long begins anew with the first pause
REPORT_S = 10.0  # between two lines about losses, while there are any

log = logging.getLogger("fusiond")

Sink = Callable[[StateMessage], None]


class Daemon:
    """One run. `sinks` take every published message besides Zenoh; `zenoh=False` leaves Zenoh out; `load` reads the
    configuration anew for a reload.

    Raises ConfigError where the configuration does not fit its DBC files or dialects.
    """

    def __init__(
        self,
        config: Config,
        load: Callable[[], Config] | None = None,
        sinks: Sequence[Sink] = (),
        *,
        zenoh: bool = True,
    ) -> None:
        self.config = config
        self.clock = HostClock()
        self.live = LiveEngine(config, self.clock.now_ns, self._publish)
        self.inputs = self._make_inputs(config)
        self.published = self.unpublished = self.reloads = 0
        self.up = asyncio.Event()  # the first turn of the estimator is done, and Zenoh has been tried
        self._load, self._sinks, self._with_zenoh = load, sinks, zenoh
        self._stopping = asyncio.Event()
        self._wake = asyncio.Event()
        self._stops: dict[str, Event] = {}  # ends the session of an input
        self._loop: asyncio.AbstractEventLoop | None = None
        self._publisher: ZenohStatePublisher | None = None
        self._publisher_lost = asyncio.Event()
        self._recorder: Recorder | None = None
        self._beat_ns = 0
        self._mode: str | None = None
        self._told: dict[str, int] = {}  # losses as last logged
        self._notifier = Notifier()

    def stop(self) -> None:
        """Ask for the end. Call it from the event loop's thread."""
        if not self._stopping.is_set():
            self._notifier.stopping()
        self._stopping.set()
        for event in self._stops.values():
            event.set()
        self._wake.set()

    async def run(self) -> None:
        """Run until asked to stop. Raises OSError where the black box's folder cannot be made."""
        self._loop = asyncio.get_running_loop()
        self._open_recorder()
        executor = ThreadPoolExecutor(max_workers=len(self.inputs) + 2, thread_name_prefix="fusiond")
        try:
            async with asyncio.TaskGroup() as group:
                inputs = [
                    group.create_task(self._supervise(key, source, executor), name=source.about)
                    for key, source in self.inputs.items()
                ]
                estimator = group.create_task(self._estimate(inputs), name="estimator")
                group.create_task(self._keep_zenoh(executor, estimator), name="zenoh")
        finally:
            for event in self._stops.values():
                event.set()
            executor.shutdown(wait=True)
            if self._recorder:
                self._recorder.close()
            self._notifier.close()
        log.info("ended: %s", self.status())

    # --- Inputs

    def _make_inputs(self, config: Config) -> dict[str, LiveInput[Any]]:
        size = config.live.queue_frames
        links = [
            MavlinkLink(config, link, Inbox(size, self._rouse), self.clock, self._is_alive) for link in config.mavlink
        ]
        buses = [CanBus(config, bus, Inbox(size, self._rouse), self.clock) for bus in config.can]
        return {f"{kind}.{source.name}": source for kind, made in (("mavlink", links), ("can", buses)) for source in made}

    def _rouse(self) -> None:
        """From an input's thread: there is something to do."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake.set)

    def _is_alive(self) -> bool:
        return self.clock.now_ns() - self._beat_ns < STALLED_NS

    async def _supervise(self, key: str, source: LiveInput[Any], executor: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        pause, complaint = FIRST_PAUSE_S, ""
        while not self._stopping.is_set():
            stop = self._stops[key] = Event()
            began = loop.time()
            try:
                await loop.run_in_executor(executor, source.session, stop)
                reason = ""
            except InputLost as lost:
                reason = str(lost)
            except Exception as fault:  # a driver's fault must take nothing else down; it is told whole
                reason = f"failed: {fault!r}"
                log.exception("%s failed", source.about)
            if not reason:  # asked to end
                pause = FIRST_PAUSE_S
                continue
            if loop.time() - began > STEADY_S:
                pause, complaint = FIRST_PAUSE_S, ""
            if reason != complaint:
                log.warning("%s: %s; trying again", source.about, reason)
                complaint = reason
            await _first(self._stopping, pause)
            pause = min(2 * pause, self.config.live.reopen_max_s)

    # --- The estimator

    async def _estimate(self, inputs: Sequence[asyncio.Task[None]]) -> None:
        loop = asyncio.get_running_loop()
        feed_s = watchdog_s()
        next_feed, next_report = loop.time(), loop.time() + REPORT_S
        while True:
            timer = loop.call_later(self._time_to_tick(), self._wake.set)
            await self._wake.wait()
            timer.cancel()
            self._wake.clear()
            due = self.live.next_tick_ns
            if due is not None and self.clock.now_ns() - due > LATE_NS:
                await asyncio.sleep(CATCH_UP_S)
            ended = all(task.done() for task in inputs)
            self.live.step(self.inputs)
            self._beat_ns = self.clock.now_ns()
            if feed_s is not None and loop.time() >= next_feed:
                next_feed = loop.time() + feed_s / 2
                self._notifier.alive(self.status())
            if loop.time() >= next_report:
                next_report = loop.time() + REPORT_S
                self._report_losses()
            if ended:
                return

    def _time_to_tick(self) -> float:
        """Until the next tick is due, or the estimator has to look around [s]."""
        due = self.live.next_tick_ns
        if due is None:
            return IDLE_S
        return min(IDLE_S, max(0.0, (due - self.clock.now_ns()) / SECOND))

    def _publish(self, message: StateMessage) -> None:
        for sink in self._sinks:
            sink(message)
        if message.mode.value != self._mode:
            log.info("mode: %s", message.mode.value if self._mode is None else f"{self._mode} -> {message.mode.value}")
            self._mode = message.mode.value
        if not self._with_zenoh:
            self.published += 1
            return
        if self._publisher is None:
            self.unpublished += 1
            return
        try:
            self._publisher.publish(message)
            self.published += 1
        except PublishError as error:
            self.unpublished += 1
            log.warning("%s", error)
            self._publisher = None
            self._publisher_lost.set()

    # --- Zenoh

    async def _keep_zenoh(self, executor: ThreadPoolExecutor, estimator: asyncio.Task[None]) -> None:
        """Keep a publisher open until the estimator has ended. The first attempt, come what may, ends the start."""
        loop = asyncio.get_running_loop()
        ended = asyncio.Event()

        def end(_: asyncio.Task[None]) -> None:
            ended.set()
            self._publisher_lost.set()

        estimator.add_done_callback(end)
        pause, complaint = FIRST_PAUSE_S, ""
        while self._with_zenoh and not ended.is_set():
            try:
                opened = await loop.run_in_executor(executor, self._open_zenoh)
            except PublishError as error:
                if str(error) != complaint:
                    log.warning("%s; trying again", error)
                    complaint = str(error)
                self._is_up()
                await _first(ended, pause)
                pause = min(2 * pause, self.config.live.reopen_max_s)
                continue
            pause, complaint = FIRST_PAUSE_S, ""
            with opened:
                if not ended.is_set():
                    self._publisher_lost.clear()
                    self._is_up()
                    await self._publisher_lost.wait()
                self._publisher = None
        if not self._with_zenoh:
            self._is_up()
            await ended.wait()

    def _open_zenoh(self) -> ExitStack:
        """In a thread: session and publisher, to be closed together."""
        with ExitStack() as stack:
            session = stack.enter_context(open_session(self.config.zenoh, self.config.directory))
            publish = self.config.publish
            publisher = ZenohStatePublisher(session, self.config.vehicle.name, publish.encoding)
            self._publisher = stack.enter_context(publisher)
            return stack.pop_all()

    def _is_up(self) -> None:
        if not self.up.is_set():
            self.up.set()
            self._notifier.ready(self.status())
            log.info("up: %s", ", ".join(source.about for source in self.inputs.values()) or "no inputs")

    # --- Watching it, reloading it

    def status(self) -> str:
        """The state of things in one line."""
        latency = self.live.to_publication.report()
        late = "" if latency is None else f", latency p50 {latency.p50:g} ms p99 {latency.p99:g} ms"
        return f"{self._mode or 'no data yet'}, {self.live.offered} measurements, {self.published} published{late}"

    def losses(self) -> dict[str, int]:
        """What was lost so far, by kind; all of it is counted, none of it is silent."""
        found = {f"{key} frames dropped": source.inbox.dropped for key, source in self.inputs.items()}
        found |= {"states unpublished": self.unpublished, "stamps moved": self.live.moved}
        return found | {"records lost": self._recorder.lost if self._recorder else 0}

    def _report_losses(self) -> None:
        """One line for what was lost since the last one."""
        losses = self.losses()
        new = {name: count - self._told.get(name, 0) for name, count in losses.items() if name != "stamps moved"}
        told = ", ".join(f"{count} {name}" for name, count in new.items() if count)
        if told:
            box = f"; black box: {self._recorder.error}" if self._recorder and self._recorder.error else ""
            log.warning("in the last %g s: %s%s", REPORT_S, told, box)
        self._told = losses

    def reload(self) -> None:
        """Take from the configuration file what can change live; with anything else changed, refuse all of it."""
        if self._load is None:
            return
        self._notifier.reloading()
        try:
            new = self._load()
            self._make_inputs(new)  # raises what is wrong with it, before anything is changed
            found = changes(self.config, new)
            if found.refused:
                log.error("reload refused: a restart is needed to change %s", ", ".join(found.refused))
            else:
                self._adopt(new, found.taken)
                log.info("reloaded: %s", ", ".join(found.taken) or "nothing has changed")
        except (ConfigError, OSError) as error:
            log.error("reload refused: %s", error)
        self.reloads += 1
        self._notifier.ready(self.status())

    def _adopt(self, new: Config, keys: Sequence[str]) -> None:
        rates = any(key.startswith("imu.") for key in keys)
        for name, source in self.inputs.items():
            if any(key.startswith(f"{name}.") for key in keys) or (rates and name.startswith("mavlink.")):
                source.configure(new)
                if name in self._stops:
                    self._stops[name].set()
        self.config = new
        if any(key.startswith("record.") for key in keys):
            if self._recorder:
                self._recorder.close()
            self._open_recorder()

    def _open_recorder(self) -> None:
        section, self._recorder = self.config.record, None
        if section.folder is not None:
            self._recorder = Recorder(self.config.path(section.folder), section.file_mb, section.total_mb)
        self.live.record = self._recorder.add if self._recorder else None


async def _first(event: asyncio.Event, seconds: float) -> None:
    """Wait for an event, or until a time has passed."""
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return


async def serve(daemon: Daemon) -> None:
    """Run a daemon under the process's signals: SIGTERM and SIGINT end it, SIGHUP reloads."""
    loop = asyncio.get_running_loop()
    for number, action in ((signal.SIGTERM, daemon.stop), (signal.SIGINT, daemon.stop), (signal.SIGHUP, daemon.reload)):
        loop.add_signal_handler(number, action)
    await daemon.run()
