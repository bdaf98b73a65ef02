"""Zenoh as a live output: publishes messages in a thread of its own, states directly, and answers queries.

A state is published in the estimator's thread: waking another thread would delay it, on a busy machine more than anything
else. Zenoh only queues the state, and drops it if the queue is full. In a replay everything goes through the outbox in
order, and Zenoh waits for its readers.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from threading import Event

import zenoh

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.messages.types import MESSAGES, HealthMessage, InnovationMessage, Message, StateAtInstant, StateMessage
from fusiond.ports.outputs import POLL_S, LiveOutput, Outbox, OutputContext, OutputLost
from fusiond_adapters.zenoh.queries import Answers
from fusiond_adapters.zenoh.session import LAST_SAMPLE_S, PublishError, ZenohPublisher, open_session, session_config
from fusiond_adapters.zenoh.words import in_words

QUEUE_MESSAGES = 1024  # a second of everything, and more
READER_S = 0.002  # time of a slow reader for a message, at the end of a replay: see _linger
MIN_LINGER_S, MAX_LINGER_S = LAST_SAMPLE_S + 0.2, 5.0  # Zenoh's queues have some thousands of messages
KINDS = ("router", "peer", "client")  # zenoh.WhatAmI, as text


class ZenohOutput:
    """[zenoh] of a configuration. In a live run it never waits for a reader, and counts the messages that it cannot send."""

    def __init__(self, config: Config) -> None:
        self.name = "zenoh"
        section = config.zenoh
        self.about = f"Zenoh ({', '.join([section.mode, *section.listen, *section.connect])})"
        self.outbox = Outbox(QUEUE_MESSAGES, tuple(MESSAGES.values()))
        self.sessions = self.stale = 0
        self._sent = self._sent_at_once = 0  # by the output's thread and by the estimator's
        self._read_s = 0.0  # monotonic: when a slow reader would have read all messages sent
        self.answers = Answers(config)
        self._config = config
        self._notes: dict[str, str] = {}

    def session(self, stop: Event) -> None:
        """Open a session, publish until `stop` is set, close. Raises OutputLost."""
        config, lossless = self._config, self.outbox.patience_s > 0
        try:
            with (
                open_session(config.zenoh, config.directory, patient=lossless) as session,
                ZenohPublisher(session, config.vehicle.name, config.publish.encoding, lossless=lossless) as publisher,
                self.answers.declared(session),
            ):
                self.sessions += 1
                self._serve(session, publisher, stop)
        except PublishError as error:
            raise OutputLost(str(error)) from error
        except zenoh.ZError as error:
            raise OutputLost(f"zenoh: {in_words(error)}") from error
        finally:
            self.outbox.at_once = None
            self._notes = {"session": "closed"}

    def _serve(self, session: zenoh.Session, publisher: ZenohPublisher, stop: Event) -> None:
        self.outbox.at_once = partial(self._send_at_once, publisher)
        for message in self.outbox.take(0):  # messages queued while it was closed go first, so states stay in order
            if isinstance(message, StateAtInstant | InnovationMessage) and not self.outbox.patience_s:
                self.stale += 1
            else:
                self._send(publisher, message)
        self._update_notes(session)
        stopping = False
        while not stopping:
            stopping = stop.is_set()  # read before the last poll, so that no message is missed
            for message in self.outbox.take(0 if stopping else POLL_S):
                self._send(publisher, message)
                if isinstance(message, HealthMessage):  # about each second: update the notes for the next one
                    self._update_notes(session)
        if self.outbox.patience_s:
            self._linger(publisher)

    def _linger(self, publisher: ZenohPublisher) -> None:
        """Closing a session drops the messages that its readers have not read yet, and Zenoh does not report which: wait as
        long as a reader that needs READER_S for each message needs for all of them."""
        longest_s = MAX_LINGER_S if publisher.matched else MIN_LINGER_S
        time.sleep(min(longest_s, max(MIN_LINGER_S, self._read_s - time.monotonic())))

    def _update_notes(self, session: zenoh.Session) -> None:
        """Count who is connected, clients too. This may wait for Zenoh, so the estimator's thread must not do it."""
        kinds = Counter(str(transport.whatami) for transport in session.info.transports())
        connected = [_counted(kinds[kind], kind) for kind in KINDS]
        self._notes = {"session": f"{', '.join(connected)} connected"}

    def _send(self, publisher: ZenohPublisher, message: Message) -> None:
        publisher.publish(message)
        self.answers.keep(message)
        self._sent += 1
        self._read_s = max(self._read_s, time.monotonic()) + READER_S

    def _send_at_once(self, publisher: ZenohPublisher, state: StateMessage) -> bool:
        try:
            publisher.publish(state)
        except PublishError:
            return False  # the output's own thread detects the loss
        self.answers.keep(state)
        self._sent_at_once += 1
        return True

    @property
    def sent(self) -> int:
        """Number of messages sent."""
        return self._sent + self._sent_at_once

    def counts(self) -> dict[str, int]:
        """Messages sent, stale messages, sessions, and queries answered."""
        return {"sent": self.sent, "stale": self.stale, "sessions": self.sessions, "answered": self.answers.answered}

    def notes(self) -> dict[str, str]:
        """The number of routers, peers and clients connected."""
        return self._notes


def _counted(number: int, kind: str) -> str:
    return f"{number} {kind}{'' if number == 1 else 's'}"


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration. Raises ConfigError for one that Zenoh does not take."""
    try:
        session_config(config.zenoh, config.directory)
    except PublishError as error:
        raise ConfigError(str(error)) from error
    return [ZenohOutput(config)]
