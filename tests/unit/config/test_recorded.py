"""The configuration that a black box keeps: it means the same as the one that was used, with its DBC files beside it."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from fusiond.config import load, recorded
from fusiond.config.toml import ConfigError
from tests.helpers.paths import ROOT

CONFIGS = sorted([*(ROOT / "configs").glob("*.toml"), *(ROOT / "configs" / "cars").glob("*.toml")])


def keep(path: Path, folder: Path) -> Path:
    for name, content in recorded.files(load.load(path)):
        (folder / name).write_bytes(content)
    return folder / recorded.NAME


@pytest.mark.parametrize("path", [path for path in CONFIGS if path.name != "simulate-demo.toml"], ids=lambda path: path.stem)
def test_a_kept_configuration_means_the_same(path: Path, tmp_path: Path) -> None:
    used, kept = load.load(path), load.load(keep(path, tmp_path))
    assert set(kept.can) == set(used.can)
    for bus, section in kept.can.items():
        for name, original in zip(section.dbc, used.can[bus].dbc, strict=True):
            assert (tmp_path / name).read_bytes() == used.path(original).read_bytes()
    assert replace(kept, can=used.can, directory=used.directory) == used


@pytest.mark.parametrize(("text", "why"), [("{", "truncated"), ('{"imu": 3}', "imu"), ("[]", "array"), ("{}", "imu")])
def test_a_damaged_one_is_refused(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / recorded.NAME).write_text(text)
    with pytest.raises(ConfigError, match=rf"config\.json.*{why}"):
        load.load(tmp_path / recorded.NAME)
