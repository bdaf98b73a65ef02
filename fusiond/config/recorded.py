"""The configuration as a black box keeps it beside its recordings: JSON with all defaults, and copies of the DBC files.

It says what a recording was made with after the files of the vehicle have changed. `load` reads it like any other.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError

NAME = "config.json"


def files(config: Config) -> Iterator[tuple[str, bytes]]:
    """The files to keep, with their names: of each bus its DBC files, and the configuration, which names them so. Raises
    OSError."""
    table: dict[str, Any] = msgspec.to_builtins(config)
    del table["directory"]
    for bus, section in config.can.items():
        names = [f"{bus}_{number}.dbc" for number in range(len(section.dbc))]
        table["can"][bus]["dbc"] = names
        for name, dbc in zip(names, section.dbc, strict=True):
            yield name, config.path(dbc).read_bytes()
    yield NAME, msgspec.json.format(msgspec.json.encode(table), indent=1) + b"\n"


def parse(text: str, path: Path) -> Config:
    """The configuration of such a text. Raises ConfigError."""
    try:
        table = msgspec.json.decode(text, type=dict[str, Any])
        return msgspec.convert({**table, "directory": str(path.parent)}, Config)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path}: {error}") from error
