"""Keeps an input or output open: opens it again whenever it is lost, after pauses that grow until a session lasts."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from threading import Event
from typing import Protocol

from fusiond.ports.inputs import InputLost
from fusiond.ports.outputs import OutputLost
from fusiond_adapters.host import journal

FIRST_PAUSE_S = 0.1  # before a lost session is opened again; doubled each time
STEADY_S = 10.0  # after a session of this length the pauses start again with the first

log = logging.getLogger("fusiond")


class Named(Protocol):
    """An input or output."""

    name: str
    about: str  # description for users


def keep_open(
    what: Named,
    session: Callable[[], None],
    over: Event,
    max_pause_s: Callable[[], float],
    on_lost: Callable[[str], None] = lambda _: None,
) -> None:
    """Call `session` repeatedly until `over` is set; `on_lost` is called with the reason when one fails. Each new reason is
    logged once. No exception of a session is passed on."""
    pause, logged = FIRST_PAUSE_S, ""
    while not over.is_set():
        began = time.monotonic()
        try:
            session()
            pause, logged = FIRST_PAUSE_S, ""  # ended on request
            continue
        except (InputLost, OutputLost) as lost:
            reason = str(lost)
        except Exception as fault:  # a fault in a driver must not stop anything else; it is logged with its traceback
            reason = f"failed: {fault!r}"
            log.exception("%s failed", what.about, extra={"FUSIOND_SOURCE": what.name})
        on_lost(reason)
        if time.monotonic() - began > STEADY_S:
            pause, logged = FIRST_PAUSE_S, ""
        if reason != logged:
            about = {"FUSIOND_SOURCE": what.name, "MESSAGE_ID": journal.CONNECTION_LOST}
            log.warning("%s: %s; trying again", what.about, reason, extra=about)
            logged = reason
        over.wait(pause)
        pause = min(2 * pause, max_pause_s())
