"""The client for programs that read fusiond: typed messages of a vehicle over Zenoh, subscribed or queried.

    from fusiond.app.client import Client
    from fusiond.messages.types import StateMessage

    with Client("tcp/127.0.0.1:7447", "rover") as client:
        for message in client.stream(StateMessage, timeout_s=2.0):
            print(message.t_ns, message.mode, message.state and message.state.lat_deg)

Callbacks run in a thread of Zenoh: slow work belongs elsewhere. Everything else may be called from any thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import zenoh
import zenoh.ext

from fusiond.config.outputs import Encoding
from fusiond.config.outputs import Zenoh as ZenohSection
from fusiond.messages.codec import decode
from fusiond.messages.keys import key
from fusiond.messages.types import ConfigMessage, HealthMessage, InfoMessage, InnovationMessage, Message, StateMessage
from fusiond.ports.outputs import Outbox
from fusiond_adapters.zenoh.session import CONTENT_TYPES, KIND, STREAMS, PublishError, alive_key, open_session

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
STREAM_MESSAGES = 1024  # kept for a slow reader of a stream; the oldest are dropped
ENCODINGS: dict[str, Encoding] = {content_type: encoding for encoding, content_type in CONTENT_TYPES.items()}

AnyMessage = TypeVar("AnyMessage", bound=Message)


class ClientError(Exception):
    """fusiond cannot be reached, or does not answer; the message says why."""


class Client:
    """A connection to the fusiond of one vehicle (or of all: `vehicle="*"`), directly or through a router.

    `endpoint` is HOST, HOST:PORT, or one of Zenoh's such as tls/HOST:PORT. `config_file` is Zenoh's own configuration file,
    such as for TLS. Raises ClientError if the endpoint cannot be reached.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        vehicle: str = "vehicle",
        *,
        config_file: str | Path | None = None,
        timeout_s: float = 5.0,
    ) -> None:
        self.vehicle = vehicle
        self.undecodable = 0  # samples that could not be decoded
        self._timeout_s = timeout_s
        file = None if config_file is None else str(Path(config_file).absolute())
        section = ZenohSection(mode="client", listen=[], connect=[endpoint], config_file=file)
        self._opened = ExitStack()
        try:
            self._session = self._opened.enter_context(open_session(section))
        except PublishError as error:
            raise ClientError(str(error)) from error

    # --- Subscriptions

    @contextmanager
    def subscribed(self, kind: type[AnyMessage], callback: Callable[[AnyMessage], None]) -> Iterator[None]:
        """Inside the block, `callback` gets every message of a kind.

        For health, events, info and config the latest message comes at once, and missed ones are fetched again. A state,
        settled state or innovation that is lost on a slow network is not.
        """

        def receive(sample: zenoh.Sample) -> None:
            message = self._decoded(sample, kind)
            if message is not None:
                callback(message)

        with self._subscriber(kind, receive):
            yield

    def _subscriber(self, kind: type[AnyMessage], receive: Callable[[zenoh.Sample], None]) -> Any:
        """A context manager. Of what is kept for late readers, the latest comes at once, and missed ones are fetched."""
        name = KIND[kind]
        where = key(self.vehicle, name, "*" if kind is InnovationMessage else "")
        subscriber: Any
        if name in STREAMS:
            subscriber = self._session.declare_subscriber(where, receive)
        else:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session,
                where,
                receive,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )
        return subscriber

    @contextmanager
    def heard(
        self, kind: type[AnyMessage], callback: Callable[[str, Callable[[], AnyMessage | None]], None]
    ) -> Iterator[None]:
        """Inside the block, `callback` gets the vehicle and a function that decodes its message, for every message of a kind
        of many vehicles: to decode all of them may be too much. The function returns None for what cannot be decoded."""

        def receive(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr).split("/")[1], lambda: self._decoded(sample, kind))

        with self._subscriber(kind, receive):
            yield

    @contextmanager
    def presence(self, callback: Callable[[str, bool], None]) -> Iterator[None]:
        """Inside the block, `callback` gets each vehicle that is there or comes, with True, and each that goes, False."""

        def receive(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr).split("/")[1], sample.kind == zenoh.SampleKind.PUT)

        subscriber: Any = self._session.liveliness().declare_subscriber(alive_key(self.vehicle), receive, history=True)
        with subscriber:
            yield

    def stream(self, kind: type[AnyMessage], timeout_s: float) -> Iterator[AnyMessage]:
        """The messages of a kind as they come. Raises TimeoutError when none comes within `timeout_s`."""
        outbox = Outbox(STREAM_MESSAGES, (kind,))
        with self.subscribed(kind, outbox.put):
            while messages := outbox.take(timeout_s):
                yield from cast(list[AnyMessage], messages)  # the outbox accepts no other kind
        raise TimeoutError(f"no {KIND[kind]} of {self.vehicle} for {timeout_s:g} s")

    # --- Queries

    def latest(self, kind: type[AnyMessage]) -> AnyMessage:
        """The latest message of a kind. Raises ClientError."""
        return self._ask(kind, "")

    def state_at(self, t_ns: int) -> StateMessage:
        """The published state nearest to an instant within the horizon. Raises ClientError."""
        return self._ask(StateMessage, f"?t_ns={t_ns}")

    def health(self) -> HealthMessage:
        """The latest health. Raises ClientError."""
        return self.latest(HealthMessage)

    def info(self) -> InfoMessage:
        """Version, configuration and keys of the running fusiond. Raises ClientError."""
        return self.latest(InfoMessage)

    def config(self) -> ConfigMessage:
        """The configuration in force. Raises ClientError."""
        return self.latest(ConfigMessage)

    def alive(self) -> frozenset[str]:
        """The vehicles with a running fusiond, of those that the client is for."""
        replies = self._session.liveliness().get(alive_key(self.vehicle), timeout=self._timeout_s)
        return frozenset(str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None)

    def _ask(self, kind: type[AnyMessage], parameters: str) -> AnyMessage:
        where = key(self.vehicle, KIND[kind], "*" if kind is InnovationMessage else "")
        refusal = "no answer"
        for reply in self._session.get(where + parameters, timeout=self._timeout_s):
            if reply.ok is not None:
                message = self._decoded(reply.ok, kind)
                if message is not None:
                    return message
                refusal = f"the answer is no {kind.__name__}"
            elif reply.err is not None:
                refusal = reply.err.payload.to_string()
        raise ClientError(f"{where}: {refusal}")

    def _decoded(self, sample: zenoh.Sample, kind: type[AnyMessage]) -> AnyMessage | None:
        encoding = ENCODINGS.get(str(sample.encoding))
        if encoding is not None:
            try:
                return decode(sample.payload.to_bytes(), kind, encoding)
            except msgspec.DecodeError:
                pass  # counted below, with other content types
        self.undecodable += 1
        return None

    # --- End

    def close(self) -> None:
        """End the connection. Closing twice does nothing."""
        self._opened.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
