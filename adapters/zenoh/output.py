"""Zenoh as a live output: publishes every message in a thread of its own, but states at once, and answers queries.

A state goes out in the estimator's thread: handing it to another one would make it later by the time that takes to wake,
which on a busy machine is what a state loses most by. Zenoh only queues it, and where the queue is full drops it. A replay
has patience instead: everything goes through the outbox, in order, and Zenoh waits for its readers.
"""

from __future__ import annotations

import time
from functools import partial
from threading import Event

import zenoh

from fusiond.config.schema import Config
from fusiond.messages.types import MESSAGES, HealthMessage, InnovationMessage, Message, StateAtInstant, StateMessage
from fusiond.ports.outputs import POLL_S, Outbox, OutputLost
from fusiond_adapters.zenoh.queries import Answers
from fusiond_adapters.zenoh.session import TELL_LAST_S, PublishError, ZenohPublisher, open_session

QUEUE_MESSAGES = 1024  # a second of everything, and more
READER_S = 0.002  # that a reader may take for a message at the end of a replay, see _linger
MIN_LINGER_S, MAX_LINGER_S = TELL_LAST_S + 0.2, 5.0  # all that waits in Zenoh's queues is some thousands of messages


class ZenohOutput:
    """[zenoh] of a configuration. Live, nothing of it waits for a reader; what it cannot send it counts."""

    def __init__(self, config: Config) -> None:
        self.name = "zenoh"
        section = config.zenoh
        self.about = f"Zenoh ({', '.join([section.mode, *section.listen, *section.connect])})"
        self.outbox = Outbox(QUEUE_MESSAGES, tuple(MESSAGES.values()))
        self.sessions = self.stale = 0
        self._sent = self._sent_at_once = 0  # by the one thread and the other
        self._read_s = 0.0  # monotonic: when a slow reader would have taken all that was sent
        self.answers = Answers(config)
        self._config = config
        self._notes: dict[str, str] = {}

    def session(self, stop: Event) -> None:
        """Open a session, publish until told to stop, close. Raises OutputLost."""
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
            raise OutputLost(f"zenoh: {error}") from error
        finally:
            self.outbox.at_once = None
            self._notes = {"session": "closed"}

    def _serve(self, session: zenoh.Session, publisher: ZenohPublisher, stop: Event) -> None:
        self.outbox.at_once = partial(self._send_at_once, publisher)
        for message in self.outbox.take(0):  # what was left while it was away; states, therefore, do not overtake each other
            if isinstance(message, StateAtInstant | InnovationMessage) and not self.outbox.patience_s:
                self.stale += 1
            else:
                self._send(publisher, message)
        self._look(session)
        stopping = False
        while not stopping:
            stopping = stop.is_set()  # and then what is left
            for message in self.outbox.take(0 if stopping else POLL_S):
                self._send(publisher, message)
                if isinstance(message, HealthMessage):  # for the next one: each second or so
                    self._look(session)
        if self.outbox.patience_s:
            self._linger(publisher)

    def _linger(self, publisher: ZenohPublisher) -> None:
        """A session that is closed drops what its readers have not taken yet, and Zenoh does not say what they have: give
        them the time in which one that takes READER_S for each message would have taken all."""
        longest_s = MAX_LINGER_S if publisher.matched else MIN_LINGER_S
        time.sleep(min(longest_s, max(MIN_LINGER_S, self._read_s - time.monotonic())))

    def _look(self, session: zenoh.Session) -> None:
        """See to whom the session is connected. It may wait for Zenoh, and so is not done in the estimator's thread."""
        routers, peers = len(session.info.routers_zid()), len(session.info.peers_zid())
        self._notes = {"session": f"{routers} routers, {peers} peers connected"}

    def _send(self, publisher: ZenohPublisher, message: Message) -> None:
        publisher.publish(message)
        self.answers.keep(message)
        self._sent += 1
        self._read_s = max(self._read_s, time.monotonic()) + READER_S

    def _send_at_once(self, publisher: ZenohPublisher, state: StateMessage) -> bool:
        try:
            publisher.publish(state)
        except PublishError:
            return False  # the output's own thread finds it out
        self.answers.keep(state)
        self._sent_at_once += 1
        return True

    @property
    def sent(self) -> int:
        """Messages so far."""
        return self._sent + self._sent_at_once

    def counts(self) -> dict[str, int]:
        """What became of the messages so far."""
        return {"sent": self.sent, "stale": self.stale, "sessions": self.sessions, "answered": self.answers.answered}

    def notes(self) -> dict[str, str]:
        """To whom it is connected."""
        return self._notes
