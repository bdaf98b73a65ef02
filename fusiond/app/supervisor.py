"""Keeps an input or output open: opens it again whenever it is lost, after pauses that grow as long as it does not last."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from threading import Event
from typing import Protocol

from fusiond.ports.inputs import InputLost
from fusiond.ports.outputs import OutputLost
from fusiond_adapters.host import journal

FIRST_PAUSE_S = 0.1  # before what was lost is opened again; doubled each time
STEADY_S = 10.0  # what lasted this long begins anew with the first pause

log = logging.getLogger("fusiond")


class Named(Protocol):
    """What is kept open."""

    name: str
    about: str  # for people


def keep_open(
    what: Named,
    session: Callable[[], None],
    over: Event,
    max_pause_s: Callable[[], float],
    on_lost: Callable[[str], None] = lambda _: None,
) -> None:
    """Call `session` again and again until `over` is set; `on_lost` is called with the reason why one failed. The log has
    one line for each new reason. Nothing that a session raises goes any further."""
    pause, complaint = FIRST_PAUSE_S, ""
    while not over.is_set():
        began = time.monotonic()
        try:
            session()
            pause, complaint = FIRST_PAUSE_S, ""  # asked to end
            continue
        except (InputLost, OutputLost) as lost:
            reason = str(lost)
        except Exception as fault:  # a driver's fault must take nothing else down; it is logged whole
            reason = f"failed: {fault!r}"
            log.exception("%s failed", what.about, extra={"FUSIOND_SOURCE": what.name})
        on_lost(reason)
        if time.monotonic() - began > STEADY_S:
            pause, complaint = FIRST_PAUSE_S, ""
        if reason != complaint:
            about = {"FUSIOND_SOURCE": what.name, "MESSAGE_ID": journal.CONNECTION_LOST}
            log.warning("%s: %s; trying again", what.about, reason, extra=about)
            complaint = reason
        over.wait(pause)
        pause = min(2 * pause, max_pause_s())
