"""What the daemon tells while it hears nothing: its health, and in the log which inputs bring nothing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Set

from fusiond.app.live.inputs import Inputs
from fusiond.messages import HealthMessage, Message
from fusiond.units import SECOND

CHECK_NS = SECOND
SILENT_NS = 2 * SECOND  # without a health message for this long, one is made here: ticks pause while no event comes
FIRST_S = 5.0  # an open input that has brought nothing for this long is logged
RARER = 10  # each further line about it comes after so many times the silence

log = logging.getLogger("fusiond")


class Quiet:
    """Called between the estimator's steps. `health` makes a health message of an instant; `now` reads the clock [ns]."""

    def __init__(
        self,
        inputs: Inputs,
        health: Callable[[int], HealthMessage | None],
        sink: Callable[[Message], None],
        now: Callable[[], int],
    ) -> None:
        self._inputs, self._health, self._sink, self._now = inputs, health, sink, now
        self._silences = Silences()
        self._began_ns = self._checked_ns = now()

    def after_step(self, last: HealthMessage | None) -> None:
        """Tell what is due; `last` is the latest health message published."""
        now_ns = self._now()
        if now_ns - self._checked_ns < CHECK_NS:
            return
        self._checked_ns = now_ns
        if now_ns - (self._began_ns if last is None else last.t_ns) >= SILENT_NS and (made := self._health(now_ns)):
            self._sink(made)
        received = {key: one.inbox.received for key, one in self._inputs.items()}
        for key, silent_s in self._silences.told(now_ns / SECOND, self._inputs.open, received):
            text = "%s: nothing heard for %.0f s; is the sender on, and does it send here?"
            log.warning(text, self._inputs[key].about, silent_s, extra={"FUSIOND_SOURCE": key})


class Silences:
    """How long each open input has been silent, told more and more rarely."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, float]] = {}  # frames received, and when the last came [s]
        self._due_s: dict[str, float] = {}  # the silence that is told next

    def told(self, now_s: float, open_keys: Set[str], received: Mapping[str, int]) -> Iterator[tuple[str, float]]:
        """The inputs whose silence is to be told now, and how long it is [s]. One that is not open is told elsewhere."""
        for key, count in received.items():
            if key not in open_keys or self._last.get(key, (-1, 0.0))[0] != count:
                self._last[key], self._due_s[key] = (count if key in open_keys else -1, now_s), FIRST_S
            elif now_s - self._last[key][1] >= self._due_s[key]:
                self._due_s[key] *= RARER
                yield key, now_s - self._last[key][1]
