"""The inputs of the daemon: each is prepared, opened and read in a thread of its own, and opened again when it is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import Event, Thread
from typing import Any

from fusiond.app.supervisor import keep_open
from fusiond.config.schema import sensor_tables
from fusiond.messages import InputHealth
from fusiond.ports.inputs import LiveInput


class Inputs(Mapping[str, LiveInput[Any]]):
    """The inputs of one run, by section and name. `max_pause_s` limits the pauses before a lost input is opened again;
    `on_fault` is called in an input's thread when it cannot be prepared: see `fault`."""

    def __init__(
        self, inputs: Mapping[str, LiveInput[Any]], max_pause_s: Callable[[], float], on_fault: Callable[[], None]
    ) -> None:
        self.fault: BaseException | None = None  # the exception of one that could not be prepared, such as a ConfigError
        self._inputs, self._max_pause_s, self._on_fault = dict(inputs), max_pause_s, on_fault
        self._over = Event()
        self._stops = {key: Event() for key in self._inputs}  # ends the present session of an input
        self._prepared = {key: Event() for key in self._inputs}
        self.open: set[str] = set()  # those with a session now
        self._threads = [Thread(target=self._keep, args=(key,), name=key) for key in self._inputs]

    def __getitem__(self, key: str) -> LiveInput[Any]:
        return self._inputs[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._inputs)

    def __len__(self) -> int:
        return len(self._inputs)

    # --- Sessions

    def start(self) -> None:
        """Prepare and open all inputs, each in a thread of its own."""
        for thread in self._threads:
            thread.start()

    def wait_until_prepared(self) -> None:
        """Wait until each is prepared or could not be prepared."""
        for event in self._prepared.values():
            event.wait()

    def stop(self) -> None:
        """Close all inputs. From any thread."""
        self._over.set()
        for event in self._stops.values():
            event.set()

    def join(self) -> None:
        """Wait until all have ended, after `stop`."""
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def adopt(self, fresh: Mapping[str, LiveInput[Any]], keys: Sequence[str]) -> None:
        """Use the settings of inputs made with a new configuration, of which `keys` changed: the inputs concerned are opened
        again. Cannot fail."""
        rates = any(key.partition(".")[0] in sensor_tables() for key in keys)
        for name, one in self._inputs.items():
            if any(key.startswith(f"{name}.") for key in keys) or (rates and name.startswith("mavlink.")):
                one.adopt(fresh[name])
                self._stops[name].set()

    def _keep(self, key: str) -> None:
        one = self._inputs[key]

        def session() -> None:
            stop = self._stops[key] = Event()
            if self._over.is_set():  # it may have been set before this event existed
                return
            self.open.add(key)
            try:
                one.session(stop)
            finally:
                self.open.discard(key)

        try:
            one.prepare()
        except Exception as fault:  # of the configuration or a driver: the daemon ends and raises it
            self.fault = fault
            self._on_fault()
        finally:
            self._prepared[key].set()
        keep_open(one, session, self._over, self._max_pause_s)

    # --- Counts

    def health(self) -> dict[str, InputHealth]:
        """The published health of each input."""
        return {
            key: InputHealth(received=one.inbox.received, dropped=one.inbox.dropped, counts=one.counts())
            for key, one in self._inputs.items()
        }
