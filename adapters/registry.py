"""Every input, every output and every log format, one line each.

A line names a module of fusiond_adapters. It is imported only when the configuration needs it, so that unused adapters cost
no time. A module of an input or an output has a function `make`, which returns one or more adapters; that of a log format
has `open_log`, see `logs.format`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from fusiond.config.schema import Config
from fusiond.config.toml import all_made
from fusiond.ports.inputs import InputContext, LiveInput
from fusiond.ports.outputs import LiveOutput, OutputContext
from fusiond_adapters.logs.format import LogFormat

INPUTS: Mapping[str, str] = {  # section of the configuration: module
    "mavlink": "mavlink.link",
    "can": "can.bus",
}
OUTPUTS: Mapping[str, Callable[[Config], bool]] = {  # module: whether the configuration needs it
    "zenoh.output": lambda config: True,  # fusiond's own programs read from it
    "ros2.output": lambda config: config.ros2.enabled,
    "mcap": lambda config: config.mcap.folder is not None,
    "foxglove.server": lambda config: config.foxglove.enabled,
    "prometheus.server": lambda config: config.prometheus.enabled,
    "mavlink.outputs": lambda config: _mavlink_outputs(config) != {None},
}
LOG_FORMATS = (
    LogFormat(".tlog", "MAVLink", "logs.tlog"),
    LogFormat(".bin", "ArduPilot DataFlash", "logs.dataflash"),
    LogFormat(".ulg", "PX4 ULog", "logs.ulog"),
    LogFormat(".log", "candump -L", "logs.candump"),
    LogFormat(".asc", "Vector ASC", "logs.python_can"),
    LogFormat(".blf", "Vector BLF", "logs.python_can"),
    LogFormat(".trc", "PEAK TRC", "logs.python_can"),
    LogFormat(".csv", "python-can CSV", "logs.python_can"),
    LogFormat(".db", "python-can SQLite", "logs.python_can"),
    LogFormat(".mf4", "ASAM MDF 4", "logs.python_can"),
)


def _mavlink_outputs(config: Config) -> set[str | None]:
    """The links and connections of the outputs over MAVLink."""
    return {config.autopilot.link, config.ground_station.link, config.ground_station.connection}


def make_inputs(config: Config, context: InputContext) -> dict[str, LiveInput[Any]]:
    """The inputs of a configuration, by section and name, such as mavlink.fc. Raises ConfigError."""
    sections = [section for section in INPUTS if getattr(config, section)]
    made: list[Sequence[LiveInput[Any]]] = all_made(partial(_make, INPUTS[section], config, context) for section in sections)
    return {f"{section}.{one.name}": one for section, inputs in zip(sections, made, strict=True) for one in inputs}


def make_outputs(config: Config, context: OutputContext) -> dict[str, LiveOutput]:
    """The outputs of a configuration, by name. Raises ConfigError, also where an extra is missing."""
    wanted = (module for module, is_wanted in OUTPUTS.items() if is_wanted(config))
    made: list[Sequence[LiveOutput]] = all_made(partial(_make, module, config, context) for module in wanted)
    return {one.name: one for outputs in made for one in outputs}


def _make(module: str, *arguments: object) -> Any:
    return import_module(f"fusiond_adapters.{module}").make(*arguments)
