"""Outputs at a replay: all that a live run sends, none of it lost, and what cannot be attached."""

from __future__ import annotations

import socket
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import msgspec
import pytest
import zenoh
from pymavlink.dialects.v20 import common

from fusiond.__main__ import SUCCESS, UNUSABLE, main
from fusiond.app.client import Client, ClientError
from fusiond.app.replay.attached import attachable
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.app.replay.summary import Summary
from fusiond.config import load as config
from fusiond.config.outputs import Zenoh
from fusiond.messages import (
    MESSAGES,
    ConfigMessage,
    EventMessage,
    HealthMessage,
    InfoMessage,
    InnovationMessage,
    Message,
    SettledMessage,
    StateMessage,
    decode,
    encode,
)
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.zenoh.session import alive_key, open_session
from tests.helpers.drive import LOGS, folder
from tests.helpers.zenoh import sees

DEADLINE = 15.0  # s
LIVE = {StateMessage, SettledMessage, InnovationMessage, EventMessage, HealthMessage, InfoMessage, ConfigMessage}
SHELL = {"latency_ms", "inputs", "outputs"}  # of the health


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def configured(where: Path, more: str) -> Path:
    """The drive's configuration with more in it."""
    (where / "wheels.dbc").write_bytes((folder() / "wheels.dbc").read_bytes())
    file = where / "car.toml"
    file.write_text((folder() / "fusiond.toml").read_text() + more)
    return file


def replay(file: Path, *arguments: object) -> int:
    logs = [str(folder() / log) for log in LOGS]
    return main(["replay", "--config", str(file), *logs, *map(str, arguments)])


def replayed(file: Path) -> list[Message]:
    """What a replay without outputs makes of the drive."""
    sent: list[Message] = []
    settings = config.load(file)
    logs = open_logs([str(folder() / log) for log in LOGS], settings)
    Replay(settings, ReplayTask(settings.publish.rate_hz, on_message=[sent.append])).run(logs)
    return sent


def numbers(message: Message) -> dict[str, Any]:
    """A message, without the health of inputs and outputs."""
    table: dict[str, Any] = msgspec.json.decode(encode(message, "json"))
    return {name: value for name, value in table.items() if name not in SHELL}


def kind_of(where: str) -> type[Message]:
    return MESSAGES[where.split("/")[2]]


def test_publish_sends_all_that_a_live_run_sends_and_loses_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At full speed, to a reader that is slow with each message, with the health of the output."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = configured(tmp_path, f'\n[zenoh]\nmode = "client"\nlisten = []\nconnect = ["{endpoint}"]\n')
    received: list[Message] = []
    tokens: list[tuple[str, zenoh.SampleKind]] = []

    def note(sample: zenoh.Sample) -> None:
        tokens.append((str(sample.key_expr), sample.kind))

    def keep(sample: zenoh.Sample) -> None:
        received.append(decode(sample.payload.to_bytes(), kind_of(str(sample.key_expr)), "json"))
        time.sleep(0.0005)

    with (
        open_session(Zenoh(listen=[endpoint])) as session,
        session.declare_subscriber("fusiond/tested/**", keep),
        session.liveliness().declare_subscriber("fusiond/*/@alive/state", note),
    ):
        assert replay(file, "--publish") == SUCCESS
        expected = replayed(file)
        deadline = time.monotonic() + DEADLINE
        while len(received) < len(expected) + 2 and time.monotonic() < deadline:
            time.sleep(0.05)
    assert "warning" not in capsys.readouterr().out
    assert {type(message) for message in received} == LIVE
    for kind in LIVE - {InfoMessage, ConfigMessage}:
        found = [numbers(message) for message in received if type(message) is kind]
        assert found == [numbers(message) for message in expected if type(message) is kind], kind
    assert tokens == [(alive_key("tested"), zenoh.SampleKind.PUT), (alive_key("tested"), zenoh.SampleKind.DELETE)]
    last = [message for message in received if isinstance(message, HealthMessage)][-1]
    assert last.outputs["zenoh"].offered > 1000 and last.outputs["zenoh"].dropped == 0
    assert last.latency_ms.published is None  # there is no pace to keep


def eventually(call: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + DEADLINE
    while True:
        try:
            return call()
        except ClientError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)


def test_a_replay_in_real_time_answers_as_a_daemon_does(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = configured(tmp_path, f'\n[zenoh]\nlisten = ["{endpoint}"]\n')
    codes: list[int] = []
    thread = Thread(target=lambda: codes.append(replay(file, "--publish", "--speed", 2)))
    thread.start()
    try:
        with eventually(lambda: Client(endpoint, "tested", timeout_s=1.0)) as client:
            assert sees(client, "tested")
            assert eventually(client.info).sources["imu0"] == "imu"
            assert client.config().config["vehicle"]["name"] == "tested"
            states = client.stream(StateMessage, DEADLINE)
            state = next(states)
            next(states)
            assert client.state_at(state.t_ns) == state
            health = eventually(client.health)
            assert "zenoh" in health.outputs
            assert health.latency_ms.published is None or health.latency_ms.published.p50 < 1000
    finally:
        thread.join(DEADLINE)
    assert codes == [SUCCESS]


def test_an_output_that_cannot_be_opened_ends_it_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as squatter:
        file = configured(tmp_path, f'\n[zenoh]\nlisten = ["tcp/127.0.0.1:{squatter.getsockname()[1]}"]\n')
        assert replay(file, "--publish") == UNUSABLE
    assert "zenoh: cannot listen on" in capsys.readouterr().err


def test_every_configured_output_can_be_attached(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Prometheus, the MCAP recorder, Foxglove and a ground station with a connection of its own; the autopilot cannot."""
    for extra in ("mcap", "foxglove", "prometheus_client"):
        pytest.importorskip(extra, reason=f"the extra {extra} is not installed")
    scrape, figures = free_port(), tmp_path / "summary.json"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", 0))
        ground.settimeout(DEADLINE)
        file = configured(tmp_path, f"""
[zenoh]
listen = ["tcp/127.0.0.1:{free_port()}"]
[prometheus]
enabled = true
port = {scrape}
[foxglove]
enabled = true
port = {free_port()}
[mcap]
folder = "recorded"
[autopilot]
link = "fcu"
[ground_station]
connection = "udpout:127.0.0.1:{ground.getsockname()[1]}"
""")
        codes: list[int] = []
        thread = Thread(target=lambda: codes.append(replay(file, "--outputs", "--speed", 4, "--json", figures)))
        thread.start()
        heard = {m.get_type() for _ in range(20) for m in common.MAVLink(None).parse_buffer(ground.recv(2048)) or []}
        with urllib.request.urlopen(f"http://127.0.0.1:{scrape}/metrics", timeout=DEADLINE) as answer:
            metrics = answer.read().decode()
        thread.join(DEADLINE)
    assert codes == [SUCCESS]
    assert {"ATTITUDE_QUATERNION_COV", "ESTIMATOR_STATUS"} <= heard
    assert "fusiond_mode" in metrics
    (recorded,) = (tmp_path / "recorded").iterdir()
    assert recorded.stat().st_size > 100_000
    why = "[autopilot] is not attached: it sends over [mavlink.fcu], which a replay does not open"
    assert msgspec.json.decode(figures.read_bytes(), type=Summary).warnings == [why]
    said = capsys.readouterr()
    assert why in said.err and why in said.out


def test_a_ground_station_over_a_link_is_not_attached(tmp_path: Path) -> None:
    loaded = config.load(configured(tmp_path, '\n[ground_station]\nlink = "fcu"\n'))
    left, refused = attachable(loaded)
    assert left.ground_station.link is None
    assert refused == ["[ground_station] is not attached: it sends over [mavlink.fcu], which a replay does not open"]


def test_outputs_change_nothing_in_the_files(tmp_path: Path) -> None:
    """The track of a replay with outputs is that of one without, byte for byte."""
    file = configured(tmp_path, f'\n[zenoh]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n')
    assert replay(file, "--publish", "--csv", tmp_path / "with.csv") == SUCCESS
    assert replay(file, "--csv", tmp_path / "without.csv") == SUCCESS
    assert (tmp_path / "with.csv").read_bytes() == (tmp_path / "without.csv").read_bytes()
