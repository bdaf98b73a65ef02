"""Foxglove live: a WebSocket server with the topics of the MCAP files. Needs the extra `foxglove`.

The SDK's own server runs in threads outside Python. For a slow client it drops the oldest messages. Clients come through a
gate.
"""

from __future__ import annotations

from collections.abc import Sequence
from threading import Event

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.ports.outputs import POLL_S, LiveOutput, Outbox, OutputContext, OutputLost
from fusiond_adapters.foxglove.converter import SHOWN, Converter, channels
from fusiond_adapters.foxglove.gate import Gate, hidden_host

try:
    from foxglove import Channel, Context, Schema, start_server
except ModuleNotFoundError as missing:
    raise ConfigError("[foxglove] needs the extra foxglove: pip install 'fusiond[foxglove]'") from missing

MAX_WAITING = 1024  # messages between the estimator and the server, and between the server and each client


class FoxgloveServer:
    """The live output."""

    name = "foxglove"

    def __init__(self, config: Config) -> None:
        self.about = f"Foxglove server on {config.foxglove.host}:{config.foxglove.port}"
        self.outbox = Outbox(MAX_WAITING, SHOWN)
        self.sent = 0  # records given to the server
        self.unknown = 0  # records of unknown topics, which are left out
        self.url: str | None = None  # while the server runs
        self._clients = {"clients": 0, "refused": 0, "timed out": 0, "lost": 0}  # of sessions that have ended
        self._gate: Gate | None = None
        self._config = config
        self._converter = Converter(config.foxglove.rate_hz)

    def session(self, stop: Event) -> None:
        """Serve until `stop` is set. Raises OutputLost."""
        section, context, inside = self._config.foxglove, Context(), hidden_host()
        try:
            server = start_server(
                name=f"fusiond {self._config.vehicle.name}",
                host=inside,
                port=0,
                context=context,
                message_backlog_size=MAX_WAITING,
            )
        except RuntimeError as error:  # the SDK raises no other
            raise OutputLost(f"{self.about}: {error}") from error
        try:
            gate = Gate(section.host, section.port, (inside, server.port), section.origins)
            gate.start()
        except (OSError, RuntimeError) as error:
            server.stop()
            raise OutputLost(f"{self.about}: {getattr(error, 'strerror', None) or error}") from error
        self._gate = gate
        try:
            host = f"[{section.host}]" if ":" in section.host else section.host
            self.url = f"ws://{host}:{gate.port}"
            self._serve(context, gate, stop)
        finally:
            self.url = None
            gate.stop()
            server.stop()
            self._clients, self._gate = self._client_counts(), None

    def counts(self) -> dict[str, int]:
        """Records sent, records of unknown topics, and clients by what became of them."""
        return {"records": self.sent, "unknown topics": self.unknown, **self._client_counts()}

    def _client_counts(self) -> dict[str, int]:
        now = self._gate.counts if self._gate else {}
        return {name: count + now.get(name, 0) for name, count in self._clients.items()}

    def notes(self) -> dict[str, str]:
        """The address to connect to."""
        return {"url": self.url} if self.url else {}

    def _serve(self, context: Context, gate: Gate, stop: Event) -> None:
        topics = {
            channel.topic: Channel(
                channel.topic,
                schema=Schema(name=channel.schema_name, encoding="jsonschema", data=channel.schema),
                message_encoding="json",
                context=context,
            )
            for channel in channels(self._config)
        }
        stopping = False
        while not stopping:
            stopping = stop.is_set()  # read before the last poll, so that no message is missed
            gate.check()
            for message in self.outbox.take(POLL_S):
                for record in self._converter.records(message):
                    topic = topics.get(record.topic)
                    if topic is None:
                        self.unknown += 1
                        continue
                    topic.log(record.data, log_time=record.publish_ns)
                    self.sent += 1
        for one in topics.values():
            one.close()


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration."""
    return [FoxgloveServer(config)]
