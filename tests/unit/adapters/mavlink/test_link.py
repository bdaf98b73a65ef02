"""A MAVLink link: its frames to inbox and listeners, messages to the peer, and a link that cannot be opened."""

from __future__ import annotations

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
