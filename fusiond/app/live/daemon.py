"""The daemon: `fusiond run`. Inputs, estimator and outputs, each in a thread of its own; the event loop supervises them.

The estimator's thread also feeds systemd's watchdog and enables the heartbeats, so that both stop when it does. The failure
of an input or output stops nothing else: see `supervisor`. At the end the inputs stop first; then the frames that they left
are fused, recorded and published; then the outputs stop.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Event, current_thread
from typing import Any

from fusiond.app.kernel import slow_kernel
from fusiond.app.live.estimator_thread import Estimator
from fusiond.app.live.inputs import Inputs
from fusiond.app.live.live_engine import LiveEngine
from fusiond.app.live.quiet import Quiet
from fusiond.app.outputs import Outputs
from fusiond.app.state_file import StateFile
from fusiond.config import recorded
from fusiond.config.changes import changes
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.filter.stored_state import to_text
from fusiond.messages import EventMessage, HealthMessage, LatencyHealth, Message, OutputHealth, StateMessage
from fusiond.messages.info import config_message, info_message
from fusiond.messages.schedule import IoHealth
from fusiond.ports.inputs import InputContext, LiveInput
from fusiond.ports.outputs import KeptFrame, LiveOutput, OutputContext
from fusiond_adapters.host import journal
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.host.systemd import Notifier, watchdog_s
from fusiond_adapters.logs.black_box import Recorder
from fusiond_adapters.registry import make_inputs, make_outputs

POOL = 4  # threads: the estimator's, one to write the stored state, two to wait for inputs and outputs
REPORT_S = 10.0  # between two reports of losses in the log

LEVEL = {"info": logging.INFO, "notice": logging.INFO, "warning": logging.WARNING, "critical": logging.CRITICAL}

log = logging.getLogger("fusiond")

StateSink = Callable[[StateMessage], None]


class Daemon:
    """One run. `sinks` get every published state, in the estimator's thread; `outputs` are added to those of the
    configuration; `zenoh=False` leaves out Zenoh; `load` reads the configuration again for a reload.

    Raises ConfigError if the configuration does not fit its dialects, or an output lacks its extra.
    """

    def __init__(
        self,
        config: Config,
        load: Callable[[], Config] | None = None,
        sinks: Sequence[StateSink] = (),
        outputs: Sequence[LiveOutput] = (),
        *,
        zenoh: bool = True,
        clock: HostClock | None = None,
    ) -> None:
        self.config = config
        self.clock = clock or HostClock()
        self._state_file, stored_state = None, None
        if config.state.file is not None:
            self._state_file = StateFile(config.path(config.state.file), config, self.clock.now_ns())
            stored_state = self._state_file.stored
        self.live = LiveEngine(
            config, self.clock.now_ns, self._publish, self._io_health, stored_state=stored_state
        )
        self._wake = Event()  # wakes the estimator
        self.inputs = Inputs(self._make_inputs(config), self._max_pause_s, self.stop)
        frame = self._state_file.frame if self._state_file else KeptFrame()
        made = make_outputs(config, OutputContext(self.clock, self.inputs, frame)) | {one.name: one for one in outputs}
        if not zenoh:
            del made["zenoh"]
        self.outputs = Outputs(made.values(), self.clock.now_ns, self._introduction, self._max_pause_s)
        self.published = self.reloads = 0
        self.up = asyncio.Event()  # every input is prepared, and every output has been tried
        self.health: HealthMessage | None = None  # the latest
        self.estimator = Estimator(self.live, self.inputs, self.clock, self._wake, self._after_step)
        self._quiet = Quiet(self.inputs, self.live.engine.health, self._publish, self.clock.now_ns)
        self._load, self._sinks = load, sinks
        self._stopping = Event()
        self._over = asyncio.Event()  # the estimator has ended
        self._recorders: list[Recorder] = []  # of this run, one after the other
        self._refused: str | None = None  # why the last reload was refused
        self._mode: str | None = None
        self._logged: dict[str, int] = {}  # losses as last logged
        self._notifier = Notifier()
        self._feed_s = watchdog_s()
        self._next_feed_s = self._next_report_s = 0.0  # monotonic

    def stop(self) -> None:
        """Request the end. From any thread."""
        if not self._stopping.is_set():
            self._stopping.set()
            self._notifier.stopping()
        self.inputs.stop()

    async def run(self) -> None:
        """Run until `stop` is called. Raises OSError if the black box's folder cannot be created, ConfigError if the
        configuration does not fit its DBC files; readiness is then never reported."""
        self._record_with(self._make_recorder(self.config))
        if self.live.record and self._state_file and self._state_file.stored:
            self.live.record("state.json", self.clock.now_ns(), to_text(self._state_file.stored))
        executor = ThreadPoolExecutor(max_workers=POOL, thread_name_prefix="fusiond")
        try:
            self.inputs.start()
            self.outputs.start()
            async with asyncio.TaskGroup() as group:
                group.create_task(self._come_up(executor))
                group.create_task(self._estimate(executor))
                group.create_task(_in_thread(executor, self._finish_after_inputs))
                if self._state_file:
                    group.create_task(self._keep_state(self._state_file, executor), name="state file")
        finally:
            self.inputs.stop()
            self.estimator.finish()
            self.outputs.stop()
            executor.shutdown(wait=True)
            self.inputs.join()
            self.outputs.join()
            for recorder in self._recorders:
                recorder.close()
            self._notifier.close()
        if self.inputs.fault:
            raise self.inputs.fault
        log.info("ended: %s", self.status(), extra={"MESSAGE_ID": journal.ENDED})

    def _make_inputs(self, config: Config) -> dict[str, LiveInput[Any]]:
        return make_inputs(config, InputContext(self.clock, self._wake.set, self._is_alive))

    def _is_alive(self) -> bool:
        return self.estimator.is_alive()

    def _max_pause_s(self) -> float:
        return self.config.live.reopen_max_s

    async def _come_up(self, executor: ThreadPoolExecutor) -> None:
        await _in_thread(executor, self.inputs.wait_until_prepared)
        await _in_thread(executor, self.outputs.wait_until_tried)
        if self.inputs.fault:
            return
        self.up.set()
        self._notifier.ready(self.status())
        parts = [one.about for one in self.inputs.values()] + [one.about for one in self.outputs.values()]
        log.info("up: %s", ", ".join(parts), extra={"MESSAGE_ID": journal.STARTED})
        if slow := slow_kernel():
            log.warning("%s", slow)

    # --- The estimator

    async def _estimate(self, executor: ThreadPoolExecutor) -> None:
        """Run the estimator to its end, then let the outputs send the rest."""
        try:
            await _in_thread(executor, self._run_estimator)
        finally:
            self._over.set()
            self.outputs.stop()
        await _in_thread(executor, self.outputs.join)

    def _run_estimator(self) -> None:
        thread = current_thread()
        pooled, thread.name = thread.name, "estimator"
        try:
            self.estimator.run()
        finally:
            thread.name = pooled

    def _finish_after_inputs(self) -> None:
        self.inputs.join()
        self.estimator.finish()

    def _after_step(self) -> None:
        """Called in the estimator's thread, which alone feeds the watchdog."""
        now_s = time.monotonic()
        if self._feed_s is not None and now_s >= self._next_feed_s:
            self._next_feed_s = now_s + self._feed_s / 2
            self._notifier.alive(self.status())
        if now_s >= self._next_report_s:
            self._next_report_s = now_s + REPORT_S
            self._report_losses()
            log.debug("%s", self.status())
        self._quiet.after_step(self.health)

    # --- The stored state

    async def _keep_state(self, file: StateFile, executor: ThreadPoolExecutor) -> None:
        """Store the newest state periodically and at the end, in a thread: a disk may be slow. The last run's is stored
        again at once, with the reset_counter of this run: the next one begins with another even if this one dies early."""
        over = False
        if file.stored is not None and file.stored.reset_counter != file.frame.reset_counter:
            await asyncio.get_running_loop().run_in_executor(executor, file.write, file.stored)
        while not over:
            await _first(self._over, self.config.state.every_s)
            over = self._over.is_set()
            newest = await asyncio.wrap_future(self.estimator.ask(self.live.engine.fusion.to_store))
            if newest is not None:
                await asyncio.get_running_loop().run_in_executor(executor, file.write, newest)

    # --- Publication

    def _publish(self, message: Message) -> None:
        """The engine's sink: pass a message to every output, and log events."""
        if isinstance(message, StateMessage):
            for sink in self._sinks:
                sink(message)
            self.published += 1
            self._mode = message.mode.value
        elif isinstance(message, HealthMessage):
            self.health = message
        elif isinstance(message, EventMessage):
            log.log(LEVEL[message.severity], "%s", message.text, extra=journal.about(message.kind, message.subject))
        self.outputs.put(message)

    def _introduction(self) -> list[Message]:
        """The messages sent once, to every output that opens."""
        return [info_message(self.config, self.live.engine.fusion), config_message(self.config)]

    # --- Status, reload

    def status(self) -> str:
        """The status in one line."""
        latency = self.outputs.handed_over.report()
        late = "" if latency is None else f", latency p50 {latency.p50:g} ms p99 {latency.p99:g} ms"
        refused = f"; reload refused: {self._refused}" if self._refused else ""
        return f"{self._mode or 'no data yet'}, {self.live.offered} measurements, {self.published} published{late}{refused}"

    def _io_health(self) -> IoHealth:
        """Health of inputs and outputs, and latencies, for the health message."""
        outputs = self.outputs.health()
        if self._recorders:
            written, lost, removed = (sum(counts) for counts in zip(*(one.counts() for one in self._recorders), strict=True))
            notes = {"error": error} if (error := self._recorders[-1].error) else {}
            counts = {"records written": written, "own files removed": removed}
            outputs["record"] = OutputHealth(offered=written + lost, dropped=lost, counts=counts, notes=notes)
        if file := self._state_file:
            outputs["state"] = file.health(self.live.engine.fusion.hot_start())
        latency = LatencyHealth(fused=self.live.to_fusion.report(), published=self.outputs.handed_over.report())
        return IoHealth(latency, self.inputs.health(), outputs)

    def losses(self) -> dict[str, int]:
        """Counts of everything lost so far, by kind."""
        found = {f"{key} frames dropped": one.inbox.dropped for key, one in self.inputs.items()}
        found |= {f"{key} frames lost before receipt": one.inbox.missed for key, one in self.inputs.items()}
        found |= {f"{name} messages dropped": dropped for name, dropped in self.outputs.dropped().items()}
        found["stamps moved"] = self.live.moved
        found["states not stored"] = self._state_file.lost if self._state_file else 0
        found["records lost"] = sum(one.lost for one in self._recorders)
        found["files of this very recording removed"] = sum(one.removed for one in self._recorders)
        return found

    def _report_losses(self) -> None:
        """Log the losses since the last report."""
        losses = self.losses()
        new = {name: count - self._logged.get(name, 0) for name, count in losses.items() if name != "stamps moved"}
        text = ", ".join(f"{count} {name}" for name, count in new.items() if count)
        if text:
            disks = (("black box", self._recorders[-1] if self._recorders else None), ("state file", self._state_file))
            why = "".join(f"; {name}: {disk.error}" for name, disk in disks if disk and disk.error)
            log.warning("in the last %g s: %s%s", REPORT_S, text, why, extra={"MESSAGE_ID": journal.DATA_LOST})
        self._logged = losses

    def reload(self) -> None:
        """Apply the changes of the configuration file that can be made live. If there is any other change, or any error,
        nothing changes at all."""
        if self._load is None:
            return
        self._notifier.reloading()
        try:
            self._refused = self._reload(self._load)
        except (ConfigError, OSError) as error:
            self._refused = str(error)
        except Exception as fault:  # the daemon goes on with what it has, whatever is wrong with the new configuration
            self._refused = f"failed: {fault!r}"
            log.exception("reload failed")
        finally:
            if self._refused:
                log.error("reload refused: %s", self._refused)
            self.reloads += 1
            self._notifier.ready(self.status())

    def _reload(self, load: Callable[[], Config]) -> str | None:
        """Returns why the changes are refused, if they are. Whatever can fail comes before the first change."""
        new = load()
        found = changes(self.config, new)
        if found.refused:
            return f"a restart is needed to change {', '.join(found.refused)}"
        inputs = self._make_inputs(new)
        for one in inputs.values():
            one.prepare()
        record = any(key.startswith("record.") for key in found.taken)
        recorder = self._make_recorder(new) if record else None
        self.config = new
        self.inputs.adopt(inputs, found.taken)
        if record:
            self.estimator.ask(lambda: self._record_with(recorder))
        self.outputs.introduce()
        log.info("reloaded: %s", ", ".join(found.taken) or "nothing has changed", extra={"MESSAGE_ID": journal.RELOADED})
        return None

    def _make_recorder(self, config: Config) -> Recorder | None:
        """The recorder of a configuration, which it keeps first; None if nothing shall be recorded. Raises OSError."""
        section = config.record
        if section.folder is None:
            return None
        beside, now_ns = list(recorded.files(config)), self.clock.now_ns()
        recorder = Recorder(config.path(section.folder), section.file_mb, section.total_mb)
        for name, content in beside:
            recorder.add(name, now_ns, content)
        return recorder

    def _record_with(self, recorder: Recorder | None) -> None:
        """Record with another recorder from now on, or not at all. Not while the estimator may be adding to the last one."""
        if self._recorders:
            self._recorders[-1].end()
        if recorder:
            self._recorders.append(recorder)
        self.live.record = recorder.add if recorder else None


async def _in_thread(executor: ThreadPoolExecutor, call: Callable[[], None]) -> None:
    await asyncio.get_running_loop().run_in_executor(executor, call)


async def _first(event: asyncio.Event, seconds: float) -> None:
    """Wait for an event, at most for a time."""
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return
