"""The configurations for autopilots: each can be used, and the autopilot's parameters beside it are those of the docs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fusiond.config.explain import oddities
from fusiond.config.load import load
from tests.helpers.paths import ROOT

CONFIGS = ROOT / "configs"
NO_WHEELS = "no [wheel.NAME]"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?")
PARAMETER_FILES = ["ardupilot-rover.parm", "px4-rover.params"]


def parameters(file: Path) -> dict[str, float]:
    """Names and values: `NAME VALUE` of a .parm (MAVProxy), `system component NAME value type` of .params (QGroundControl).
    Every group of them follows a comment with the reason."""
    found: dict[str, float] = {}
    explained = False
    for line in file.read_text().splitlines():
        if line.startswith("#") or not line:
            explained = bool(line)
            continue
        assert explained, f"no reason for {line}"
        if file.suffix == ".parm":
            name, value = line.split()
        else:
            system, component, name, value, kind = line.split("\t")
            assert (system, component) == ("1", "1")
            assert kind == ("9" if "." in value else "6"), line
        assert name not in found
        found[name] = float(value)
    return found


def documented() -> dict[str, set[float]]:
    """Every parameter in a table of docs/autopilot.md, with the numbers in the other cells of its row."""
    found: dict[str, set[float]] = {}
    for line in (ROOT / "docs" / "autopilot.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("| `") or len(cells) < 2:
            continue
        numbers = {float(number) for number in NUMBER.findall(" ".join(cells[1:]))}
        whole = ""
        for name in re.findall(r"`([A-Z0-9_]+)`", cells[0]):
            whole = whole.rpartition("_")[0] + name if name.startswith("_") else name
            found.setdefault(whole, set()).update(numbers)
    return found


@pytest.mark.parametrize("name", PARAMETER_FILES)
def test_parameters_are_those_of_the_docs(name: str) -> None:
    known = documented()
    for parameter, value in parameters(CONFIGS / name).items():
        assert parameter in known
        assert value in known[parameter], f"{parameter} {value}: docs/autopilot.md has {known[parameter]}"


@pytest.mark.parametrize("name", PARAMETER_FILES)
def test_the_configuration_can_be_used(name: str) -> None:
    config = load((CONFIGS / name).with_suffix(".toml"))
    assert [odd for odd in oddities(config) if not odd.startswith(NO_WHEELS)] == []


def test_the_delay_is_that_of_the_filters() -> None:
    """A Butterworth filter of the second order delays by sqrt(2) / (2 pi cutoff)."""
    values = parameters(CONFIGS / "ardupilot-rover.parm")
    imu = load(CONFIGS / "ardupilot-rover.toml").imu["imu0"]
    assert values["INS_GYRO_FILTER"] == values["INS_ACCEL_FILTER"]
    assert imu.delay_ms == pytest.approx(225.08 / values["INS_GYRO_FILTER"], abs=0.1)
    assert 1.25 * imu.rate_hz <= values["SCHED_LOOP_RATE"]
    values = parameters(CONFIGS / "px4-rover.params")
    assert load(CONFIGS / "px4-rover.toml").imu["imu0"].delay_ms == pytest.approx(500 / values["IMU_INTEG_RATE"])
