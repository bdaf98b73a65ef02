"""The live input of one MAVLink link: frames from a transport into the inbox, and messages from fusiond to the peer."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from threading import Event, Lock
from typing import Any

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError, all_made
from fusiond.events import Received
from fusiond.ports.clock import Clock
from fusiond.ports.inputs import POLL_S, Inbox, InputContext, InputLost, LiveInput
from fusiond.units import SECOND
from fusiond_adapters.mavlink.decoder import MavlinkDecoder, PeerSplitter, message_id
from fusiond_adapters.mavlink.housekeeping import Housekeeping
from fusiond_adapters.mavlink.signing import is_signed
from fusiond_adapters.mavlink.tlog_record import tlog_record
from fusiond_adapters.mavlink.transport import IN_KERNEL, Transport, opener

PAUSE_S = 0.001  # after a read that stopped at its limit

log = logging.getLogger("fusiond")


class MavlinkLink:
    """One [mavlink.NAME]. `alive` returns whether the estimator works: heartbeats are sent only then. `listeners` are called
    with every received frame and its stamp, in the link's thread: they must not wait.

    Raises ConfigError for a wrong connection string, or where the dialect lacks a wanted message.
    """

    def __init__(
        self, config: Config, link: str, inbox: Inbox[bytes], clock: Clock, alive: Callable[[], bool]
    ) -> None:
        self.name = link
        self.file = f"{link}.tlog"
        self.inbox = inbox
        self.decoder = MavlinkDecoder(config, link)
        self.listeners: list[Callable[[bytes, int], None]] = []
        self.sessions = self.skipped_bytes = self.sent = 0
        self._counts: Counter[str] = Counter()  # of the transports of all sessions
        self._clock, self._alive = clock, alive
        self._sending = Lock()  # guards packing, and the transport while it is written to
        self._transport: Transport | None = None
        settings = config.mavlink[link]
        try:
            self._open = opener(settings.connection, settings.baud)
        except ValueError as error:
            raise ConfigError(f"mavlink.{link}.connection: {error}") from error
        self.about = f"MAVLink {link} ({settings.connection})"
        self.housekeeping = Housekeeping(config, link)

    def adopt(self, fresh: MavlinkLink) -> None:
        """Use connection, own ids and requests of another link from the next session on."""
        self._open, self.about, self.housekeeping = fresh._open, fresh.about, fresh.housekeeping

    def prepare(self) -> None:
        """Nothing to load."""

    def session(self, stop: Event) -> None:
        """Open the link, read it until `stop` is set, close it. Raises InputLost."""
        try:
            transport = self._open()
        except OSError as error:
            raise InputLost(f"cannot be opened: {_reason(error)}") from error
        self.sessions += 1
        try:
            self._transport = transport
            self._serve(transport, stop)
        except (OSError, EOFError) as error:
            raise InputLost(f"lost: {_reason(error)}") from error
        finally:
            with self._sending:
                self._transport = None
                transport.close()

    def send(self, message: Any, sender: Any = None) -> bool:
        """Send a pymavlink message, from any thread, as fusiond or as another `sender` (a pymavlink MAVLink). Never waits
        for the peer. False: the link is closed or full, and the message is lost."""
        with self._sending:
            if self._transport is None:
                return False
            try:
                taken = self._transport.write(self.housekeeping.pack(message, sender))
            except (OSError, EOFError):
                return False  # the link's own thread detects the loss
            self.sent += taken
            return taken

    def _serve(self, transport: Transport, stop: Event) -> None:
        splitter = PeerSplitter(self.decoder.dialect, datagrams=transport.datagrams)
        skipped_before, counts_before = self.skipped_bytes, self._counts
        try:
            while not stop.is_set():
                self._receive(transport, splitter)
                self.skipped_bytes = skipped_before + splitter.skipped_bytes
                counts = Counter(counts_before)
                counts.update(transport.counts)
                self._counts, self.inbox.missed = counts, counts[IN_KERNEL]
                while self.housekeeping.changes:
                    log.info("%s: %s", self.about, self.housekeeping.changes.pop(0))
                with self._sending:
                    for frame in self.housekeeping.due(self._clock.now_ns(), alive=self._alive()):
                        self.sent += transport.write(frame)
                if transport.more:  # a flood: leave the processor to the estimator; the kernel counts what it drops
                    time.sleep(PAUSE_S)
        finally:
            self.skipped_bytes = skipped_before + splitter.skipped_bytes + splitter.waiting_bytes

    def _receive(self, transport: Transport, splitter: PeerSplitter) -> None:
        """Read what is there, after waiting for it, and pass on its frames."""
        wait_s = self.housekeeping.wait_ns(self._clock.now_ns()) / SECOND  # a request does not wait for data
        chunks = transport.read(min(POLL_S, wait_s))
        t_ns = self._clock.now_ns()
        for data, peer in chunks:
            valid = False
            for frame in splitter.feed(data, peer):
                valid |= self._take(frame, t_ns)
            if valid:
                transport.heard(peer)

    def _take(self, frame: bytes, t_ns: int) -> bool:
        """Pass on a frame, unless its signature is wrong. Whether its sender has shown that it is one: by a checksum whose
        seed is known; where signing is on, by a signature."""
        signing = self.housekeeping.signing
        if signing and not signing.accepts(frame):
            return False
        self.inbox.put(t_ns, frame)
        with self._sending:  # it may pack a reply
            self.housekeeping.receive(frame, t_ns)
        for listen in self.listeners:
            listen(frame, t_ns)
        return is_signed(frame) if signing else self.decoder.dialect.knows(message_id(frame))

    def decode(self, item: bytes, t_ns: int) -> list[Received]:
        """The events in a frame."""
        return self.decoder.decode(item, t_ns)

    def record(self, item: bytes, t_ns: int) -> bytes:
        """A record of a .tlog."""
        return tlog_record(item, t_ns)

    def counts(self) -> dict[str, int]:
        """Counts of frames and of the link so far."""
        own = {"sessions": self.sessions, "garbage bytes": self.skipped_bytes, "sent": self.sent, **self._counts}
        asked = self.housekeeping.wanted.items()
        requests = {f"asked for {name}": wanted.requests for name, wanted in asked}
        denials = {f"denied {name}": wanted.denials for name, wanted in asked if wanted.denials}
        rates = {f"Hz of {name}": round(wanted.measured_hz or 0) for name, wanted in asked}
        signing = self.housekeeping.signing.counts if self.housekeeping.signing else {}
        own["reboots"] = self.housekeeping.reboots
        return {**own, **requests, **denials, **rates, **signing, **self.decoder.counts}


def make(config: Config, context: InputContext) -> Sequence[LiveInput[Any]]:
    """The link of each [mavlink.NAME]."""

    def link(name: str) -> MavlinkLink:
        inbox: Inbox[bytes] = Inbox(config.live.queue_frames, context.wake, message_id)
        return MavlinkLink(config, name, inbox, context.clock, context.is_alive)

    return all_made(partial(link, name) for name in config.mavlink)


def link_of(inputs: Mapping[str, LiveInput[Any]], name: str) -> MavlinkLink:
    """The link [mavlink.NAME] among the inputs of a run."""
    link = inputs[f"mavlink.{name}"]
    assert isinstance(link, MavlinkLink)
    return link


def _reason(error: OSError | EOFError) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
