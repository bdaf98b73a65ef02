"""The demonstration with a short drive instead of the bundled one: publication, and a port in use."""

from __future__ import annotations

import gzip
import socket
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import pytest
from msgspec.structs import replace

from fusiond.__main__ import SUCCESS, UNUSABLE, main
from fusiond.app.client import Client, ClientError
from fusiond.app.demo import demo
from fusiond.config.outputs import Zenoh
from fusiond.config.schema import Config
from fusiond.messages import HealthMessage, StateMessage
from fusiond.units import SECOND
from tests.helpers.drive import LOGS, folder
from tests.helpers.zenoh import sees

DEADLINE = 15.0  # s


@pytest.fixture
def port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """The port of the demonstration, with the drive of the tests."""
    for name in (*LOGS, "fusiond.toml", "wheels.dbc"):
        (tmp_path / name).write_bytes((folder() / name).read_bytes())
    (tmp_path / "truth.csv.gz").write_bytes(gzip.compress((folder() / "truth.csv").read_bytes()))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number = int(probe.getsockname()[1])
    settings: Callable[[str], Config] = demo._settings
    monkeypatch.setattr(demo, "DRIVE", tmp_path)
    monkeypatch.setattr(demo, "LOGS", LOGS)
    monkeypatch.setattr(demo, "LENGTH_NS", 8 * SECOND)
    monkeypatch.setattr(
        demo, "_settings", lambda folder: replace(settings(folder), zenoh=Zenoh(listen=[f"tcp/127.0.0.1:{number}"]))
    )
    return number


def test_it_is_published_for_top(port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    codes: list[int] = []
    command = ["demo", "--publish", "--speed", "2", "--out", str(tmp_path / "out")]
    thread = Thread(target=lambda: codes.append(main(command)))
    thread.start()
    try:
        client = None
        while client is None and thread.is_alive():
            try:
                client = Client(f"tcp/127.0.0.1:{port}", "tested")
            except ClientError:
                continue
        assert client is not None
        with client:
            state = next(client.stream(StateMessage, DEADLINE))
            assert sees(client, "tested")
            assert client.latest(HealthMessage).outputs["zenoh"].dropped == 0
            assert client.state_at(state.t_ns) == state
    finally:
        thread.join(DEADLINE)
    assert codes == [SUCCESS]
    assert "fusiond top" in capsys.readouterr().out


def test_a_port_in_use_is_reported_at_once(port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", port)):
        assert main(["demo", "--publish", "--out", str(tmp_path / "out")]) == UNUSABLE
    assert "zenoh: cannot listen on" in capsys.readouterr().err
