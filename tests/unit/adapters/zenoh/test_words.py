"""Endpoints as users write them, and Zenoh's errors without Rust's notation."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from fusiond.config.outputs import Zenoh
from fusiond_adapters.zenoh.session import PublishError, open_session
from fusiond_adapters.zenoh.words import endpoint, in_words
from tests.helpers.network import free_port


@pytest.mark.parametrize(("written", "meant"), [
    ("192.168.1.5", "tcp/192.168.1.5:7447"),
    ("192.168.1.5:7448", "tcp/192.168.1.5:7448"),
    ("rover.local", "tcp/rover.local:7447"),
    ("[fe80::1]:7448", "tcp/[fe80::1]:7448"),
    ("[fe80::1]", "tcp/[fe80::1]:7447"),
    ("fe80::1", "tcp/[fe80::1]:7447"),
    ("tls/rover:7447", "tls/rover:7447"),
])  # fmt: skip
def test_a_host_is_an_endpoint(written: str, meant: str) -> None:
    assert endpoint(written) == meant


def complaint(section: Zenoh, directory: Path = Path()) -> str:
    with pytest.raises(PublishError) as caught:
        open_session(section, directory)
    return str(caught.value)


def test_nobody_there() -> None:
    where = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    client = Zenoh(mode="client", listen=[], connect=[where])
    assert complaint(client) == f"zenoh: cannot connect to {where}: no Zenoh answers there"
    by_tls = Zenoh(mode="client", listen=[], connect=[f"tls/{where}"])
    assert complaint(by_tls).endswith("no Zenoh answers there, or one side refuses the other's certificate")
    assert complaint(Zenoh(mode="client")).endswith("nothing to connect to is given, and multicast scouting is off")


def test_a_port_in_use() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        where = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert complaint(Zenoh(listen=[where])) == f"zenoh: cannot listen on {where}: Address already in use"


@pytest.mark.parametrize(("content", "reason"), [
    ("{", "line 1, column 2: expected identifier or string"),
    ('{mode: "pigeon"}', "line 1, column 8: unknown variant `pigeon`, expected one of `router`, `peer`, `client`"),
    ("{\n connect: 3}", "line 2, column 11: invalid type: integer `3`"),
])  # fmt: skip
def test_what_is_wrong_in_zenohs_own_file(content: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "own.json5").write_text(content)
    text = complaint(Zenoh(config_file="own.json5"), tmp_path)
    assert f"own.json5: {reason}" in text
    assert "Message {" not in text and "\n" not in text


def test_rusts_notation_does_not_come_through() -> None:
    rust = 'Json5Err(Message { msg: "must be \\"so\\"", location: Some(Location { line: 1, column: 2 }) }) at io/x.rs:12.'
    assert in_words(Exception(rust)) == 'line 1, column 2: must be "so"'
    assert in_words(Exception("Unable to connect to any of [Single(tcp/a:1), Single(tcp/b:2)]! at x/y.rs:3.")) == (
        "no Zenoh answers there"
    )
