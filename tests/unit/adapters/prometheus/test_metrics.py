"""The metrics: by the makers' parsers, by promtool where it is installed, and as the dashboard and the alarms name them."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import time
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fusiond.messages.types import (
    HealthMessage,
    InnovationMessage,
    InputHealth,
    LatencyHealth,
    OutputHealth,
    Quantiles,
    StateMessage,
)
from tests.helpers.drive import messages
from tests.helpers.paths import ROOT

pytest.importorskip("prometheus_client", reason="the extra prometheus is not installed")

from prometheus_client.openmetrics.parser import text_string_to_metric_families as of_openmetrics
from prometheus_client.parser import text_string_to_metric_families as of_text

from fusiond_adapters.prometheus.metrics import OPENMETRICS, PLAIN, Page

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]
EXAMPLES = ROOT / "configs" / "prometheus"
PROMTOOL = shutil.which("promtool")
QUANTILES = Quantiles(p50=1.0, p90=2.0, p99=3.0, max=4.0, count=500, sum=600.0)


def page_of(published: list[Any]) -> Page:
    page = Page("tested")
    for message in published:
        page.record(message)
    return page


@cache
def everything() -> list[Any]:
    """All kinds of messages, with latencies of everything."""
    published = list(messages())
    health = [message for message in published if isinstance(message, HealthMessage)][-1]
    inputs = {"can.car": InputHealth(received=100, dropped=7, counts={})}
    outputs = {
        "zenoh": OutputHealth(offered=50, dropped=3, latency_ms=QUANTILES, counts={}, notes={}),
        "record": OutputHealth(offered=50, dropped=3, counts={}, notes={}),
    }
    latency = LatencyHealth(fused=QUANTILES, published=QUANTILES)
    whole = msgspec.structs.replace(health, latency_ms=latency, inputs=inputs, outputs=outputs)
    return [*published[: published.index(health)], whole]


@cache
def full() -> Samples:
    """A scrape after everything."""
    return samples(page_of(everything()))


def text(page: Page, accept: str = "") -> str:
    return b"".join(page.text(accept)[1]).decode()


def samples(page: Page) -> Samples:
    return {(s.name, frozenset(s.labels.items())): s.value for family in of_text(text(page)) for s in family.samples}


def value(found: Samples, name: str, **labels: str) -> float:
    return found[f"fusiond_{name}", frozenset({"vehicle": "tested", **labels}.items())]


def test_state_sources_and_innovations() -> None:
    published = everything()
    states = [message for message in published if isinstance(message, StateMessage)]
    health, state = published[-1], states[-1]
    innovations = [message for message in published if isinstance(message, InnovationMessage)]
    found = full()
    assert state.state is not None and value(found, "info", version=health.version) == 1
    assert value(found, "mode", mode="dead_reckoning") == 1 and value(found, "mode", mode="nominal") == 0
    assert value(found, "position_sigma_meters", axis="d") == state.state.sigma_position_ned_m[2]
    assert value(found, "yaw_sigma_radians") == pytest.approx(math.radians(state.state.sigma_yaw_deg))
    assert value(found, "resets_total") == state.resets
    for source, one in health.sources.items():
        outcomes = msgspec.structs.asdict(one.outcomes)
        assert value(found, "measurements_received_total", source=source) == sum(outcomes.values()) > 0
        for outcome, count in outcomes.items():
            assert value(found, "measurements", source=source, outcome=outcome) == count
        assert value(found, "source_present", source=source) == one.present
    ratios = [one.test_ratio for one in innovations if one.source == "rear_left" and one.test_ratio is not None]
    assert value(found, "test_ratio_count", source="rear_left") == len(ratios) > 100
    assert value(found, "test_ratio_bucket", source="rear_left", le="1.0") == sum(ratio <= 1 for ratio in ratios)
    assert value(found, "measurement_delay_seconds_count", source="gps0.position") > 20


def test_latencies_are_a_summary_and_losses_are_counters() -> None:
    found = full()
    assert value(found, "latency_seconds", stage="fused", quantile="0.99") == 0.003
    assert value(found, "latency_seconds_count", stage="published") == 500
    assert value(found, "latency_seconds_sum", stage="published") == 0.6
    assert value(found, "output_latency_seconds", output="zenoh", quantile="1") == 0.004
    assert ("fusiond_output_latency_seconds_count", frozenset({("vehicle", "tested"), ("output", "record")})) not in found
    assert value(found, "input_frames_total", input="can.car") == 100
    assert value(found, "input_dropped_total", input="can.car") == 7
    assert value(found, "output_dropped_total", output="zenoh") == 3


def test_without_a_state_its_sigmas_are_missing() -> None:
    found = samples(page_of([next(message for message in messages() if isinstance(message, StateMessage))]))
    assert value(found, "has_state") == 0
    assert not any(name == "fusiond_position_sigma_meters" for name, _ in found)


@pytest.mark.parametrize("published", [everything, list])
def test_both_formats_hold_their_rules_and_say_the_same(published: Any) -> None:
    """The parser of OpenMetrics is strict: names, types, suffixes, labels, the end."""
    page = page_of(published())
    kind, pieces = page.text(f"{OPENMETRICS};q=0.5,text/plain;q=0.3")
    assert kind == OPENMETRICS and page.text("*/*")[0] == page.text("")[0] == PLAIN
    strict = list(of_openmetrics(b"".join(pieces).decode()))
    ours = [family for family in strict if family.name.startswith("fusiond")]
    assert len({family.name for family in strict}) == len(strict)
    for family in ours:
        assert family.documentation and family.type != "unknown"
        assert all(sample.labels["vehicle"] == "tested" for sample in family.samples)
        reserved = {label for sample in family.samples for label in sample.labels} & {"le", "quantile"}
        assert reserved <= {"histogram": {"le"}, "summary": {"quantile"}}.get(family.type, set()), family.name
    varies = {"process_cpu_seconds_total", "process_virtual_memory_bytes", "process_resident_memory_bytes"}
    both = [
        {(s.name, frozenset(s.labels.items()), s.value) for f in families for s in f.samples if s.name not in varies}
        for families in (strict, of_text(text(page)))
    ]
    assert both[0] == both[1]


@pytest.mark.parametrize("accept", [PLAIN, OPENMETRICS])
def test_no_piece_takes_long(accept: str) -> None:
    """The estimator may have to wait for one: the median over some pages, of the longest, by processor time."""
    page, longest = page_of(everything()), list[float]()
    for _ in range(7):
        pieces, took = page.text(accept)[1], list[float]()
        while True:
            began = time.thread_time()
            if next(pieces, None) is None:
                break
            took.append(time.thread_time() - began)
        longest.append(max(took))
    assert sorted(longest)[3] < 1e-3


@pytest.mark.skipif(PROMTOOL is None, reason="there is no promtool")
def test_promtool_finds_nothing(tmp_path: Path) -> None:
    assert PROMTOOL is not None
    for command, given in (
        (["check", "metrics"], text(page_of(everything()))),
        (["check", "rules", str(EXAMPLES / "fusiond-alarms.yml")], ""),
        (["check", "config", str(EXAMPLES / "prometheus.yml")], ""),
    ):
        done = subprocess.run([PROMTOOL, *command], input=given, capture_output=True, text=True, check=False)
        assert done.returncode == 0 and "FAILED" not in done.stdout and not done.stderr, done.stdout + done.stderr


def expressions() -> list[str]:
    dashboard = json.loads((EXAMPLES / "fusiond-dashboard.json").read_text())
    shown = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    alarms = re.findall(r"^ +expr: (.+)$", (EXAMPLES / "fusiond-alarms.yml").read_text(), re.MULTILINE)
    assert len(shown) > 15 and len(alarms) > 8
    return [*shown, *alarms]


@pytest.mark.parametrize("expression", expressions())
def test_the_dashboard_and_the_alarms_name_what_there_is(expression: str) -> None:
    found = full()
    selectors = re.findall(r"\b((?:fusiond|process)_\w+)(?:\{([^}]*)\})?", expression)
    assert selectors or expression == 'up{job="fusiond"} == 0'
    for name, matchers in selectors:
        wanted = dict(re.findall(r'(\w+)="([^"$]*)"', matchers))
        labels = [dict(labels) for have, labels in found if have == name]
        if name.startswith("fusiond_mode"):
            wanted.pop("mode", None)
            assert re.search(r'mode="(\w+)"', matchers) is None or {"lost", "nominal"} <= {one["mode"] for one in labels}
        assert any(wanted.items() <= one.items() for one in labels), name
        for label in re.findall(r"(\w+)!?=", matchers):
            assert label == "instance" or all(label in one for one in labels), (name, label)


def test_the_panels_do_not_overlap() -> None:
    panels = [panel["gridPos"] for panel in json.loads((EXAMPLES / "fusiond-dashboard.json").read_text())["panels"]]
    cells = [(x, y) for p in panels for x in range(p["x"], p["x"] + p["w"]) for y in range(p["y"], p["y"] + p["h"])]
    assert len(cells) == len(set(cells)) and max(x for x, _ in cells) < 24
