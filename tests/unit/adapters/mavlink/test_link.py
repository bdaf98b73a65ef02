"""A MAVLink link: its frames to inbox and listeners, messages to the peer, and a link that cannot be opened."""

from __future__ import annotations

import random
import socket
from pathlib import Path
from threading import Event, Thread

import msgspec
import pytest
from pymavlink.dialects.v20 import common

from fusiond.config.toml import ConfigError
from fusiond.ports.inputs import InputLost
from fusiond_adapters.mavlink.decoder import message_id
from tests.helpers.mavlink_peers import Endpoint, TcpPeer, UdpPeer, greeted, link_of, link_to, serving
from tests.helpers.network import DEADLINE


def heartbeat() -> common.MAVLink_message:
    return common.MAVLink_heartbeat_message(common.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3)


def test_frames_go_to_the_inbox_and_to_listeners_and_garbage_is_counted(tmp_path: Path) -> None:
    peer = UdpPeer()
    _, link = link_to(peer, tmp_path)
    endpoint, heard = Endpoint(peer), list[bytes]()
    link.listeners.append(lambda frame, _: heard.append(frame))
    with serving(link):
        greeted(endpoint, link)
        peer.send(b"garbage")
        endpoint.heartbeat()
        endpoint.until(lambda: link.counts()["garbage bytes"] == 7)
    frames = [frame for _, frame in link.inbox.take()]
    assert frames == heard
    assert {message_id(frame) for frame in frames} == {common.MAVLINK_MSG_ID_HEARTBEAT}
    assert link.counts()["sessions"] == 1
    peer.close()


def test_messages_are_sent_only_while_it_is_open(tmp_path: Path) -> None:
    peer = UdpPeer()
    _, link = link_to(peer, tmp_path)
    endpoint = Endpoint(peer)
    assert not link.send(heartbeat())
    with serving(link):
        greeted(endpoint, link)
        sent = link.counts()["sent"]
        assert link.send(common.MAVLink_named_value_int_message(0, b"test", 5))
        endpoint.until(lambda: [m.value for m in endpoint.of("NAMED_VALUE_INT")] == [5])
        assert link.counts()["sent"] > sent
    assert not link.send(heartbeat())
    peer.close()


def test_messages_go_to_peers_that_sent_valid_frames(tmp_path: Path) -> None:
    """Garbage, the beginning of a frame and a message of unknown checksum do not make a recipient."""
    peer, stranger = UdpPeer(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stranger.settimeout(0.05)
    _, link = link_to(peer, tmp_path)
    endpoint = Endpoint(peer)
    unknown = bytes((0xFD, 2, 0, 0, 1, 7, 1, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0))
    address = ("127.0.0.1", int(peer.connection.rpartition(":")[2]))
    with serving(link), stranger:
        endpoint.until(lambda: link.sessions == 1)
        for data in (b"garbage", unknown[:10], unknown):
            stranger.sendto(data, address)
        greeted(endpoint, link)
        endpoint.until(lambda: link.counts()["datagrams"] >= 4)
        assert link.send(common.MAVLink_named_value_int_message(0, b"test", 5))
        endpoint.until(lambda: bool(endpoint.of("NAMED_VALUE_INT")))
        with pytest.raises(TimeoutError):
            stranger.recv(100)
    peer.close()


def test_where_signing_is_on_messages_go_to_those_who_sign(tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(bytes(32))
    (tmp_path / "key").chmod(0o600)
    peer, stranger = UdpPeer(), UdpPeer()
    text = 'signing_key_file = "key"\nsigning_timestamp_file = "stamp"\naccept_unsigned = true'
    _, link = link_to(peer, tmp_path, link=text)
    stranger.follow(peer)
    endpoint, other = Endpoint(peer), Endpoint(stranger, system=8)
    endpoint.sender.signing.secret_key, endpoint.sender.signing.sign_outgoing = bytes(32), True
    endpoint.sender.signing.timestamp = 1 << 47  # later than any
    with serving(link):
        endpoint.until(lambda: link.sessions == 1)
        other.heartbeat()
        greeted(endpoint, link)
        endpoint.until(lambda: link.send(common.MAVLink_named_value_int_message(0, b"test", 5)))
        endpoint.until(lambda: bool(endpoint.of("NAMED_VALUE_INT")))
        assert link.counts()["unsigned"] == 0  # they may come
        assert stranger.receive() == b""
    peer.close()
    stranger.close()


def test_every_byte_of_a_link_is_accounted_for(tmp_path: Path) -> None:
    """Sent: whole frames, broken ones, beginnings of frames, garbage, a frame cut in two; read in one session."""
    peer, noise = UdpPeer(), random.Random(7)
    _, link = link_to(peer, tmp_path)
    endpoint, sent = Endpoint(peer), [0, 0]

    def send(data: bytes) -> None:
        peer.send(data)
        sent[0], sent[1] = sent[0] + 1, sent[1] + len(data)

    def frame() -> bytes:
        packed = bytes(heartbeat().pack(endpoint.sender))
        endpoint.sender.seq = (endpoint.sender.seq + 1) & 0xFF
        return packed

    with serving(link):
        endpoint.until(lambda: link.sessions == 1)
        greeted(endpoint, link)
        endpoint.until(lambda: link.counts()["datagrams"] == endpoint.sent)
        whole_before = link.inbox.received
        for number in range(400):
            data = bytearray(frame())
            if number % 4 == 1:
                data[noise.randrange(len(data))] ^= 1 << noise.randrange(8)
            send(bytes(data[: noise.randrange(1, len(data))] if number % 4 == 2 else data))
            if number % 4 == 3:
                send(noise.randbytes(noise.randrange(1, 300)))
        endpoint.until(lambda: link.counts()["datagrams"] == endpoint.sent + sent[0])
    counts, frames = link.counts(), [data for _, data in link.inbox.take()]
    assert counts["lost in the kernel's queue"] == link.inbox.dropped == 0
    assert sum(map(len, frames[whole_before:])) + counts["garbage bytes"] == sent[1]
    assert len(frames) - whole_before >= 200
    for data in frames:
        link.decode(data, 1)
    kinds = ("decoded", "skipped", "other systems", "other components", "bad checksum", "undecodable")
    assert sum(link.counts()[kind] for kind in kinds) == len(frames)
    peer.close()


def test_a_peer_that_is_missing_or_disconnects_is_a_lost_input(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    peer = TcpPeer()
    settings, link = link_to(peer, tmp_path)
    moved = msgspec.structs.replace(settings.mavlink["fc"], connection=f"tcp:127.0.0.1:{port}")
    link.adopt(link_of(msgspec.structs.replace(settings, mavlink={"fc": moved})))
    with pytest.raises(InputLost, match="cannot be opened: Connection refused"):
        link.session(Event())
    link.adopt(link_of(settings))

    def hang_up() -> None:
        peer.connected.close()  # accepted only now

    thread = Thread(target=hang_up)
    thread.start()
    with pytest.raises(InputLost, match="lost: closed by the peer"):
        link.session(Event())
    thread.join(DEADLINE)
    assert not link.send(heartbeat())
    peer.close()


def test_a_wrong_connection_is_a_fault_of_the_configuration(tmp_path: Path) -> None:
    peer = UdpPeer()
    settings, _ = link_to(peer, tmp_path)
    wrong = msgspec.structs.replace(settings.mavlink["fc"], connection="carrier:pigeon")
    with pytest.raises(ConfigError, match=r"mavlink\.fc\.connection: 'carrier:pigeon'"):
        link_of(msgspec.structs.replace(settings, mavlink={"fc": wrong}))
    peer.close()
