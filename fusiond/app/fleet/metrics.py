"""A fleet as metrics for Prometheus: aggregates over all vehicles, and the few of each. Needs the extra `prometheus`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, get_args

from fusiond.app.fleet.vehicles import AlarmKind, Picture, Urgency, Vehicle
from fusiond.errors import UsageError
from fusiond.estimator.solution import Mode

try:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
    from prometheus_client.exposition import generate_latest

    from fusiond_adapters.prometheus.metrics import PLAIN
except ModuleNotFoundError as missing:
    raise UsageError("--prometheus needs the extra prometheus: pip install 'fusiond[prometheus]'") from missing

Metrics = Iterator[Any]


class FleetPage:
    """What a scrape returns: the picture that `look` gives then."""

    def __init__(self, look: Callable[[], Picture]) -> None:
        self._look = look

    def text(self, _accept: str) -> tuple[str, Iterator[bytes]]:
        """The content type, and the text of one metric after the other."""
        return PLAIN, (generate_latest(_Single(family)) for family in families(self._look()))


def families(picture: Picture) -> Metrics:
    """All metrics."""
    vehicles = picture.vehicles
    modes = Counter(vehicle.state.mode for vehicle in vehicles if vehicle.state and vehicle.present is not False)
    yield _gauge("vehicles", "Vehicles by mode", {(mode.value,): modes[mode] for mode in Mode}, "mode")
    yield _gauge("present", "1 if its fusiond is connected", {(v.name,): float(v.present is not False) for v in vehicles})
    found = Counter((alarm.kind, alarm.urgency) for alarms in picture.alarms.values() for alarm in alarms)
    alarms = {(kind, urgency): found[kind, urgency] for kind in get_args(AlarmKind) for urgency in get_args(Urgency)}
    yield _gauge("alarms", "Alarms", alarms, "kind", "urgency")
    critical = {
        (one.name,): float(any(alarm.urgency == "critical" for alarm in picture.alarms[one.name])) for one in vehicles
    }
    yield _gauge("critical", "1 if it has a critical alarm", critical)
    yield _gauge("state_age_seconds", "Since its last state was heard", {(v.name,): v.age_s for v in vehicles})
    yield _gauge("state_rate_hertz", "States heard a second, recently", {(v.name,): v.rate_hz for v in vehicles})
    states = CounterMetricFamily("fusiond_fleet_states", "States heard", labels=["vehicle"])
    for vehicle in vehicles:
        states.add_metric([vehicle.name], vehicle.states)
    yield states
    yield from _motion(vehicles)


def _motion(vehicles: Iterable[Vehicle]) -> Metrics:
    known = [(one.name, one.state.state) for one in vehicles if one.state is not None and one.state.state is not None]
    for name, about, value in (
        ("latitude_degrees", "WGS-84", lambda state: state.lat_deg),
        ("longitude_degrees", "WGS-84", lambda state: state.lon_deg),
        ("speed_meters_per_second", "Over ground, horizontal", lambda state: math.hypot(*state.velocity_ned_mps[:2])),
        ("position_sigma_meters", "Root sum of squares of the north and east sigma",
         lambda state: math.hypot(*state.sigma_position_ned_m[:2])),
    ):  # fmt: skip
        yield _gauge(name, about, {(vehicle,): value(state) for vehicle, state in known})


def _gauge(name: str, about: str, values: Mapping[Any, float], *labels: str) -> Any:
    family = GaugeMetricFamily(f"fusiond_fleet_{name}", about, labels=list(labels) or ["vehicle"])
    for given, value in values.items():
        family.add_metric(list(given), value)
    return family


class _Single:
    """A registry of one metric, as the encoder takes it."""

    def __init__(self, family: Any) -> None:
        self._family = family

    def collect(self) -> Iterable[Any]:
        return (self._family,)
