"""The daemon: `fusiond run`. Inputs, estimator and outputs, each in a thread of its own; the event loop supervises them.

The estimator's thread also feeds systemd's watchdog and lets the heartbeats go out, so that both stop when it does. An
input that fails is opened again after a pause that grows; it takes nothing else down. So is an output: Zenoh is one of
them. The end is orderly: inputs first, then what they left is fused, recorded and published, then the outputs.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Event, current_thread
from typing import Any

from fusiond.app.live.estimator_thread import Estimator
from fusiond.app.live.live_engine import LiveEngine
from fusiond.app.state_file import StateFile
from fusiond.config.changes import changes
from fusiond.config.schema import Config, sensor_tables
from fusiond.config.toml import ConfigError
from fusiond.filter.stored_state import to_text
from fusiond.messages.info import config_message, info_message
from fusiond.messages.schedule import Surroundings
from fusiond.messages.types import (
    EventMessage,
    HealthMessage,
    InputHealth,
    LatencyHealth,
    Message,
    OutputHealth,
    StateMessage,
)
from fusiond.ports.inputs import InputLost, LiveInput, Receiver
from fusiond.ports.outputs import Around, LiveOutput, OutputLost
from fusiond_adapters.host import journal
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.host.systemd import Notifier, watchdog_s
from fusiond_adapters.logs.black_box import Recorder
from fusiond_adapters.registry import make_inputs, make_outputs

FIRST_PAUSE_S = 0.1  # before what was lost is opened again; doubled each time, up to live.reopen_max_s
STEADY_S = 10.0  # what lasted so long begins anew with the first pause
SWITCH_S = 0.0005  # threads that want to run wait no longer than this for each other; Python's own 5 ms would be felt
REPORT_S = 10.0  # between two lines about losses, while there are any

LEVEL = {"info": logging.INFO, "notice": logging.INFO, "warning": logging.WARNING, "critical": logging.CRITICAL}

log = logging.getLogger("fusiond")

Sink = Callable[[StateMessage], None]


class Daemon:
    """One run. `sinks` take every published state, in the estimator's own thread; `outputs` are added to those of the
    configuration, of which `zenoh=False` leaves out Zenoh; `load` reads the configuration anew for a reload.

    Raises ConfigError where the configuration does not fit its dialects, or an output lacks its extra.
    """

    def __init__(
        self,
        config: Config,
        load: Callable[[], Config] | None = None,
        sinks: Sequence[Sink] = (),
        outputs: Sequence[LiveOutput] = (),
        *,
        zenoh: bool = True,
        clock: HostClock | None = None,
    ) -> None:
        self.config = config
        self.clock = clock or HostClock()
        self._state_file, stored = None, None
        if config.state.file is not None:
            self._state_file = StateFile(config.path(config.state.file), config, self.clock.now_ns())
            stored = self._state_file.stored
        self.live = LiveEngine(config, self.clock.now_ns, self._publish, self._surroundings, stored=stored)
        self._wake = Event()  # the estimator: there is something to do
        self.inputs = self._make_inputs(config)
        self.outputs = make_outputs(config, Around(self.clock, self.inputs)) | {one.name: one for one in outputs}
        if not zenoh:
            del self.outputs["zenoh"]
        self.published = self.reloads = 0
        self.up = asyncio.Event()  # every input is prepared, and every output has been tried
        self.health: HealthMessage | None = None  # the latest
        self.estimator = Estimator(self.live, self.inputs, self.clock, self._wake, self._after_turn)
        self._load, self._sinks = load, sinks
        self._stopping = asyncio.Event()
        self._stops: dict[str, Event] = {}  # ends the session of an input
        self._wrong: ConfigError | None = None  # what an input found when it was prepared
        self._outputs_over = asyncio.Event()  # the estimator has ended: there is no more to come
        self._stop_output = Event()  # and so the sessions of the outputs are to end
        self._recorder: Recorder | None = None
        self._mode: str | None = None
        self._told: dict[str, int] = {}  # losses as last logged
        self._notifier = Notifier()
        self._feed_s = watchdog_s()
        self._next_feed_s = self._next_report_s = 0.0  # monotonic

    def stop(self) -> None:
        """Ask for the end. Call it from the event loop's thread."""
        if not self._stopping.is_set():
            self._notifier.stopping()
        self._stopping.set()
        for event in self._stops.values():
            event.set()

    async def run(self) -> None:
        """Run until asked to stop. Raises OSError where the black box's folder cannot be made, ConfigError where the
        configuration does not fit its DBC files: then nothing was ever said to be up."""
        self._open_recorder()
        if self._recorder and self._state_file and self._state_file.stored:
            self._recorder.add("state.json", self.clock.now_ns(), to_text(self._state_file.stored))
        workers = len(self.inputs) + len(self.outputs) + 3
        executor = ThreadPoolExecutor(max_workers=workers, thread_name_prefix="fusiond")
        try:
            async with asyncio.TaskGroup() as group:
                prepared = {key: asyncio.Event() for key in self.inputs}
                inputs = [
                    group.create_task(self._supervise(key, source, executor, prepared[key]), name=source.about)
                    for key, source in self.inputs.items()
                ]
                estimator = group.create_task(self._estimate(executor), name="estimator")
                estimator.add_done_callback(lambda _: self._stop_outputs())
                group.create_task(self._finish_after(inputs))
                tried = {name: asyncio.Event() for name in self.outputs}
                for name, output in self.outputs.items():
                    group.create_task(self._keep(output, executor, tried[name]), name=output.about)
                group.create_task(self._come_up([*prepared.values(), *tried.values()]))
                if self._state_file:
                    group.create_task(self._keep_state(self._state_file, executor), name="state file")
        finally:
            for event in self._stops.values():
                event.set()
            self.estimator.finish()
            self._stop_outputs()
            executor.shutdown(wait=True)
            if self._recorder:
                self._recorder.close()
            self._notifier.close()
        if self._wrong:
            raise self._wrong
        log.info("ended: %s", self.status(), extra={"MESSAGE_ID": journal.ENDED})

    # --- Inputs

    def _make_inputs(self, config: Config) -> dict[str, LiveInput[Any]]:
        return make_inputs(config, Receiver(self.clock, self._wake.set, self._is_alive))

    def _is_alive(self) -> bool:
        return self.estimator.is_alive()

    async def _supervise(
        self, key: str, source: LiveInput[Any], executor: ThreadPoolExecutor, prepared: asyncio.Event
    ) -> None:
        """Prepare an input, and keep it open until the daemon is to stop."""
        loop = asyncio.get_running_loop()

        async def session() -> None:
            stop = self._stops[key] = Event()
            await loop.run_in_executor(executor, _run, key, source.session, stop)

        try:
            await loop.run_in_executor(executor, _run, key, source.prepare)
        except ConfigError as wrong:
            self._wrong = wrong
            self.stop()
        finally:
            prepared.set()
        await self._keep_open(source, session, self._stopping)

    async def _keep_open(
        self,
        what: LiveInput[Any] | LiveOutput,
        session: Callable[[], Awaitable[None]],
        over: asyncio.Event,
    ) -> None:
        """Open something again and again, after pauses that grow as long as it does not last."""
        loop = asyncio.get_running_loop()
        pause, complaint = FIRST_PAUSE_S, ""
        while not over.is_set():
            began = loop.time()
            try:
                await session()
                pause, complaint = FIRST_PAUSE_S, ""  # asked to end
                continue
            except (InputLost, OutputLost) as lost:
                reason = str(lost)
            except Exception as fault:  # a driver's fault must take nothing else down; it is told whole
                reason = f"failed: {fault!r}"
                log.exception("%s failed", what.about, extra={"FUSIOND_SOURCE": what.name})
            if loop.time() - began > STEADY_S:
                pause, complaint = FIRST_PAUSE_S, ""
            if reason != complaint:
                about = {"FUSIOND_SOURCE": what.name, "MESSAGE_ID": journal.CONNECTION_LOST}
                log.warning("%s: %s; trying again", what.about, reason, extra=about)
                complaint = reason
            await _first(over, pause)
            pause = min(2 * pause, self.config.live.reopen_max_s)

    # --- The estimator

    async def _estimate(self, executor: ThreadPoolExecutor) -> None:
        await asyncio.get_running_loop().run_in_executor(executor, _run, "estimator", self.estimator.run)

    async def _finish_after(self, inputs: Iterable[asyncio.Task[None]]) -> None:
        for task in inputs:
            await task
        self.estimator.finish()

    def _after_turn(self) -> None:
        """In the estimator's thread: nobody else feeds the watchdog."""
        now_s = time.monotonic()
        if self._feed_s is not None and now_s >= self._next_feed_s:
            self._next_feed_s = now_s + self._feed_s / 2
            self._notifier.alive(self.status())
        if now_s >= self._next_report_s:
            self._next_report_s = now_s + REPORT_S
            self._report_losses()

    # --- The stored state

    async def _keep_state(self, file: StateFile, executor: ThreadPoolExecutor) -> None:
        """Store the newest state again and again, and at the end, in a thread: a disk may be slow."""
        over = False
        while not over:
            await _first(self._outputs_over, self.config.state.every_s)
            over = self._outputs_over.is_set()
            newest = await asyncio.wrap_future(self.estimator.ask(self.live.engine.fusion.to_store))
            if newest is not None:
                await asyncio.get_running_loop().run_in_executor(executor, file.write, newest)

    # --- Outputs

    def _publish(self, message: Message) -> None:
        """Leave a message with every output, and log what people may want to know."""
        if isinstance(message, StateMessage):
            for sink in self._sinks:
                sink(message)
            self.published += 1
            self._mode = message.mode.value
        elif isinstance(message, HealthMessage):
            self.health = message
        elif isinstance(message, EventMessage):
            log.log(LEVEL[message.severity], "%s", message.text, extra=journal.about(message.kind, message.subject))
        for output in self.outputs.values():
            output.outbox.put(message)

    async def _keep(self, output: LiveOutput, executor: ThreadPoolExecutor, tried: asyncio.Event) -> None:
        """Keep an output open until the estimator has ended. `tried` is set when it is open, or could not be opened."""
        loop = asyncio.get_running_loop()

        def opened() -> None:
            self._introduce(output)
            loop.call_soon_threadsafe(tried.set)

        async def session() -> None:
            output.outbox.attend(self.clock.now_ns, opened)
            try:
                await loop.run_in_executor(executor, _run, output.name, output.session, self._stop_output)
            finally:
                tried.set()

        await self._keep_open(output, session, self._outputs_over)

    def _introduce(self, output: LiveOutput) -> None:
        """Leave with an output what is told once only."""
        output.outbox.put(info_message(self.config, self.live.engine.fusion))
        output.outbox.put(config_message(self.config))

    def _stop_outputs(self) -> None:
        self._stop_output.set()
        self._outputs_over.set()
        for output in self.outputs.values():
            output.outbox.rouse()

    async def _come_up(self, parts_done: Iterable[asyncio.Event]) -> None:
        for event in parts_done:
            await event.wait()
        if self._wrong:
            return
        self.up.set()
        self._notifier.ready(self.status())
        parts = [source.about for source in self.inputs.values()] + [output.about for output in self.outputs.values()]
        log.info("up: %s", ", ".join(parts), extra={"MESSAGE_ID": journal.STARTED})

    # --- Watching it, reloading it

    def status(self) -> str:
        """The state of things in one line."""
        latency = self.live.to_publication.report()
        late = "" if latency is None else f", latency p50 {latency.p50:g} ms p99 {latency.p99:g} ms"
        return f"{self._mode or 'no data yet'}, {self.live.offered} measurements, {self.published} published{late}"

    def _surroundings(self) -> Surroundings:
        """What the health tells of inputs, outputs and latency."""
        inputs = {
            key: InputHealth(received=source.inbox.received, dropped=source.inbox.dropped, counts=source.counts())
            for key, source in self.inputs.items()
        }
        outputs = {
            name: OutputHealth(
                offered=output.outbox.offered,
                dropped=output.outbox.dropped,
                latency_ms=output.outbox.latency.report(),
                counts=output.counts(),
                notes=output.notes(),
            )
            for name, output in self.outputs.items()
        }
        if box := self._recorder:
            notes = {"error": box.error} if box.error else {}
            outputs["record"] = OutputHealth(offered=box.written + box.lost, dropped=box.lost, counts={}, notes=notes)
        if file := self._state_file:
            outputs["state"] = file.health(self.live.engine.fusion.hot_start())
        latency = LatencyHealth(fused=self.live.to_fusion.report(), published=self.live.to_publication.report())
        return Surroundings(latency, inputs, outputs)

    def losses(self) -> dict[str, int]:
        """What was lost so far, by kind; all of it is counted, none of it is silent."""
        found = {f"{key} frames dropped": source.inbox.dropped for key, source in self.inputs.items()}
        found |= {f"{key} frames lost before receipt": source.inbox.missed for key, source in self.inputs.items()}
        found |= {f"{name} messages dropped": output.outbox.dropped for name, output in self.outputs.items()}
        found["stamps moved"] = self.live.moved
        found["states not stored"] = self._state_file.lost if self._state_file else 0
        return found | {"records lost": self._recorder.lost if self._recorder else 0}

    def _report_losses(self) -> None:
        """One line for what was lost since the last one."""
        losses = self.losses()
        new = {name: count - self._told.get(name, 0) for name, count in losses.items() if name != "stamps moved"}
        told = ", ".join(f"{count} {name}" for name, count in new.items() if count)
        if told:
            disks = (("black box", self._recorder), ("state file", self._state_file))
            why = "".join(f"; {name}: {disk.error}" for name, disk in disks if disk and disk.error)
            log.warning("in the last %g s: %s%s", REPORT_S, told, why, extra={"MESSAGE_ID": journal.DATA_LOST})
        self._told = losses

    def reload(self) -> None:
        """Take from the configuration file what can change live; with anything else changed, refuse all of it."""
        if self._load is None:
            return
        self._notifier.reloading()
        try:
            new = self._load()
            for source in self._make_inputs(new).values():  # raises what is wrong with it, before anything is changed
                source.prepare()
            found = changes(self.config, new)
            if found.refused:
                log.error("reload refused: a restart is needed to change %s", ", ".join(found.refused))
            else:
                self._adopt(new, found.taken)
                told = ", ".join(found.taken) or "nothing has changed"
                log.info("reloaded: %s", told, extra={"MESSAGE_ID": journal.RELOADED})
        except (ConfigError, OSError) as error:
            log.error("reload refused: %s", error)
        self.reloads += 1
        self._notifier.ready(self.status())

    def _adopt(self, new: Config, keys: Sequence[str]) -> None:
        rates = any(key.partition(".")[0] in sensor_tables() for key in keys)
        for name, source in self.inputs.items():
            if any(key.startswith(f"{name}.") for key in keys) or (rates and name.startswith("mavlink.")):
                source.configure(new)
                if name in self._stops:
                    self._stops[name].set()
        self.config = new
        for output in self.outputs.values():
            self._introduce(output)
        if any(key.startswith("record.") for key in keys):
            last = self._recorder
            self._open_recorder()
            if last:
                self.estimator.ask(last.close)  # which may be adding to it now

    def _open_recorder(self) -> None:
        section, self._recorder = self.config.record, None
        if section.folder is not None:
            self._recorder = Recorder(self.config.path(section.folder), section.file_mb, section.total_mb)
        self.live.record = self._recorder.add if self._recorder else None


def _run(name: str, call: Callable[..., None], *arguments: Any) -> None:
    """A call in a thread of the pool, which bears its name meanwhile."""
    thread = current_thread()
    pooled, thread.name = thread.name, name
    try:
        call(*arguments)
    finally:
        thread.name = pooled


async def _first(event: asyncio.Event, seconds: float) -> None:
    """Wait for an event, or until a time has passed."""
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return


async def serve(daemon: Daemon) -> None:
    """Run a daemon as the process's only task, under its signals: SIGTERM and SIGINT end it, SIGHUP reloads."""
    loop = asyncio.get_running_loop()
    for number, action in ((signal.SIGTERM, daemon.stop), (signal.SIGINT, daemon.stop), (signal.SIGHUP, daemon.reload)):
        loop.add_signal_handler(number, action)
    sys.setswitchinterval(SWITCH_S)
    tidying = asyncio.create_task(_tidy(daemon))
    try:
        await daemon.run()
    finally:
        tidying.cancel()
        gc.enable()


async def _tidy(daemon: Daemon) -> None:
    """Once it is up: keep the garbage collector from going through all modules again and again, for 30 ms each time, and
    from working between an instant and its state: the estimator sees to it."""
    await daemon.up.wait()
    gc.collect()
    gc.freeze()
    gc.disable()
