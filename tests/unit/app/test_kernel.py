"""A kernel that was not compiled is told by check, replay and run."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from fusiond.__main__ import main
from fusiond.app.kernel import slow_kernel
from fusiond.filter.kernel.interpreted import compiled_available
from tests.helpers.drive import LOGS, folder
from tests.helpers.live import configuration, running
from tests.helpers.network import free_port

TOLD = "compiled kernel was not built"


@pytest.fixture
def not_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user is told so; the filter itself is not slowed down."""
    monkeypatch.setattr("fusiond.app.kernel.compiled_available", lambda: False)


def test_nothing_is_told_where_it_was_built() -> None:
    assert compiled_available() == (slow_kernel() is None)


@pytest.mark.usefixtures("not_built")
def test_check_and_replay_tell_it(capsys: pytest.CaptureFixture[str]) -> None:
    file = str(folder() / "fusiond.toml")
    assert main(["check", "--config", file]) == 0
    out = capsys.readouterr().out
    assert f"warning: the filter's {TOLD}" in out and "1 warning(s)" in out
    assert main(["replay", "--config", file, *(str(folder() / log) for log in LOGS)]) == 0
    captured = capsys.readouterr()
    assert TOLD in captured.err and TOLD not in captured.out


@pytest.mark.usefixtures("not_built")
def test_run_tells_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), running(configuration(tmp_path, f"udpin:127.0.0.1:{free_port()}")) as run:
        run.until(lambda: TOLD in caplog.text)
