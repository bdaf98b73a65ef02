"""Prometheus: scrapes over HTTP of a running output."""

from __future__ import annotations

import socket
from urllib.request import Request, urlopen

import msgspec
import pytest

from fusiond.config.outputs import Prometheus
from fusiond.messages.types import StateMessage
from fusiond.units import SECOND
from tests.helpers.drive import messages, settings
from tests.helpers.network import DEADLINE
from tests.helpers.serving import serving

pytest.importorskip("prometheus_client", reason="the extra prometheus is not installed")

from prometheus_client.parser import text_string_to_metric_families

from fusiond_adapters.prometheus import http
from fusiond_adapters.prometheus.server import PrometheusServer


def server_of(port: int = 0, host: str = "127.0.0.1") -> PrometheusServer:
    section = Prometheus(enabled=True, port=port, host=host)
    return PrometheusServer(msgspec.structs.replace(settings(), prometheus=section))


def scrape(server: PrometheusServer) -> dict[str, float]:
    """The last sample of each name."""
    assert server.url is not None
    with urlopen(server.url, timeout=DEADLINE) as answer:
        text = answer.read().decode()
    return {sample.name: sample.value for family in text_string_to_metric_families(text) for sample in family.samples}


def test_a_scrape_shows_the_latest_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "KEPT_S", 0.0)
    server = server_of()
    states = [message for message in messages() if isinstance(message, StateMessage)]
    with serving(server):
        for state in states:
            server.outbox.put(state)
        for _ in range(200):
            if scrape(server).get("fusiond_time_seconds") == states[-1].t_ns / SECOND:
                break
        else:
            raise AssertionError("the messages were not taken in")
        assert server.url is not None
        with urlopen(Request(server.url, headers={"Accept": "application/openmetrics-text"}), timeout=DEADLINE) as answer:
            assert answer.headers["Content-Type"].startswith("application/openmetrics-text; version=1.0.0")
            assert answer.read().endswith(b"# EOF\n")


def test_before_the_first_message_and_after_the_end() -> None:
    server = server_of()
    with serving(server) as lost:
        assert not lost and server.notes() == {"url": server.url}
        names = scrape(server).keys()
        assert "process_resident_memory_bytes" in names and "fusiond_mode" not in names
    assert server.url is None and server.counts() == {"scrapes": 1, "refused": 0, "timed out": 0, "lost": 0}


def test_a_port_in_use_is_reported() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with serving(server_of(taken.getsockname()[1])) as lost:
            assert "Address already in use" in str(lost[0])


def test_a_host_of_ipv6() -> None:
    server = server_of(host="::1")
    with serving(server) as lost:
        if lost:
            pytest.skip(f"there is no IPv6 here: {lost[0]}")
        assert server.url is not None and server.url.startswith("http://[::1]:")
        assert "process_resident_memory_bytes" in scrape(server)


def test_a_header_made_to_break_the_encoder_gets_a_page() -> None:
    """prometheus_client's own choice of a format fails at this version."""
    server = server_of()
    with serving(server):
        assert server.url is not None
        with urlopen(Request(server.url, headers={"Accept": "text/plain;version=1e9"}), timeout=DEADLINE) as answer:
            assert answer.status == 200
