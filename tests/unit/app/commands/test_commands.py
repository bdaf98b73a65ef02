"""The commands: each a module, found by its name; only the one that is called is imported."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from importlib import import_module

import pytest

from fusiond import __main__ as entry
from fusiond.app.commands import COMMANDS, interrupts_end_at_once

HEAVY = (
    "fusiond.app.replay", "fusiond.app.demo", "fusiond.app.top", "fusiond.simulation", "zenoh", "can", "cantools", "numpy",
)  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_each_has_arguments_and_an_action(name: str) -> None:
    module = import_module(f"fusiond.app.commands.{name}")
    assert callable(module.fill) and callable(module.run)
    assert module.__doc__ and module.__doc__.startswith(f"fusiond {name}: ")


def test_each_explains_itself_without_any_extra() -> None:
    """The man page is made where only the core is installed."""
    extras = ("fsspec", "pyarrow", "distributed", "bokeh", "matplotlib", "pandas", "rosbags", "mcap", "foxglove", "xxhash",
              "prometheus_client", "pyulog", "asammdf", "zstandard")  # fmt: skip
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({extras})); import fusiond.__main__ as m\n"
        f"for name in {tuple(COMMANDS)}: m.parser(name).format_help()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_daemon_imports_no_other_command() -> None:
    """Its grammar imports next to nothing; all of the daemon no module of another command."""
    code = (
        "import sys, fusiond.__main__ as m; m.parser('run'); print(*sys.modules)\n"
        "import fusiond.app.live.serve; print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    grammar, daemon = (line.split() for line in done.stdout.splitlines())
    assert not [module for module in grammar if module.startswith(HEAVY)]
    own = HEAVY[:4]
    assert not [module for module in daemon if module.startswith(own)]
    folder = "fusiond.app.commands."
    assert {module for module in daemon if module.startswith(folder)} == {f"{folder}run", f"{folder}arguments"}


def test_no_exception_interrupts_an_import(monkeypatch: pytest.MonkeyPatch) -> None:
    handlers = []
    grammar = entry.parser

    def parser(command: str | None = None) -> argparse.ArgumentParser:
        handlers.append(signal.getsignal(signal.SIGINT))
        return grammar(command)

    monkeypatch.setattr(entry, "parser", parser)
    assert entry.main(["check", "--config", "nowhere.toml"]) == 2
    assert handlers == [signal.SIG_DFL]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_ignored_interrupt_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_end_at_once():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
