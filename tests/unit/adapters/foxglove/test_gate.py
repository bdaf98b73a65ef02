"""The gate before a server: who may come, how many, and that bytes pass unchanged."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from threading import Event, Thread

import pytest

from fusiond_adapters.foxglove import gate
from fusiond_adapters.foxglove.gate import MAX_CLIENTS, Gate, hidden_host, may_come
from tests.helpers.network import DEADLINE

HELLO = b"GET / HTTP/1.1\r\nHost: x\r\n\r\nmore"
SITES = ("https://app.foxglove.dev",)


@contextmanager
def echo() -> Iterator[tuple[str, int]]:
    """A server that returns what it gets, at a hidden address."""
    with socket.create_server((hidden_host(), 0)) as listener, ExitStack() as closing:

        def serve() -> None:
            while True:
                try:
                    peer, _ = listener.accept()
                except OSError:
                    return
                closing.enter_context(peer)
                Thread(target=echo_to, args=(peer,), daemon=True).start()

        def echo_to(peer: socket.socket) -> None:
            try:
                while data := peer.recv(4096):
                    peer.sendall(data)
                peer.shutdown(socket.SHUT_WR)
            except OSError:
                return  # the client has gone

        thread = Thread(target=serve)
        thread.start()
        try:
            yield listener.getsockname()
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join(DEADLINE)


@contextmanager
def gated() -> Iterator[Gate]:
    with echo() as inside:
        made = Gate("127.0.0.1", 0, inside, SITES)
        made.start()
        try:
            yield made
        finally:
            made.stop()
            made.check()


def connect(made: Gate) -> socket.socket:
    return socket.create_connection(("127.0.0.1", made.port), DEADLINE)


def until(condition: Callable[[], bool]) -> None:
    for _ in range(int(DEADLINE * 200)):
        if condition():
            return
        Event().wait(0.005)
    raise AssertionError("not reached")


def received(peer: socket.socket, size: int) -> bytes:
    gathered = b""
    while len(gathered) < size and (data := peer.recv(1 << 16)):
        gathered += data
    return gathered


@pytest.mark.parametrize(
    ("origin", "may"),
    [
        (None, True),
        ("https://app.foxglove.dev", True),
        ("file://", True),
        ("app://lichtblick", True),
        ("https://evil.example", False),
        ("HTTPS://evil.example", False),
        ("http://app.foxglove.dev", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("null", False),
        ("", False),
        ("file://,https://evil.example", False),
    ],
)
def test_origins(origin: str | None, may: bool) -> None:
    assert may_come(origin, SITES) is may


def test_bytes_pass_unchanged_both_ways() -> None:
    sent = bytes(range(256)) * 4000
    with gated() as made, connect(made) as peer:
        peer.sendall(HELLO)
        assert received(peer, len(HELLO)) == HELLO
        Thread(target=peer.sendall, args=(sent,)).start()
        assert received(peer, len(sent)) == sent
        peer.shutdown(socket.SHUT_WR)
        assert peer.recv(1) == b""
    assert made.counts == {"clients": 1}


def test_more_clients_than_allowed_are_refused_until_one_leaves() -> None:
    with gated() as made, ExitStack() as connected:
        peers = [connected.enter_context(connect(made)) for _ in range(MAX_CLIENTS)]
        for peer in peers:
            peer.sendall(HELLO)
            assert received(peer, len(HELLO)) == HELLO
        with connect(made) as late:
            late.sendall(HELLO)
            assert late.recv(4096).startswith(b"HTTP/1.1 503 ")
        assert (made.counts["clients"], made.counts["refused"]) == (MAX_CLIENTS, 1)
        peers[0].close()
        until(lambda: made.clients == MAX_CLIENTS - 1)
        with connect(made) as late:
            late.sendall(HELLO)
            assert received(late, len(HELLO)) == HELLO


def test_who_says_nothing_does_not_keep_others_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "TIMEOUT_S", 0.1)
    with gated() as made, ExitStack() as connected:
        for _ in range(2 * MAX_CLIENTS):
            connected.enter_context(connect(made))
        with connect(made) as peer:
            peer.sendall(HELLO)
            assert received(peer, len(HELLO)) == HELLO
        assert made.counts["timed out"] >= MAX_CLIENTS


def test_nonsense_is_refused() -> None:
    with gated() as made:
        for nonsense in (bytes(10_000), b"GET / HTTP/1.1\r\nOrigin: https://evil.example\r\n\r\n"):
            with connect(made) as peer:
                peer.sendall(nonsense)
                assert peer.recv(12) in (b"HTTP/1.1 400", b"HTTP/1.1 403")
    assert made.counts == {"refused": 2}


def test_a_server_that_is_gone_is_no_fault_of_the_gate() -> None:
    with socket.create_server((hidden_host(), 0)) as gone:
        inside = gone.getsockname()
    made = Gate("127.0.0.1", 0, inside, SITES)
    made.start()
    with connect(made) as peer:
        peer.sendall(HELLO)
        assert peer.recv(1) == b""
    made.stop()
    made.check()
    assert made.counts == {"clients": 1, "lost": 1}
