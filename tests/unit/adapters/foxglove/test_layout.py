"""The layout for Foxglove in the documentation: current, and every path in it exists."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fusiond_adapters.foxglove import layout as foxglove_layout
from fusiond_adapters.foxglove.converter import TRAIL, channels
from tests.helpers.foxglove import PLAIN, fields
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"


def test_the_documented_layout_fits_the_demo_and_its_paths_exist() -> None:
    from fusiond.app.demo import demo  # noqa: PLC0415
    from fusiond.config import load as config  # noqa: PLC0415

    car = config.load(demo.DRIVE / "fusiond.toml")
    text = (DOCS / "foxglove-layout.json").read_text()
    assert text == foxglove_layout.text(car), "write it anew: python -m fusiond_adapters.foxglove.layout CONFIG"
    layout = json.loads(text)
    schemas = {channel.topic: json.loads(channel.schema) for channel in channels(car)}

    def panels(part: str | dict[str, Any]) -> Iterator[str]:
        if isinstance(part, str):
            yield part
        else:
            yield from panels(part["first"])
            yield from panels(part["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    for panel in layout["configById"].values():
        for path in panel.get("paths", []):
            topic, dot, rest = path["value"].partition(".")
            assert fields(schemas[topic], dot + rest)["type"] in PLAIN
        named = [panel[key] for key in ("followTopic", "topicToRender", "topicPath") if key in panel]
        assert all(topic in schemas for topic in [*named, *panel.get("topics", {})])
    ratios = {path["value"] for path in layout["configById"]["Plot!ratios"]["paths"]}
    sources = [source.replace(".", "/") for source in car.sources() if source != "imu0"]
    assert ratios == {f"/fusiond/innovations/{source}.test_ratio" for source in sources}


def test_every_panel_has_a_title_and_the_modes_have_room() -> None:
    from fusiond.app.demo import demo  # noqa: PLC0415
    from fusiond.config import load as config  # noqa: PLC0415

    made = foxglove_layout.layout(config.load(demo.DRIVE / "fusiond.toml"))
    titles = [panel["foxglovePanelTitle"] for panel in made["configById"].values()]
    assert all(titles) and len(set(titles)) == len(titles)
    assert titles == [panel["lichtblickPanelTitle"] for panel in made["configById"].values()]  # its key since the fork
    strip, whole = made["configById"]["StateTransitions!mode"], made["layout"]
    assert (whole["direction"], whole["first"]) == ("column", "StateTransitions!mode")  # over the whole width
    pixels = 64 * len(strip["paths"]) + 30 + 30  # a strip for each path, the axis, the title
    assert whole["splitPercentage"] / 100 * 950 >= pixels
    trail = made["configById"]["3D!scene"]["topics"][TRAIL]
    assert trail["visible"] and trail["type"] == "line"


def test_the_layout_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert foxglove_layout.main([str(tmp_path / "none.toml")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert foxglove_layout.main([]) == 2
