"""The live output for Prometheus: metrics over HTTP, made from the latest messages. Needs the extra `prometheus`."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Event

from fusiond.config.schema import Config
from fusiond.messages.types import HealthMessage, InnovationMessage, StateMessage
from fusiond.ports.outputs import POLL_S, LiveOutput, Outbox, OutputContext, OutputLost
from fusiond_adapters.prometheus.http import HttpServer
from fusiond_adapters.prometheus.metrics import Page

MAX_WAITING = 4096  # messages between the estimator and the server
PATH = "/metrics"


class PrometheusServer:
    """The live output. A scrape shows the latest messages, of a second ago at most."""

    name = "prometheus"

    def __init__(self, config: Config) -> None:
        self._section = config.prometheus
        self.about = f"Prometheus metrics on {self._section.host}:{self._section.port}"
        self.outbox = Outbox(MAX_WAITING, (StateMessage, HealthMessage, InnovationMessage))
        self.url: str | None = None  # while the server runs
        self._page = Page(config.vehicle.name)
        self._counts = {"scrapes": 0, "refused": 0, "timed out": 0, "lost": 0}  # of servers that have ended
        self._server: HttpServer | None = None

    def session(self, stop: Event) -> None:
        """Serve until `stop` is set. Raises OutputLost."""
        host = self._section.host
        try:
            server = HttpServer(host, self._section.port, PATH, self._page.text)
            server.start()
        except (OSError, RuntimeError) as error:
            raise OutputLost(f"{self.about}: {getattr(error, 'strerror', None) or error}") from error
        self._server = server
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{server.port}{PATH}"
        try:
            stopping = False
            while not stopping:
                stopping = stop.is_set()  # read before the last poll, so that no message is missed
                server.check()
                for message in self.outbox.take(POLL_S):
                    self._page.record(message)
        finally:
            self.url = None
            server.stop()
            self._counts, self._server = self.counts(), None

    def counts(self) -> dict[str, int]:
        """Scrapes, and connections that ended otherwise."""
        now = self._server.counts if self._server else {}
        ours = {"scrapes": "answered"}
        return {name: count + now.get(ours.get(name, name), 0) for name, count in self._counts.items()}

    def notes(self) -> dict[str, str]:
        """The address to scrape."""
        return {"url": self.url} if self.url else {}


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration."""
    return [PrometheusServer(config)]
