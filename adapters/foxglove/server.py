"""Foxglove live: a WebSocket server with the topics of the MCAP files. Needs the extra `foxglove`.

The SDK's own server runs in threads outside Python. For a slow client it drops the oldest messages. Clients come through a
gate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
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


@contextmanager
def served(name: str, host: str, port: int, origins: Sequence[str]) -> Iterator[tuple[Context, Gate]]:
    """Inside the block, the topics of a context are served to those that a gate lets in. Raises OSError, RuntimeError."""
    context, inside = Context(), hidden_host()
    server = start_server(name=name, host=inside, port=0, context=context, message_backlog_size=MAX_WAITING)
    with ExitStack() as stack:
        stack.callback(server.stop)
        gate = Gate(host, port, (inside, server.port), origins)
        gate.start()
        stack.callback(gate.stop)
        yield context, gate


def topic(context: Context, name: str, schema: str, layout: bytes) -> Channel:
    """A topic of JSON messages, by the name of their schema and the JSON Schema itself."""
    described = Schema(name=schema, encoding="jsonschema", data=layout)
    return Channel(name, schema=described, message_encoding="json", context=context)


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
        section = self._config.foxglove
        with ExitStack() as stack:
            try:
                context, gate = stack.enter_context(
                    served(f"fusiond {self._config.vehicle.name}", section.host, section.port, section.origins)
                )
            except (OSError, RuntimeError) as error:
                raise OutputLost(f"{self.about}: {getattr(error, 'strerror', None) or error}") from error
            self._gate = gate
            stack.callback(self._ended)
            host = f"[{section.host}]" if ":" in section.host else section.host
            self.url = f"ws://{host}:{gate.port}"
            self._serve(context, gate, stop)

    def _ended(self) -> None:
        self.url = None
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
            channel.topic: topic(context, channel.topic, channel.schema_name, channel.schema)
            for channel in channels(self._config)
        }
        stopping = False
        while not stopping:
            stopping = stop.is_set()  # read before the last poll, so that no message is missed
            gate.check()
            for message in self.outbox.take(POLL_S):
                for record in self._converter.records(message):
                    channel = topics.get(record.topic)
                    if channel is None:
                        self.unknown += 1
                        continue
                    channel.log(record.data, log_time=record.publish_ns)
                    self.sent += 1
        for one in topics.values():
            one.close()


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration."""
    return [FoxgloveServer(config)]
