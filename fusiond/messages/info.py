"""Messages that change only with a reload: what is running, and its configuration."""

from __future__ import annotations

from typing import Any

import msgspec

from fusiond import __version__
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.filter.kernel.interpreted import Kernel
from fusiond.filter.observations import IMU, MODELS
from fusiond.messages.keys import key
from fusiond.messages.types import MESSAGES, SCHEMA_VERSION, ConfigMessage, InfoMessage


def config_table(config: Config) -> dict[str, Any]:
    """The configuration as a table of plain values, defaults filled in."""
    table: dict[str, Any] = msgspec.to_builtins(config)
    del table["directory"]
    return table


def info_message(config: Config, fusion: Fusion) -> InfoMessage:
    """What is running here."""
    vehicle, params = config.vehicle.name, fusion.params
    kinds = ("imu" if model == IMU else MODELS[model].name for model in params.models)
    return InfoMessage(
        vehicle=vehicle,
        version=__version__,
        kernel="numpy" if isinstance(fusion.history.kernel, Kernel) else "compiled",
        encoding=config.publish.encoding,
        schemas=dict.fromkeys(MESSAGES, SCHEMA_VERSION),
        keys={kind: key(vehicle, kind, "*" if kind == "innovations" else "") for kind in MESSAGES},
        sources=dict(zip(params.sources, kinds, strict=True)),
        config=config_table(config),
    )


def config_message(config: Config) -> ConfigMessage:
    """The configuration in force."""
    return ConfigMessage(vehicle=config.vehicle.name, config=config_table(config))
