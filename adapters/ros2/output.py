"""ROS 2 without ROS: state and health for nodes that use rmw_zenoh. Needs the extra `ros2`.

A Zenoh session of its own, by default a client of the router that rmw_zenoh needs. See docs/ros2.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from threading import Event

import zenoh

from fusiond.config.outputs import Ros2
from fusiond.config.outputs import Zenoh as ZenohSection
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.messages.types import HealthMessage, Message, StateMessage
from fusiond.ports.outputs import POLL_S, LiveOutput, Outbox, OutputContext, OutputLost
from fusiond_adapters.zenoh.session import PublishError, open_session
from fusiond_adapters.zenoh.words import in_words

try:
    from fusiond_adapters.ros2 import cdr
    from fusiond_adapters.ros2.convert import KINDS, Converter
    from fusiond_adapters.ros2.wire import NO_HASH, Node, Publisher, Topic
except ModuleNotFoundError as missing:
    raise ConfigError("[ros2] needs the extra ros2: pip install 'fusiond[ros2]'") from missing

MAX_WAITING = 64  # messages between the estimator and the session; the oldest are dropped
TF_DEPTH = 100  # what tf2's own broadcasters keep
CHECK_S = 1.0  # between two checks of the router


def topics(section: Ros2) -> Iterator[tuple[str, Topic]]:
    """All topics, by their names in the converter."""
    for name, kind in KINDS.items():
        full = name if name.startswith("/") else f"{section.namespace.rstrip('/')}/{name}"
        type_hash = cdr.type_hash(kind) if section.type_hashes else NO_HASH
        depth = TF_DEPTH if kind == cdr.TF else 10
        yield name, Topic(full, kind, type_hash, depth, urgent=kind != cdr.DIAGNOSTICS)


class Ros2Output:
    """One node with its publishers."""

    name = "ros2"

    def __init__(self, config: Config) -> None:
        self._section, self._directory = config.ros2, config.directory
        self.about = f"ROS 2 in domain {self._section.domain} by {', '.join(self._section.connect) or 'listening'}"
        self.outbox = Outbox(MAX_WAITING, (StateMessage, HealthMessage))
        self._converter = Converter(self._section)
        self._publishers: Mapping[str, Publisher] = {}  # of the session
        self._sent = 0

    def session(self, stop: Event) -> None:
        """Open, publish until `stop` is set, close. Raises OutputLost."""
        section, lossless = self._section, self.outbox.patience_s > 0
        zenoh_section = ZenohSection(
            mode=section.mode, listen=section.listen, connect=section.connect, config_file=section.config_file
        )
        try:
            with (
                open_session(zenoh_section, self._directory) as session,
                Node(session, section.domain, section.namespace, section.node, lossless=lossless) as node,
            ):
                self._publishers = {name: node.publisher(topic) for name, topic in topics(section)}
                self._publish(session, stop)
        except PublishError as error:
            raise OutputLost(str(error)) from error
        except zenoh.ZError as error:
            raise OutputLost(f"zenoh: {in_words(error)}") from error

    def counts(self) -> dict[str, int]:
        """Messages sent, and states without a usable state."""
        return {"sent": self._sent, "states unfit": self._converter.unfit}

    def notes(self) -> dict[str, str]:
        """The origin of the map frame."""
        return {"origin": self._converter.origin}

    def _publish(self, session: zenoh.Session, stop: Event) -> None:
        next_check = time.monotonic() + CHECK_S
        while not stop.is_set():
            self._send(self.outbox.take(POLL_S))
            if time.monotonic() >= next_check:
                next_check = time.monotonic() + CHECK_S
                if self._section.mode == "client" and not _connected(session):
                    raise OutputLost(f"the router is gone: {', '.join(self._section.connect)}")
        self._send(self.outbox.take(0))

    def _send(self, messages: Iterable[Message]) -> None:
        for message in messages:
            for name, payload in self._payloads(message):
                self._publishers[name].put(payload)
                self._sent += 1

    def _payloads(self, message: Message) -> Iterator[tuple[str, bytes]]:
        if isinstance(message, StateMessage):
            yield from self._converter.state(message)
        elif isinstance(message, HealthMessage):
            yield from self._converter.health(message)


def _connected(session: zenoh.Session) -> bool:
    return bool(session.info.routers_zid() or session.info.peers_zid())


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration."""
    return [Ros2Output(config)]
