"""The fan-out: every message of a run to all of its outputs. A live run and a replay each own one.

Each output sends from its outbox in a thread of its own, and is opened again when it is lost. In a live run nothing waits
for it: a full outbox drops its oldest message and counts it. A replay waits for room, up to a limit. After `stop` each
output sends the rest of its outbox and ends.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from threading import Event, Thread

from fusiond.app.supervisor import keep_open
from fusiond.messages import Message, OutputHealth, StateMessage
from fusiond.messages.latency import RecentLatencies
from fusiond.ports.outputs import LiveOutput

log = logging.getLogger("fusiond")


class Outputs(Mapping[str, LiveOutput]):
    """The outputs of one run, by name.

    `now` reads the clock of the stamps. `introduction` makes the messages that are sent once, whenever an output has been
    opened. `max_pause_s` limits the pauses before a lost output is opened again. `patience_s` is how long a message may wait
    for room in an outbox: 0 in a live run.
    """

    def __init__(
        self,
        outputs: Iterable[LiveOutput],
        now: Callable[[], int],
        introduction: Callable[[], Iterable[Message]],
        max_pause_s: Callable[[], float],
        patience_s: float = 0.0,
    ) -> None:
        self.handed_over = RecentLatencies()  # from the instant of a state until it is in every outbox
        self.failures: dict[str, str] = {}  # by name: why an output is not open
        self._outputs = {output.name: output for output in outputs}
        self._now, self._introduction, self._max_pause_s = now, introduction, max_pause_s
        self._stop = Event()
        self._tried = {name: Event() for name in self._outputs}
        self._threads = [
            Thread(target=self._keep, args=(output,), name=output.name) for output in self._outputs.values()
        ]
        for output in self._outputs.values():
            output.outbox.patience_s = patience_s

    def __getitem__(self, name: str) -> LiveOutput:
        return self._outputs[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outputs)

    def __len__(self) -> int:
        return len(self._outputs)

    def put(self, message: Message) -> None:
        """Put a message into the outbox of every output that accepts its kind."""
        for output in self._outputs.values():
            output.outbox.put(message)
        if isinstance(message, StateMessage):
            self.handed_over.add(max(0, self._now() - message.t_ns))

    def introduce(self) -> None:
        """Send the introduction to all outputs again."""
        for output in self._outputs.values():
            self._introduce(output)

    # --- Sessions

    def start(self) -> None:
        """Open all outputs, each in a thread of its own."""
        for thread in self._threads:
            thread.start()

    def wait_until_tried(self) -> None:
        """Wait until each output is open or could not be opened: see `failures`."""
        for event in self._tried.values():
            event.wait()

    def stop(self) -> None:
        """No more messages will come: each output sends the rest of its outbox and ends. From any thread."""
        self._stop.set()
        for output in self._outputs.values():
            output.outbox.rouse()

    def join(self) -> None:
        """Wait until all have ended, after `stop`."""
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def _keep(self, output: LiveOutput) -> None:
        tried = self._tried[output.name]

        def opened() -> None:
            self.failures.pop(output.name, None)
            self._introduce(output)
            tried.set()

        def session() -> None:
            output.outbox.attend(self._now, opened)
            output.session(self._stop)

        def lost(reason: str) -> None:
            self.failures[output.name] = reason
            tried.set()

        try:
            keep_open(output, session, self._stop, self._max_pause_s, lost)
        finally:
            tried.set()

    def _introduce(self, output: LiveOutput) -> None:
        for message in self._introduction():
            output.outbox.put(message, may_wait=False)

    # --- Counts

    def health(self) -> dict[str, OutputHealth]:
        """The published health of each output."""
        return {
            name: OutputHealth(
                offered=output.outbox.offered,
                dropped=output.outbox.dropped,
                latency_ms=output.outbox.latency.report(),
                counts=output.counts(),
                notes=output.notes(),
            )
            for name, output in self._outputs.items()
        }

    def dropped(self) -> dict[str, int]:
        """Messages dropped for lack of room, by output."""
        return {name: output.outbox.dropped for name, output in self._outputs.items()}

    def unsent(self) -> dict[str, int]:
        """After the end: messages that were dropped or are still in an outbox, by output."""
        return {name: output.outbox.dropped + output.outbox.waiting for name, output in self._outputs.items()}
