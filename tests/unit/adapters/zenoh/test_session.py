"""Zenoh adapter against real sessions: another process subscribes over TCP loopback and gets every bit."""

import json
import os
import socket
from pathlib import Path
from threading import Event
from typing import get_args

import pytest
import zenoh

from fusiond.config.outputs import Encoding, Zenoh
from fusiond.messages.codec import encode
from fusiond.messages.csv import csv_row
from fusiond_adapters.zenoh.session import (
    PublishError,
    ZenohPublisher,
    open_session,
    session_config,
    state_key,
)
from tests.helpers.estimates import random_messages
from tests.helpers.network import DEADLINE, free_port, python, read_line
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"
MESSAGES = 40

# Reads without fusiond's code: its own JSON or MessagePack, its own CSV row.
SUBSCRIBER = """
import json, queue, sys, msgspec, zenoh
port, count = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", json.dumps("client"))
config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
samples = queue.Queue()
with zenoh.open(config) as session, session.declare_subscriber("fusiond/*/state", samples.put):
    alive = [str(reply.ok.key_expr) for reply in session.liveliness().get("fusiond/*/@alive/**")]
    print(json.dumps(alive), flush=True)
    for _ in range(int(count)):
        sample = samples.get(timeout=15)
        payload = sample.payload.to_bytes()
        as_json = str(sample.encoding) == "application/json"
        message = json.loads(payload) if as_json else msgspec.msgpack.decode(payload)
        row = [""] * 14
        if message["state"]:
            s = message["state"]
            row = [s["lat_deg"], s["lon_deg"], s["height_m"], *s["velocity_ned_mps"], s["roll_deg"], s["pitch_deg"],
                   s["yaw_deg"], *s["sigma_position_ned_m"], s["sigma_velocity_mps"], s["sigma_yaw_deg"]]
        row = ",".join([str(message["t_ns"] // 1000), *(x if x == "" else repr(x) for x in row), message["mode"]])
        sent_as = [str(sample.key_expr), str(sample.encoding), str(sample.priority), sample.express]
        print(json.dumps([*sent_as, payload.hex(), row]), flush=True)
"""


def wait_for_reader(publisher: ZenohPublisher) -> None:
    matched = Event()

    def watch(status: zenoh.MatchingStatus) -> None:
        if status.matching:
            matched.set()

    with publisher._publishers[state_key("rover")].declare_matching_listener(watch):
        assert publisher.matched or matched.wait(DEADLINE), "no subscriber"


@pytest.mark.parametrize("encoding", get_args(Encoding))
def test_another_process_gets_every_bit(encoding: Encoding) -> None:
    port = free_port(socket.SOCK_STREAM)
    with (
        open_session(Zenoh(listen=[f"tcp/127.0.0.1:{port}"])) as session,
        ZenohPublisher(session, "rover", encoding) as publisher,
        python(SUBSCRIBER, port, MESSAGES) as reader,
    ):
        assert json.loads(read_line(reader)) == ["fusiond/rover/@alive/state"]
        wait_for_reader(publisher)
        for message in random_messages(MESSAGES):
            publisher.publish(message)
            key, content_type, priority, express, payload, row = json.loads(read_line(reader))
            assert bytes.fromhex(payload) == encode(message, encoding)
            assert row == csv_row(message)
            assert (key, content_type) == ("fusiond/rover/state", f"application/{encoding}")
            assert (priority, express) == (str(zenoh.Priority.REAL_TIME), True)
        assert reader.wait(DEADLINE) == 0


def test_the_documented_subscriber_works() -> None:
    text = (DOCS / "messages.md").read_text(encoding="utf-8")
    code = text.split("```python\n")[2].split("```")[0]
    assert len(code.splitlines()) <= 10
    port = free_port(socket.SOCK_STREAM)
    message = random_messages(2)[1]
    with (
        open_session(Zenoh(listen=[f"tcp/127.0.0.1:{port}"])) as session,
        ZenohPublisher(session, "rover", "json") as publisher,
        python(code.replace(":7447", f":{port}")) as reader,
    ):
        wait_for_reader(publisher)
        publisher.publish(message)
        assert message.state is not None
        assert read_line(reader) == f"rover nominal {message.state.lat_deg} {message.state.lon_deg}"


def listening() -> set[tuple[str, str, str]]:
    """This process's TCP listeners and UDP sockets: protocol, address [hex, as the kernel writes it], inode."""
    inodes = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            inodes.add(str(entry.readlink()))
        except FileNotFoundError:
            continue  # the folder's own descriptor
    found = set()
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/self/net/{protocol}").read_text().splitlines()[1:]:
            _, local, _, status, *_, inode = line.split()[:10]
            if f"socket:[{inode}]" in inodes and (protocol.startswith("udp") or status == "0A"):
                found.add((protocol, local.split(":")[0], inode))
    return found


@pytest.mark.skipif(not os.path.exists("/proc/self/net/tcp"), reason="needs Linux's /proc")  # noqa: PTH110
def test_by_default_only_loopback_is_used_and_nothing_scouts() -> None:
    before = listening()
    with open_session(Zenoh()) as session:
        assert [opened[:2] for opened in listening() - before] == [("tcp", "0100007F")]
        assert session.info.peers_zid() == [] and session.info.routers_zid() == []
    config = session_config(Zenoh())
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("scouting/gossip/enabled") == "false"
    assert json.loads(config.get_json("mode")) == "peer"
    assert json.loads(config.get_json("transport/unicast/max_sessions")) == 64


def test_a_burst_waits_and_an_impatient_publisher_does_not(tmp_path: Path) -> None:
    queue = "transport/link/tx/queue"
    for patient, wait_us in ((True, 1000), (False, 0)):
        config = session_config(Zenoh(), patient=patient)
        assert json.loads(config.get_json(f"{queue}/size/real_time")) == 16
        assert json.loads(config.get_json(f"{queue}/congestion_control/drop/wait_before_drop")) == wait_us
    (tmp_path / "own.json5").write_text("{transport: {link: {tx: {queue: {size: {real_time: 4}}}}}}")
    own = session_config(Zenoh(config_file="own.json5"), tmp_path)
    assert json.loads(own.get_json(f"{queue}/size/real_time")) == 4


def test_zenohs_own_file_rules_where_the_section_is_silent(tmp_path: Path) -> None:
    (tmp_path / "own.json5").write_text('{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:7447"]}, /* mine */}')
    config = session_config(Zenoh(config_file="own.json5"), tmp_path)
    assert json.loads(config.get_json("mode")) == "client"
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/10.0.0.1:7447"]
    assert json.loads(config.get_json("listen/endpoints")) == Zenoh().listen  # never Zenoh's own: all interfaces
    assert config.get_json("scouting/multicast/enabled") == "false"
    config = session_config(Zenoh(config_file="own.json5", connect=["tcp/127.0.0.1:1"]), tmp_path)
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/127.0.0.1:1"]
    (tmp_path / "open.json5").write_text("{scouting: {multicast: {enabled: true}}}")
    assert session_config(Zenoh(config_file="open.json5"), tmp_path).get_json("scouting/multicast/enabled") == "true"


def complaint(section: Zenoh, directory: Path = Path()) -> str:
    with pytest.raises(PublishError) as caught:
        open_session(section, directory)
    text = str(caught.value)
    assert text.startswith("zenoh: ") and ".rs" not in text
    return text


def test_a_port_in_use_is_named() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        text = complaint(Zenoh(listen=[endpoint]))
    assert endpoint in text and "Address already in use" in text


@pytest.mark.parametrize("endpoint", ["nonsense", "pigeon/127.0.0.1:1", "tcp/127.0.0.1:99999"])
def test_a_bad_endpoint_is_named(endpoint: str) -> None:
    assert endpoint in complaint(Zenoh(listen=[endpoint]))


def test_a_client_without_anything_to_connect_to_is_reported() -> None:
    assert "nothing to connect to is given" in complaint(Zenoh(mode="client"))
    nobody = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    assert "no Zenoh answers there" in complaint(Zenoh(mode="client", connect=[nobody]))


@pytest.mark.parametrize("content", [None, b"", b"{", b'{"nokey": 1}', b"\xff\xfe"])
def test_a_bad_config_file_is_named(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "own.json5").write_bytes(content)
    assert "own.json5" in complaint(Zenoh(config_file="own.json5"), tmp_path)


def test_publishing_after_the_end_is_an_error_and_closing_twice_is_not() -> None:
    with open_session(Zenoh()) as session:
        with ZenohPublisher(session, "rover", "json") as publisher:
            publisher.publish(random_messages(1)[0])
            assert not publisher.matched
        publisher.close()
        with pytest.raises(PublishError, match="fusiond/rover/state"):
            publisher.publish(random_messages(1)[0])
    with pytest.raises(PublishError, match="session closed"):
        ZenohPublisher(session, "rover", "json")


def test_the_token_goes_with_the_publisher() -> None:
    port = free_port(socket.SOCK_STREAM)
    come, gone = Event(), Event()

    def watch(sample: zenoh.Sample) -> None:
        (gone if sample.kind == zenoh.SampleKind.DELETE else come).set()

    with (
        open_session(Zenoh(listen=[f"tcp/127.0.0.1:{port}"])) as session,
        open_session(Zenoh(mode="client", connect=[f"tcp/127.0.0.1:{port}"])) as other,
        other.liveliness().declare_subscriber("fusiond/*/@alive/state", watch, history=True),
    ):
        publisher = ZenohPublisher(session, "rover", "json")
        assert come.wait(DEADLINE) and not gone.is_set()
        publisher.close()
        assert gone.wait(DEADLINE)
