"""Outputs attached to a replay: those of a live run, so that a dashboard or a ROS node can be rehearsed with a log.

They are the same, but a replay waits for them: if an outbox is full, it pauses until there is room, up to PATIENCE_S, so
that nothing is lost at any speed. Messages lost after that are counted, and reported at the end.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from msgspec.structs import replace

from fusiond.app.outputs import Outputs
from fusiond.app.replay.pacer import Pacer, ReplayClock
from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.errors import OutputError
from fusiond.messages import LatencyHealth, Message
from fusiond.messages.info import config_message, info_message
from fusiond.messages.schedule import IoHealth
from fusiond.ports.outputs import LiveOutput, OutputContext
from fusiond_adapters.registry import make_outputs
from fusiond_adapters.zenoh.output import ZenohOutput

PATIENCE_S = 10.0  # longest wait for an output that takes no message

log = logging.getLogger("fusiond")


def attachable(config: Config) -> tuple[Config, list[str]]:
    """The configuration without the outputs that need a live link, and why each of these cannot be attached."""
    refused = []
    for name in ("autopilot", "ground_station"):
        section = getattr(config, name)
        if section.link is not None:
            refused.append(f"[{name}] is not attached: it sends over [mavlink.{section.link}], which a replay does not open")
            config = replace(config, **{name: replace(section, link=None)})
    return config, refused


class Attached:
    """The outputs of one replay: Zenoh, or with `everything` all that the configuration turns on. Raises ConfigError if one
    lacks its extra."""

    def __init__(self, config: Config, pacer: Pacer | None, *, everything: bool) -> None:
        self.warnings: list[str] = []
        self._config, self._paced = config, pacer is not None
        self._engine: Engine | None = None
        clock = ReplayClock(lambda: self._running.origin_ns, lambda: self._running.now_ns, pacer)
        made: list[LiveOutput]
        if everything:
            config, self.warnings = attachable(config)
            made = list(make_outputs(config, OutputContext(clock, {})).values())
        else:
            made = [ZenohOutput(config)]
        self.outputs = Outputs(made, clock.now_ns, self._introduction, self._max_pause_s, PATIENCE_S)

    @property
    def _running(self) -> Engine:
        assert self._engine is not None
        return self._engine

    def put(self, message: Message) -> None:
        """The engine's sink: put a message into every outbox."""
        self.outputs.put(message)

    def io_health(self) -> IoHealth:
        """Health of the outputs; latencies only if the replay is paced."""
        latency = LatencyHealth(published=self.outputs.handed_over.report() if self._paced else None)
        return IoHealth(latency, {}, self.outputs.health())

    @contextmanager
    def opened(self, engine: Engine) -> Iterator[None]:
        """Inside the block all outputs are open; at its end they have sent all their messages. Raises OutputError."""
        self._engine = engine
        for warning in self.warnings:
            log.warning("%s", warning)
        try:
            self.outputs.start()
            self.outputs.wait_until_tried()
            if self.outputs.failures:
                raise OutputError("; ".join(self.outputs.failures.values()))
            yield
        finally:
            self.outputs.stop()
            self.outputs.join()
        for name, count in self.outputs.unsent().items():
            if count:
                why = self.outputs.failures.get(name, f"it accepted nothing for {PATIENCE_S:g} s")
                self.warnings.append(f"{name}: {count} messages were lost: {why}")

    def _introduction(self) -> list[Message]:
        return [info_message(self._config, self._running.fusion), config_message(self._config)]

    def _max_pause_s(self) -> float:
        return self._config.live.reopen_max_s
