"""Zenoh out: a session that keeps to itself unless told otherwise, and the publisher of the state.

A session hears and speaks on loopback only, by default: no multicast scouting, no gossip, no listener on other
interfaces. Publishing never waits: when a reader cannot keep up, samples are dropped, not the pace of the filter.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import cast

import zenoh

from fusiond.config import Encoding
from fusiond.config import Zenoh as ZenohSection
from fusiond.messages import StateMessage, encode

CONTENT_TYPES: dict[Encoding, str] = {"json": "application/json", "msgpack": "application/msgpack"}


class PublishError(Exception):
    """Zenoh cannot be set up or used; the message says what was asked and why it failed."""


def state_key(vehicle: str) -> str:
    """Where the state of a vehicle is published."""
    return f"fusiond/{vehicle}/state"


def alive_key(vehicle: str) -> str:
    """The liveliness token of a vehicle's state; `@` hides it from subscribers to `**`."""
    return f"fusiond/{vehicle}/@alive/state"


def open_session(section: ZenohSection, directory: str | Path = ".") -> zenoh.Session:
    """A session as configured; close it (it is a context manager) after its publishers. Raises PublishError."""
    config = session_config(section, directory)
    what = f"zenoh: cannot open a {section.mode}, listen {section.listen}, connect {section.connect}"
    with _explained(what):
        return zenoh.open(config)


def session_config(section: ZenohSection, directory: str | Path = ".") -> zenoh.Config:
    """Zenoh's configuration: its own file first (relative to `directory`), then the section. Raises PublishError.

    A key of the section that is left at its default yields to the file, where the file says other than Zenoh's default.
    """
    config = _from_file(Path(directory) / section.config_file) if section.config_file else zenoh.Config()
    untouched, default = zenoh.Config(), ZenohSection()
    for key, value, usual in (
        ("mode", section.mode, default.mode),
        ("listen/endpoints", section.listen, default.listen),
        ("connect/endpoints", section.connect, default.connect),
        ("scouting/multicast/enabled", section.multicast_scouting, default.multicast_scouting),
        ("scouting/gossip/enabled", False, False),
    ):
        if value != usual or config.get_json(key) == untouched.get_json(key):
            with _explained(f"zenoh: {key} cannot be {value!r}"):
                config.insert_json5(key, json.dumps(value))
    return config


def _from_file(path: Path) -> zenoh.Config:
    with _explained(f"zenoh: config_file {path}"):
        return zenoh.Config.from_file(path)


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turn Zenoh's error into ours: what was asked, and the reason without the places in Zenoh's own source."""
    try:
        yield
    except zenoh.ZError as error:
        reason = re.sub(r" at \S+\.rs:\d+\.?", "", str(error)).strip()
        raise PublishError(f"{what}: {reason}") from error


class ZenohStatePublisher:
    """Publishes state messages, and a liveliness token that tells readers as long as it does.

    A context manager; it must end before its session is closed. Raises PublishError where it cannot be declared.
    """

    def __init__(self, session: zenoh.Session, vehicle: str, encoding: Encoding) -> None:
        self.key = state_key(vehicle)
        self._encoding = encoding
        with _explained(f"zenoh: cannot publish on {self.key}"), ExitStack() as declared:
            self._publisher = declared.enter_context(
                session.declare_publisher(
                    self.key,
                    encoding=zenoh.Encoding(CONTENT_TYPES[encoding]),
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.REAL_TIME,
                    express=True,
                )
            )
            declared.enter_context(session.liveliness().declare_token(alive_key(vehicle)))
            self._declared = declared.pop_all()

    @property
    def matched(self) -> bool:
        """Whether anyone subscribes."""
        status = cast(zenoh.MatchingStatus, self._publisher.matching_status)  # its stub says bool, which it is not
        return bool(status.matching)

    def publish(self, message: StateMessage) -> None:
        """Send a message to whoever subscribes. Never waits. Raises PublishError where the session is closed."""
        payload = encode(message, self._encoding)
        with _explained(f"zenoh: cannot publish on {self.key}"):
            self._publisher.put(payload)

    def close(self) -> None:
        """Withdraw the token, then the publisher. Closing twice does nothing."""
        self._declared.close()

    def __enter__(self) -> ZenohStatePublisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
