"""Prometheus: an HTTP server of metrics, made from the latest messages at each scrape. Needs the extra `prometheus`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from threading import Event
from typing import Any

import msgspec

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, InnovationMessage, OutcomeCounts, Quantiles, SourceHealth, StateMessage
from fusiond.ports.outputs import POLL_S, LiveOutput, Outbox, OutputContext, OutputLost
from fusiond.units import SECOND

try:
    from prometheus_client import CollectorRegistry, Histogram, ProcessCollector, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
    from prometheus_client.registry import Collector
except ModuleNotFoundError as missing:
    raise ConfigError("[prometheus] needs the extra prometheus: pip install 'fusiond[prometheus]'") from missing

MAX_WAITING = 4096  # messages between the estimator and the server
RATIO_BUCKETS = (0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 2.0, 5.0, 10.0, 100.0)
DELAY_BUCKETS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # s
QUANTILES = {"p50": "0.5", "p90": "0.9", "p99": "0.99", "max": "1"}

Metrics = Iterator[Any]


class PrometheusServer:
    """The live output. A scrape shows the latest messages."""

    name = "prometheus"

    def __init__(self, config: Config) -> None:
        self._section = config.prometheus
        self.about = f"Prometheus metrics on {self._section.host}:{self._section.port}"
        self.outbox = Outbox(MAX_WAITING, (StateMessage, HealthMessage, InnovationMessage))
        self.url: str | None = None  # while the server runs
        self._registry = CollectorRegistry()
        self._latest = Latest()
        self._registry.register(self._latest)
        ProcessCollector(registry=self._registry)
        self._ratios = Histogram(
            "fusiond_test_ratio", "Squared innovation over its limit, 1 at the gate", ["source"],
            registry=self._registry, buckets=RATIO_BUCKETS,
        )  # fmt: skip
        self._delays = Histogram(
            "fusiond_measurement_delay_seconds", "Receipt less the instant measured", ["source"],
            registry=self._registry, buckets=DELAY_BUCKETS,
        )  # fmt: skip

    def session(self, stop: Event) -> None:
        """Serve until `stop` is set. Raises OutputLost."""
        try:
            server, thread = start_http_server(self._section.port, self._section.host, registry=self._registry)
        except OSError as error:
            raise OutputLost(f"{self.about}: {error.strerror}") from error
        self.url = f"http://{self._section.host}:{server.server_port}/metrics"
        try:
            stopping = False
            while not stopping:
                stopping = stop.is_set()  # read before the last poll, so that no message is missed
                for message in self.outbox.take(POLL_S):
                    self._record(message)
        finally:
            self.url = None
            server.shutdown()
            server.server_close()
            thread.join()

    def counts(self) -> dict[str, int]:
        """Scrapes."""
        return {"scrapes": self._latest.scrapes}

    def notes(self) -> dict[str, str]:
        """The address to scrape."""
        return {"url": self.url} if self.url else {}

    def _record(self, message: object) -> None:
        if isinstance(message, StateMessage):
            self._latest.state = message
        elif isinstance(message, HealthMessage):
            self._latest.health = message
        elif isinstance(message, InnovationMessage):
            self._delays.labels(message.source).observe((message.t_receive_ns - message.t_ns) / SECOND)
            if message.test_ratio is not None:
                self._ratios.labels(message.source).observe(message.test_ratio)


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration."""
    return [PrometheusServer(config)]


class Latest(Collector):  # type: ignore[misc]  # Any, where the extra is missing
    """The latest messages, as metrics."""

    def __init__(self) -> None:
        self.state: StateMessage | None = None
        self.health: HealthMessage | None = None
        self.scrapes = 0

    def describe(self) -> list[Any]:
        """Nothing: the names come from the messages."""
        return []

    def collect(self) -> Metrics:
        """One scrape; called in a thread of the server."""
        self.scrapes += 1
        if self.state is not None:
            yield from _of_state(self.state)
        if self.health is not None:
            yield from _of_health(self.health)
            yield from _of_sources(self.health.sources)


def _of_state(message: StateMessage) -> Metrics:
    yield _gauge("time_seconds", "Unix time that the state is valid for", {(): message.t_ns / SECOND})
    modes = {(mode.value,): float(mode is message.mode) for mode in Mode}
    yield _gauge("mode", "1 for the present mode", modes, ["mode"])
    if message.age_ms is not None:
        yield _gauge("imu_age_seconds", "Time less the stamp of the last IMU sample", {(): message.age_ms / 1e3})
    yield _counter("resets", "Number of resets, that is jumps of the state", {(): message.resets})
    state = message.state
    yield _gauge("has_state", "1 if there is a state", {(): float(state is not None)})
    if state is None:
        return
    axes = zip("ned", state.sigma_position_ned_m, strict=True)
    yield _gauge("position_sigma_meters", "Position sigma by axis", {(axis,): value for axis, value in axes}, ["axis"])
    yield _gauge("velocity_sigma_meters_per_second", "Horizontal, per axis", {(): state.sigma_velocity_mps})
    yield _gauge("yaw_sigma_radians", "Sigma of the yaw", {(): math.radians(state.sigma_yaw_deg)})
    yield _gauge("speed_meters_per_second", "Over ground, horizontal", {(): math.hypot(*state.velocity_ned_mps[:2])})


def _of_health(health: HealthMessage) -> Metrics:
    info = InfoMetricFamily("fusiond", "What is running")
    info.add_metric([], {"version": health.version, "vehicle": health.vehicle})
    yield info
    yield _gauge("uptime_seconds", "Since the first measurement", {(): health.uptime_s})
    latency = health.latency_ms
    stages = {"fused": latency.fused, "published": latency.published}
    stages |= {f"output {name}": output.latency_ms for name, output in health.outputs.items()}
    values = {key: value for stage, quantiles in stages.items() for key, value in _quantiles(stage, quantiles)}
    yield _gauge("latency_seconds", "Inside fusiond, by stage", values, ["stage", "quantile"])
    inputs, outputs = health.inputs.items(), health.outputs.items()
    yield _counter("input_frames", "Frames received", {(name,): one.received for name, one in inputs}, ["input"])
    yield _counter("input_dropped", "Frames dropped", {(name,): one.dropped for name, one in inputs}, ["input"])
    yield _counter("output_messages", "Messages offered to it", {(name,): one.offered for name, one in outputs}, ["output"])
    yield _counter("output_dropped", "Messages dropped", {(name,): one.dropped for name, one in outputs}, ["output"])


def _of_sources(sources: Mapping[str, SourceHealth]) -> Metrics:
    counts = {name: msgspec.structs.asdict(one.outcomes) for name, one in sources.items()}
    outcomes = {(name, outcome): count for name, found in counts.items() for outcome, count in found.items()}
    # A rewind can change an outcome, so these may fall; only their sum is a counter.
    yield _gauge("measurements", "By their last outcome", outcomes, ["source", "outcome"])
    received = {(name,): _sum(one.outcomes) for name, one in sources.items()}
    yield _counter("measurements_received", "Measurements received", received, ["source"])
    for name, about, values in (
        ("present", "1 if anything was received in the last 2 s", {k: float(v.present) for k, v in sources.items()}),
        ("age_seconds", "Since its last receipt", {k: _seconds(v.age_ms) for k, v in sources.items()}),
        ("rate_hertz", "Receipts per second, recently", {k: v.rate_hz for k, v in sources.items()}),
        ("nis_mean", "Mean squared innovation per axis, in sigmas", {k: v.nis_mean for k, v in sources.items()}),
        ("clock_offset_seconds", "Common time line less its clock",
         {k: _seconds(v.clock.offset_ms) for k, v in sources.items() if v.clock}),
        ("clock_jitter_seconds", "Mean of receipt less aligned stamp",
         {k: _seconds(v.clock.jitter_ms) for k, v in sources.items() if v.clock}),
    ):  # fmt: skip
        known = {(key,): value for key, value in values.items() if value is not None}
        yield _gauge(f"source_{name}", about, known, ["source"])


def _sum(outcomes: OutcomeCounts) -> int:
    return sum(msgspec.structs.astuple(outcomes))


def _seconds(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else milliseconds / 1e3


def _quantiles(stage: str, quantiles: Quantiles | None) -> Iterator[tuple[tuple[str, str], float]]:
    for field, quantile in QUANTILES.items() if quantiles else ():
        yield (stage, quantile), getattr(quantiles, field) / 1e3


def _gauge(name: str, about: str, values: Mapping[Any, float], labels: list[str] | None = None) -> Any:
    return _filled(GaugeMetricFamily(f"fusiond_{name}", about, labels=labels or []), values)


def _counter(name: str, about: str, values: Mapping[Any, float], labels: list[str] | None = None) -> Any:
    return _filled(CounterMetricFamily(f"fusiond_{name}", about, labels=labels or []), values)


def _filled(family: Any, values: Mapping[Any, float]) -> Any:
    for labels, value in values.items():
        family.add_metric(list(labels), value)
    return family
