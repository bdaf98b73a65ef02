"""The presets: configurations to begin with, of makers of cars, each with its DBC file. They are installed with fusiond."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """The names of the presets: those of their .toml files."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def preset(name: str) -> Path:
    """The .toml file of a preset; its DBC file is beside it."""
    return FOLDER / f"{name}.toml"
