"""The tables of adapters: every line names a module with its function, and a configuration gets what it asks for."""

from __future__ import annotations

import importlib
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from fusiond.config import load as config
from fusiond.config.toml import ConfigError
from fusiond.ports.inputs import InputContext
from fusiond.ports.outputs import OutputContext
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.registry import INPUTS, LOG_FORMATS, OUTPUTS, make_inputs, make_outputs
from tests.helpers.live import configuration

CONTEXT = InputContext(HostClock(), lambda: None, lambda: True)


@pytest.mark.parametrize("module", [*INPUTS.values(), *OUTPUTS])
def test_every_input_and_output_can_be_made(module: str) -> None:
    try:
        assert callable(import_module(f"fusiond_adapters.{module}").make)
    except ConfigError as missing:
        pytest.skip(str(missing))


@pytest.mark.parametrize("reader", sorted({kind.reader for kind in LOG_FORMATS}))
def test_every_log_format_has_a_reader(reader: str) -> None:
    assert callable(import_module(f"fusiond_adapters.{reader}").open_log)


def test_suffixes_are_unique() -> None:
    assert len({kind.suffix for kind in LOG_FORMATS}) == len(LOG_FORMATS)


def test_inputs_are_named_by_section(tmp_path: Path) -> None:
    assert list(make_inputs(configuration(tmp_path, "udpin:127.0.0.1:14550"), CONTEXT)) == ["mavlink.fc", "can.car"]


def test_a_configuration_gets_the_outputs_that_it_turns_on(tmp_path: Path) -> None:
    plain = configuration(tmp_path, "udpin:127.0.0.1:14550")
    assert list(make_outputs(plain, OutputContext(CONTEXT.clock, make_inputs(plain, CONTEXT)))) == ["zenoh"]
    more = '[autopilot]\nlink = "fc"\n[ground_station]\nconnection = "udpout:127.0.0.1:14551"\n'
    asked = configuration(tmp_path, "udpin:127.0.0.1:14550", more)
    made = make_outputs(asked, OutputContext(CONTEXT.clock, make_inputs(asked, CONTEXT)))
    assert list(made) == ["zenoh", "autopilot", "ground_station"]


def test_an_unknown_log_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "a.odd").write_bytes(b"x")
    with pytest.raises(LogError) as refused:
        open_logs([tmp_path / "a.odd"], config.parse('[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[gnss.g]\nlink = "fc"\n'))
    text = str(refused.value)
    assert all(f"{kind.suffix} ({kind.about})" in text for kind in LOG_FORMATS)
    assert text.endswith("all also with .gz or .zst")


def test_nothing_is_imported_for_what_is_off() -> None:
    code = "import sys, fusiond_adapters.registry; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"rosbags", "mcap", "foxglove", "prometheus_client", "zenoh", "can", "cantools"} & set(loaded)


@pytest.mark.parametrize(
    ("adapter", "library"), [("mcap", "mcap"), ("foxglove.server", "foxglove"), ("prometheus.server", "prometheus_client")]
)
def test_a_missing_extra_is_named(adapter: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)  # as if it were not installed
    package = f"fusiond_adapters.{adapter.partition('.')[0]}"
    for name in [name for name in sys.modules if name.startswith(package)]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(ConfigError, match=rf"pip install 'fusiond\[{adapter.removesuffix('.server')}\]'"):
        importlib.import_module(f"fusiond_adapters.{adapter}")
