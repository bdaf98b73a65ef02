"""The latest messages as metrics, by the conventions of Prometheus and OpenMetrics. Needs the extra `prometheus`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import msgspec

from fusiond.config.toml import ConfigError
from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, InnovationMessage, OutcomeCounts, Quantiles, SourceHealth, StateMessage
from fusiond.units import SECOND

try:
    from prometheus_client import CollectorRegistry, Histogram, ProcessCollector
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, SummaryMetricFamily
    from prometheus_client.exposition import generate_latest
    from prometheus_client.openmetrics import exposition as openmetrics
except ModuleNotFoundError as missing:
    raise ConfigError("[prometheus] needs the extra prometheus: pip install 'fusiond[prometheus]'") from missing

RATIO_BUCKETS = (0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 2.0, 5.0, 10.0, 100.0)
DELAY_BUCKETS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # s
QUANTILES = {"p50": "0.5", "p90": "0.9", "p99": "0.99", "max": "1"}
PLAIN = "text/plain; version=0.0.4; charset=utf-8"
OPENMETRICS = "application/openmetrics-text; version=1.0.0; charset=utf-8"
PIECE = 32  # samples that are made into text at once: a fraction of a millisecond
END = b"# EOF\n"  # of a page of OpenMetrics

Metrics = Iterator[Any]


class Page:
    """What a scrape of one vehicle returns: state and health as they were last, and histograms of all innovations."""

    def __init__(self, vehicle: str) -> None:
        self.state: StateMessage | None = None
        self.health: HealthMessage | None = None
        self._labels = {"vehicle": vehicle}
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        self._ratios = self._histogram("test_ratio", "Squared innovation over its limit, 1 at the gate", RATIO_BUCKETS)
        self._delays = self._histogram("measurement_delay_seconds", "Receipt less the instant measured", DELAY_BUCKETS)

    def record(self, message: object) -> None:
        """Take note of a message."""
        if isinstance(message, StateMessage):
            self.state = message
        elif isinstance(message, HealthMessage):
            self.health = message
        elif isinstance(message, InnovationMessage):
            self._delays.labels(**self._labels, source=message.source).observe(
                (message.t_receive_ns - message.t_ns) / SECOND
            )
            if message.test_ratio is not None:
                self._ratios.labels(**self._labels, source=message.source).observe(message.test_ratio)

    def text(self, accept: str) -> tuple[str, Iterator[bytes]]:
        """For an Accept header: the content type, and the text in pieces of some samples."""
        if OPENMETRICS.partition(";")[0] in accept:
            return OPENMETRICS, self._text(openmetrics.generate_latest, END)
        return PLAIN, self._text(generate_latest, b"")

    def _text(self, encode: Any, end: bytes) -> Iterator[bytes]:
        for family in self.families():
            yield b""  # to make the samples was a piece of work too
            samples = [sample for sample in family.samples if not sample.name.endswith("_created")]
            for begin in range(0, len(samples), PIECE):
                family.samples = samples[begin : begin + PIECE]
                piece: bytes = encode(_Single(family)).removesuffix(end)
                while begin and piece.startswith(b"#"):  # the head is with the first piece
                    piece = piece.partition(b"\n")[2]
                yield piece
        yield end

    def families(self) -> Metrics:
        """All metrics."""
        yield from self._registry.collect()
        if self.state is not None:
            yield from self._of_state(self.state)
        if self.health is not None:
            yield from self._of_health(self.health)
            yield from self._of_sources(self.health.sources)

    # --- Of each message

    def _of_state(self, message: StateMessage) -> Metrics:
        yield self._gauge("time_seconds", "Unix time that the state is valid for", {(): message.t_ns / SECOND})
        modes = {(mode.value,): float(mode is message.mode) for mode in Mode}
        yield self._gauge("mode", "1 for the present mode", modes, "mode")
        if message.age_ms is not None:
            yield self._gauge("imu_age_seconds", "Time less the stamp of the last IMU sample", {(): message.age_ms / 1e3})
        yield self._counter("resets", "Number of resets, that is jumps of the state", {(): message.resets})
        state = message.state
        yield self._gauge("has_state", "1 if there is a state", {(): float(state is not None)})
        if state is None:
            return
        axes = {(axis,): value for axis, value in zip("ned", state.sigma_position_ned_m, strict=True)}
        yield self._gauge("position_sigma_meters", "Position sigma by axis", axes, "axis")
        yield self._gauge("velocity_sigma_meters_per_second", "Horizontal, per axis", {(): state.sigma_velocity_mps})
        yield self._gauge("yaw_sigma_radians", "Sigma of the yaw", {(): math.radians(state.sigma_yaw_deg)})
        speed = math.hypot(*state.velocity_ned_mps[:2])
        yield self._gauge("speed_meters_per_second", "Over ground, horizontal", {(): speed})

    def _of_health(self, health: HealthMessage) -> Metrics:
        info = InfoMetricFamily("fusiond", "What is running", labels=list(self._labels))
        info.add_metric(list(self._labels.values()), {"version": health.version})
        yield info
        yield self._gauge("uptime_seconds", "Since the first measurement", {(): health.uptime_s})
        inputs, outputs = health.inputs.items(), health.outputs.items()
        stages = {"fused": health.latency_ms.fused, "published": health.latency_ms.published}
        yield self._summary("latency_seconds", "Inside fusiond, by stage", stages, "stage")
        taken = {name: one.latency_ms for name, one in outputs}
        yield self._summary("output_latency_seconds", "Until a state is with an output", taken, "output")
        yield self._counter("input_frames", "Frames received", {(name,): one.received for name, one in inputs}, "input")
        yield self._counter("input_dropped", "Frames dropped", {(name,): one.dropped for name, one in inputs}, "input")
        offered = {(name,): one.offered for name, one in outputs}
        yield self._counter("output_messages", "Messages offered to it", offered, "output")
        yield self._counter("output_dropped", "Messages dropped", {(name,): one.dropped for name, one in outputs}, "output")

    def _of_sources(self, sources: Mapping[str, SourceHealth]) -> Metrics:
        counts = {name: msgspec.structs.asdict(one.outcomes) for name, one in sources.items()}
        outcomes = {(name, outcome): count for name, found in counts.items() for outcome, count in found.items()}
        # A rewind can change an outcome, so these may fall; only their sum is a counter.
        yield self._gauge("measurements", "By their last outcome", outcomes, "source", "outcome")
        received = {(name,): _sum(one.outcomes) for name, one in sources.items()}
        yield self._counter("measurements_received", "Measurements received", received, "source")
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
            yield self._gauge(f"source_{name}", about, known, "source")

    # --- Families, all with the labels of the page

    def _histogram(self, name: str, about: str, buckets: tuple[float, ...]) -> Any:
        labels = [*self._labels, "source"]
        return Histogram(f"fusiond_{name}", about, labels, registry=self._registry, buckets=buckets)

    def _gauge(self, name: str, about: str, values: Mapping[Any, float], *labels: str) -> Any:
        return self._filled(GaugeMetricFamily(f"fusiond_{name}", about, labels=[*self._labels, *labels]), values)

    def _counter(self, name: str, about: str, values: Mapping[Any, float], *labels: str) -> Any:
        return self._filled(CounterMetricFamily(f"fusiond_{name}", about, labels=[*self._labels, *labels]), values)

    def _filled(self, family: Any, values: Mapping[Any, float]) -> Any:
        for labels, value in values.items():
            family.add_metric([*self._labels.values(), *labels], value)
        return family

    def _summary(self, name: str, about: str, values: Mapping[str, Quantiles | None], label: str) -> Any:
        """Quantiles of the latest few thousand; number and sum of all."""
        family = SummaryMetricFamily(f"fusiond_{name}", about, labels=[*self._labels, label])
        for key, found in values.items():
            if found is not None:
                labels = self._labels | {label: key}
                for field, quantile in QUANTILES.items():
                    family.add_sample(f"fusiond_{name}", labels | {"quantile": quantile}, getattr(found, field) / 1e3)
                family.add_metric(list(labels.values()), found.count, found.sum / 1e3)
        return family


class _Single:
    """A registry of one metric, as the encoders take it."""

    def __init__(self, family: Any) -> None:
        self._family = family

    def collect(self) -> Iterable[Any]:
        return (self._family,)


def _sum(outcomes: OutcomeCounts) -> int:
    return sum(msgspec.structs.astuple(outcomes))


def _seconds(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else milliseconds / 1e3
