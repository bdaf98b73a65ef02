"""A fleet for Foxglove: all vehicles on the map, and alarms in its log. Needs the extra `foxglove`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from typing import Any

from fusiond.app.fleet.vehicles import Alarm, Changes, Picture, Vehicle
from fusiond.units import SECOND

VEHICLES, LOG = "/fleet/vehicles", "/fleet/log"
SCHEMAS = {  # Foxglove's own
    VEHICLES: ("foxglove.GeoJSON", {"type": "object", "properties": {"geojson": {"type": "string"}}}),
    LOG: (
        "foxglove.Log",
        {
            "type": "object",
            "properties": {
                "timestamp": {
                    "type": "object", "title": "time",
                    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
                },
                "level": {"type": "integer"}, "message": {"type": "string"}, "name": {"type": "string"},
                "file": {"type": "string"}, "line": {"type": "integer"},
            },
        },
    ),
}  # fmt: skip
COLOURS = {"critical": "#d62728", "warning": "#ff9900", None: "#009e73"}
LEVELS = {"critical": 4, "warning": 3}
ENDED = 2  # information


class FleetMap:
    """Makes the records of the topics from pictures. `now_ns` reads Unix time."""

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._changes, self._now_ns = Changes(), now_ns

    def records(self, picture: Picture) -> Iterator[tuple[str, bytes, int]]:
        """Topic, JSON, and time [ns]."""
        now_ns = self._now_ns()
        features = [_feature(one, picture.alarms[one.name]) for one in picture.vehicles if one.state and one.state.state]
        collection = json.dumps({"type": "FeatureCollection", "features": features})
        yield VEHICLES, json.dumps({"geojson": collection}).encode(), now_ns
        for begun, alarm in self._changes.since(picture):
            yield LOG, json.dumps(_log(begun, alarm, now_ns)).encode(), now_ns


def _feature(vehicle: Vehicle, alarms: tuple[Alarm, ...]) -> dict[str, Any]:
    assert vehicle.state is not None and vehicle.state.state is not None
    state = vehicle.state.state
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [state.lon_deg, state.lat_deg]},
        "properties": {
            "name": vehicle.name,
            "mode": vehicle.state.mode.value,
            "age_s": round(vehicle.age_s, 1),
            "alarms": "; ".join(alarm.text for alarm in alarms),
            "style": {"color": COLOURS[alarms[0].urgency if alarms else None]},
        },
    }


def _log(begun: bool, alarm: Alarm, now_ns: int) -> dict[str, Any]:
    second, rest = divmod(now_ns, SECOND)
    return {
        "timestamp": {"sec": second, "nsec": rest},
        "level": LEVELS[alarm.urgency] if begun else ENDED,
        "message": alarm.text if begun else f"ended: {alarm.text}",
        "name": alarm.vehicle,
        "file": "",
        "line": 0,
    }
