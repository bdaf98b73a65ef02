"""Zenoh: a session on loopback unless configured otherwise, and the publishers of all messages.

By default a session uses loopback only: no multicast scouting, no gossip, no listener on other interfaces. Publishing
waits a millisecond at most. Streams (state, settled, innovations) lose samples when a reader is too slow. Rare messages
(health, events, info, config) are kept here; readers that miss one or connect later fetch it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import cast

import zenoh
import zenoh.ext

from fusiond.config.outputs import Encoding
from fusiond.config.outputs import Zenoh as ZenohSection
from fusiond.messages.codec import encode
from fusiond.messages.keys import key as key_of
from fusiond.messages.types import MESSAGES, InnovationMessage, Message
from fusiond_adapters.zenoh.words import endpoint, in_words

STREAMS = ("state", "settled", "innovations")
PRIORITY = {"state": zenoh.Priority.REAL_TIME, "settled": zenoh.Priority.REAL_TIME, "innovations": zenoh.Priority.DATA}
KEPT = {"health": 4, "events": 64, "info": 1, "config": 1}  # samples kept for readers that missed them
RETRY = {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1}  # of connecting; Zenoh's own is 1 to 4 s
QUEUED = 16  # samples in the queue of a priority; Zenoh's default of 2 loses the rest of a burst
SESSIONS = 64  # peers at once: each subscriber adds 3 us to a state; Zenoh's default of 1000 would delay it by 3 ms
PATIENCE_US = 1000  # how long a sample waits for room in the queue; Zenoh's default
LAST_SAMPLE_S = 1.0  # within this time a reader learns that it missed the last sample
WAIT = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
KIND = {message: kind for kind, message in MESSAGES.items()}

CONTENT_TYPES: dict[Encoding, str] = {"json": "application/json", "msgpack": "application/msgpack"}


class PublishError(Exception):
    """Zenoh cannot be set up or used; the message says what was tried and why it failed."""


def state_key(vehicle: str) -> str:
    """The key of the state of a vehicle."""
    return key_of(vehicle, "state")


def message_key(message: Message, vehicle: str) -> str:
    """The key of a message."""
    return key_of(vehicle, KIND[type(message)], message.source if isinstance(message, InnovationMessage) else "")


def alive_key(vehicle: str) -> str:
    """The liveliness token of a vehicle; `@` hides it from subscribers to `**`."""
    return f"fusiond/{vehicle}/@alive/state"


def open_session(section: ZenohSection, directory: str | Path = ".", *, patient: bool = True) -> zenoh.Session:
    """A session as configured; close it (it is a context manager) after its publishers. Raises PublishError.

    If the queue of a reader is full, publishing waits PATIENCE_US before it drops the sample; only if `patient`.
    """
    config = session_config(section, directory, patient=patient)
    with _explained(f"zenoh: cannot {_aim(section)}"):
        return zenoh.open(config)


def _aim(section: ZenohSection) -> str:
    """What a session is to do, in words."""
    connect = [f"connect to {' or '.join(section.connect)}"] if section.connect else []
    listen = [f"listen on {' and '.join(section.listen)}"] if section.listen and section.mode != "client" else []
    return ", or ".join(listen + connect) or f"open a {section.mode}"


def session_config(section: ZenohSection, directory: str | Path = ".", *, patient: bool = True) -> zenoh.Config:
    """Zenoh's configuration: its own file first (relative to `directory`), then the section. Raises PublishError.

    A key of the section that has its default yields to the file if that differs from Zenoh's default.
    """
    config = _from_file(Path(directory) / section.config_file) if section.config_file else zenoh.Config()
    defaults, default = zenoh.Config(), ZenohSection()
    for key, value, usual in (
        ("mode", section.mode, default.mode),
        ("listen/endpoints", [endpoint(one) for one in section.listen], default.listen),
        ("connect/endpoints", [endpoint(one) for one in section.connect], default.connect),
        ("scouting/multicast/enabled", section.multicast_scouting, default.multicast_scouting),
        ("scouting/gossip/enabled", False, False),
        ("transport/shared_memory/enabled", False, False),  # 16 MB for messages over 3 kB; a state has 1
        ("connect/retry", RETRY, RETRY),
        ("transport/unicast/max_sessions", SESSIONS, SESSIONS),
        ("transport/link/tx/queue/size/real_time", QUEUED, QUEUED),
        ("transport/link/tx/queue/size/data", QUEUED, QUEUED),
        (WAIT, PATIENCE_US if patient else 0, PATIENCE_US),
    ):
        if value != usual or config.get_json(key) == defaults.get_json(key):
            with _explained(f"zenoh: {key.replace('/', '.')} cannot be {value}"):
                config.insert_json5(key, json.dumps(value))
    return config


def _from_file(path: Path) -> zenoh.Config:
    with _explained(f"zenoh: config_file {path}"):
        return zenoh.Config.from_file(path)


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Convert Zenoh's error into a PublishError: what was tried, and why it failed."""
    try:
        yield
    except zenoh.ZError as error:
        raise PublishError(f"{what}: {in_words(error)}") from error


class ZenohPublisher:
    """Publishes messages of all kinds, and a liveliness token as long as it exists.

    A context manager; it must end before its session is closed. Raises PublishError if it cannot be declared. With
    `lossless` it waits for slow readers and drops nothing (Zenoh disconnects readers that read nothing for 5 s).
    """

    def __init__(self, session: zenoh.Session, vehicle: str, encoding: Encoding, *, lossless: bool = False) -> None:
        self.vehicle = vehicle
        self._congestion = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self._session, self._encoding = session, encoding
        self._publishers: dict[str, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}  # by key
        self._closed = False
        with _explained(f"zenoh: cannot publish on {key_of(vehicle, '**')}"), ExitStack() as declared:
            for kind in MESSAGES:
                if kind != "innovations":  # each source's is declared with its first message
                    self._declare(key_of(vehicle, kind), kind, declared)
            declared.enter_context(session.liveliness().declare_token(alive_key(vehicle)))
            self._declared = declared.pop_all()

    def _declare(self, where: str, kind: str, declared: ExitStack) -> None:
        encoding, congestion = zenoh.Encoding(CONTENT_TYPES[self._encoding]), self._congestion
        publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if kind in STREAMS:
            publisher = self._session.declare_publisher(
                where,
                encoding=encoding,
                congestion_control=congestion,
                priority=PRIORITY[kind],
                express=kind != "innovations",
            )
        else:
            publisher = zenoh.ext.declare_advanced_publisher(
                self._session,
                where,
                encoding=encoding,
                congestion_control=congestion,
                cache=zenoh.ext.CacheConfig(KEPT[kind]),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=LAST_SAMPLE_S),
                publisher_detection=True,
            )
        declared.enter_context(publisher)
        self._publishers[where] = publisher

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber to the state."""
        publisher = cast(zenoh.Publisher, self._publishers[state_key(self.vehicle)])
        status = cast(zenoh.MatchingStatus, publisher.matching_status)  # its stub wrongly says bool
        return bool(status.matching)

    def publish(self, message: Message) -> None:
        """Send a message to all subscribers. Raises PublishError if the session is closed."""
        where = message_key(message, self.vehicle)
        payload = encode(message, self._encoding)
        if self._closed:
            raise PublishError(f"zenoh: cannot publish on {where}: closed")
        with _explained(f"zenoh: cannot publish on {where}"):
            if where not in self._publishers:
                self._declare(where, KIND[type(message)], self._declared)
            self._publishers[where].put(payload)

    def close(self) -> None:
        """Withdraw the token, then the publishers. Closing twice does nothing."""
        self._closed = True
        self._declared.close()

    def __enter__(self) -> ZenohPublisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
