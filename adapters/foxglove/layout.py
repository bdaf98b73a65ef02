"""A layout for Foxglove that fits a vehicle's sources: python -m fusiond_adapters.foxglove.layout car.toml > layout.json"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from fusiond.config.load import load
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.messages.types import HealthMessage, StateMessage
from fusiond_adapters.foxglove.converter import (
    BODY,
    LOCATION,
    LOG,
    ORIGIN,
    POSE,
    ROOT,
    TOPICS,
    TRAIL,
    innovations_topic,
    judged_sources,
)

STATE = TOPICS[StateMessage]
AXES = ("north", "east", "down")

STRIP_PERCENT = 20  # of the height: two strips of 64 pixels with axis and title are 190, on a screen of 1080

Panel = dict[str, Any]


def layout(config: Config) -> Panel:
    """The layout: modes over the whole width; map and 3-D view on the left, plots on the right; events and health below."""
    panels = {
        "map!place": _map(),
        "3D!scene": _scene(),
        "StateTransitions!mode": _transitions(),
        "Plot!speed": _plot("Speed [m/s]", [(f"{STATE}.state.velocity_ned_mps[{i}]", name) for i, name in enumerate(AXES)]),
        "Plot!sigmas": _plot("Sigmas", _sigmas()),
        "Plot!ratios": _plot("Test ratios: 1 is the gate", [
            (f"{innovations_topic(source)}.test_ratio", source) for source in judged_sources(config)
        ]),
        "RosOut!events": _titled("Events", {"searchTerms": [], "minLogLevel": 1, "topicToRender": LOG}),
        "RawMessages!health": _titled("Health", {"topicPath": TOPICS[HealthMessage], "diffEnabled": False}),
    }  # fmt: skip
    left = _split("column", "map!place", "3D!scene", 50)
    right = _split("column", "Plot!speed", _split("column", "Plot!sigmas", "Plot!ratios", 50), 33)
    below = _split("row", "RosOut!events", "RawMessages!health", 50)
    views = _split("column", _split("row", left, right, 45), below, 78)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", "StateTransitions!mode", views, STRIP_PERCENT),
    }


def _split(direction: str, first: str | Panel, second: str | Panel, percentage: int) -> Panel:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _titled(title: str, panel: Panel) -> Panel:
    """A panel with a title: each of the two programs has a key of its own for it."""
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title, **panel}


def _map() -> Panel:
    panel = {
        "layer": "map",
        "followTopic": LOCATION,
        "disabledTopics": [ORIGIN],
        "topicColors": {},
        "zoomLevel": 17,
    }
    return _titled("Position", panel)


def _scene() -> Panel:
    grid = {"instanceId": "grid", "layerId": "foxglove.Grid", "visible": True, "frameId": ROOT, "size": 200, "divisions": 20}
    panel = {
        "followMode": "follow-position",
        "followTf": BODY,
        "cameraState": {"perspective": True, "distance": 30, "phi": 60, "thetaOffset": 45, "target": [0, 0, 0]},
        "scene": {"transforms": {"axisScale": 2, "showLabel": True}},
        "topics": {
            POSE: {"visible": True, "type": "axis", "axisScale": 3},
            TRAIL: {"visible": True, "type": "line", "lineWidth": 0.4, "gradient": ["#50c87840", "#50c878ff"]},
        },
        "layers": {"grid": grid},
    }
    return _titled("Attitude and trail", panel)


def _transitions() -> Panel:
    paths = [(f"{STATE}.mode", "mode"), (f"{STATE}.resets", "resets")]
    return _titled("Mode and resets", {"isSynced": True, "paths": _paths(paths)})


def _sigmas() -> list[tuple[str, str]]:
    position = [(f"{STATE}.state.sigma_position_ned_m[{i}]", f"{axis} [m]") for i, axis in enumerate(AXES)]
    velocity = (f"{STATE}.state.sigma_velocity_mps", "velocity [m/s]")
    return [*position, velocity, (f"{STATE}.state.sigma_yaw_deg", "yaw [deg]")]


def _plot(title: str, paths: Iterable[tuple[str, str]]) -> Panel:
    panel = {
        "paths": _paths(paths),
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }
    return _titled(title, panel)


def _paths(paths: Iterable[tuple[str, str]]) -> list[Panel]:
    return [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"} for path, label in paths
    ]


def text(config: Config) -> str:
    """The layout as a file's text."""
    return json.dumps(layout(config), indent=2) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    """python -m fusiond_adapters.foxglove.layout"""
    arguments = sys.argv[1:] if argv is None else argv
    if len(arguments) != 1:
        print("give a configuration file: python -m fusiond_adapters.foxglove.layout car.toml", file=sys.stderr)
        return 2
    try:
        sys.stdout.write(text(load(arguments[0])))
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
