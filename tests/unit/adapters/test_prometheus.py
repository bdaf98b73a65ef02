"""Prometheus: a scrape over HTTP, parsed by the makers' own parser."""

from __future__ import annotations

import math
import socket
from typing import Any
from urllib.request import urlopen

import msgspec
import pytest

from fusiond.config.outputs import Prometheus
from fusiond.messages.types import (
    HealthMessage,
    InnovationMessage,
    InputHealth,
    LatencyHealth,
    OutputHealth,
    Quantiles,
    StateMessage,
)
from fusiond.units import SECOND
from tests.helpers.drive import messages, settings
from tests.helpers.network import DEADLINE
from tests.helpers.serving import serving

pytest.importorskip("prometheus_client", reason="the extra prometheus is not installed")

from prometheus_client.parser import text_string_to_metric_families

from fusiond_adapters.prometheus import PrometheusServer

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def server_of(port: int = 0) -> PrometheusServer:
    return PrometheusServer(msgspec.structs.replace(settings(), prometheus=Prometheus(enabled=True, port=port)))


def scrape(server: PrometheusServer) -> Samples:
    assert server.url is not None
    with urlopen(server.url, timeout=DEADLINE) as answer:
        text = answer.read().decode()
    families = text_string_to_metric_families(text)
    return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples[f"fusiond_{name}", frozenset(labels.items())]


def scrape_after(published: list[Any]) -> Samples:
    """A scrape after these messages."""
    server = server_of()
    with serving(server):
        for message in published:
            server.outbox.put(message)
        last = [message for message in published if isinstance(message, StateMessage)][-1]
        for _ in range(1000):
            samples = scrape(server)
            if samples.get(("fusiond_time_seconds", frozenset())) == last.t_ns / SECOND:
                return samples
    raise AssertionError("the messages were not taken in")


def test_a_scrape_has_state_sources_and_innovations() -> None:
    everything = list(messages())
    health = [message for message in everything if isinstance(message, HealthMessage)][-1]
    published = everything[: everything.index(health)]
    state = next(message for message in reversed(published) if isinstance(message, StateMessage))
    innovations = [message for message in published if isinstance(message, InnovationMessage)]
    samples = scrape_after([*[m for m in published if m is not state], health, state])
    assert state.state is not None and value(samples, "info", version=health.version, vehicle="tested") == 1
    assert value(samples, "mode", mode="dead_reckoning") == 1 and value(samples, "mode", mode="nominal") == 0
    assert value(samples, "position_sigma_meters", axis="d") == state.state.sigma_position_ned_m[2]
    assert value(samples, "yaw_sigma_radians") == pytest.approx(math.radians(state.state.sigma_yaw_deg))
    assert value(samples, "resets_total") == state.resets
    for source, found in health.sources.items():
        outcomes = msgspec.structs.asdict(found.outcomes)
        assert value(samples, "measurements_received_total", source=source) == sum(outcomes.values()) > 0
        for outcome, count in outcomes.items():
            assert value(samples, "measurements", source=source, outcome=outcome) == count
        assert value(samples, "source_present", source=source) == found.present
    ratios = [one.test_ratio for one in innovations if one.source == "rear_left" and one.test_ratio is not None]
    assert value(samples, "test_ratio_count", source="rear_left") == len(ratios) > 100
    assert value(samples, "test_ratio_bucket", source="rear_left", le="1.0") == sum(ratio <= 1 for ratio in ratios)
    assert value(samples, "measurement_delay_seconds_count", source="gps0.position") > 20


def test_latencies_and_losses() -> None:
    health = next(message for message in messages() if isinstance(message, HealthMessage))
    quantiles = Quantiles(p50=1.0, p90=2.0, p99=3.0, max=4.0)
    inputs = {"can.car": InputHealth(received=100, dropped=7, counts={})}
    outputs = {"zenoh": OutputHealth(offered=50, dropped=3, latency_ms=quantiles, counts={}, notes={})}
    published = msgspec.structs.replace(health, latency_ms=LatencyHealth(fused=quantiles), inputs=inputs, outputs=outputs)
    samples = scrape_after([published, next(message for message in messages() if isinstance(message, StateMessage))])
    assert value(samples, "latency_seconds", stage="fused", quantile="0.99") == 0.003
    assert value(samples, "latency_seconds", stage="output zenoh", quantile="1") == 0.004
    assert value(samples, "input_frames_total", input="can.car") == 100
    assert value(samples, "input_dropped_total", input="can.car") == 7
    assert value(samples, "output_dropped_total", output="zenoh") == 3
    assert ("fusiond_position_sigma_meters", frozenset({("axis", "n")})) not in samples  # aligning: no state
    assert value(samples, "has_state") == 0


def test_before_the_first_message_and_after_the_end() -> None:
    server = server_of()
    with serving(server) as lost:
        assert not lost and server.notes() == {"url": server.url}
        names = {name for name, _ in scrape(server)}
        assert "process_resident_memory_bytes" in names and "fusiond_mode" not in names
    assert server.url is None and server.counts() == {"scrapes": 1}


def test_a_port_in_use_is_reported() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with serving(server_of(taken.getsockname()[1])) as lost:
            assert "Address already in use" in str(lost[0])
