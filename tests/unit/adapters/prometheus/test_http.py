"""The HTTP server against clients that are greedy, slow, or speak nonsense."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from urllib.request import urlopen

import pytest

from fusiond_adapters.prometheus import http
from fusiond_adapters.prometheus.http import MAX_CLIENTS, HttpServer, Page
from tests.helpers.network import DEADLINE


def page(accept: str) -> tuple[str, Iterator[bytes]]:
    """Two pieces, and the Accept header as a type."""
    return f"text/{accept or 'plain'}", iter([b"one ", b"two\n"])


@contextmanager
def serving(made: Page = page, now_s: Callable[[], float] = time.monotonic) -> Iterator[HttpServer]:
    server = HttpServer("127.0.0.1", 0, "/metrics", made, now_s)
    server.start()
    try:
        yield server
    finally:
        server.stop()


def connect(server: HttpServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), DEADLINE)


def said(server: HttpServer, request: bytes) -> tuple[str, bytes]:
    """The first line of the answer, and its contents."""
    with connect(server) as client:
        client.sendall(request)
        client.shutdown(socket.SHUT_WR)
        answer = b"".join(iter(lambda: client.recv(4096), b""))
    head, _, content = answer.partition(b"\r\n\r\n")
    return head.split(b"\r\n")[0].decode(), content


def until(condition: Callable[[], bool]) -> None:
    ends = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < ends, "not reached"
        time.sleep(0.005)


def test_a_page_by_a_client_of_the_standard_library() -> None:
    with serving() as server:
        with urlopen(f"http://127.0.0.1:{server.port}/metrics?name=x", timeout=DEADLINE) as answer:
            assert (answer.status, answer.headers["Content-Type"], answer.read()) == (200, "text/plain", b"one two\n")
        assert said(server, b"GET /metrics HTTP/1.1\r\naccept: a\r\nX: y\r\nAccept:b\r\n\r\n")[1] == b"one two\n"
        assert server.counts == {"answered": 2}


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "404 Not Found"),
        (b"POST /metrics HTTP/1.1\r\n\r\nbody", "405 Method Not Allowed"),
        (b"\x16\x03\x01\x02\x00\r\n\r\n", "400 Bad Request"),
        (b"GET /metrics\r\n\r\n", "400 Bad Request"),
        (b"GET /metrics HTTP/1.1\r\n", "400 Bad Request"),  # and it ends
        (b"", "400 Bad Request"),
        (b"GET /metrics HTTP/1.1\r\nX: " + bytes(9000), "400 Bad Request"),
    ],
)
def test_nonsense_is_refused_and_counted(request_: bytes, status: str) -> None:
    with serving() as server:
        assert said(server, request_)[0] == f"HTTP/1.1 {status}"
        until(lambda: server.counts == {"refused": 1})


def test_the_page_is_made_once_a_second_however_often_it_is_asked_for() -> None:
    made: list[str] = []

    def counted(accept: str) -> tuple[str, Iterator[bytes]]:
        def pieces() -> Iterator[bytes]:
            made.append(accept)
            yield b"x"

        return "text/plain", pieces()

    now = [100.0]
    with serving(counted, lambda: now[0]) as server:
        for _ in range(20):
            assert said(server, b"GET /metrics HTTP/1.1\r\n\r\n")[1] == b"x"
        assert len(made) == 1
        now[0] += 1.0
        said(server, b"GET /metrics HTTP/1.1\r\n\r\n")
        assert len(made) == 2


def test_clients_that_say_nothing_are_few_and_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take no thread and few files; whoever comes after them is served."""
    monkeypatch.setattr(http, "TIMEOUT_S", 0.1)
    with serving() as server, ExitStack() as idle:
        files, threads = (len(os.listdir(f"/proc/self/{name}")) for name in ("fd", "task"))  # noqa: PTH208
        for number in range(2 * MAX_CLIENTS):
            client = idle.enter_context(connect(server))
            if number % 2:
                client.sendall(b"GET /metr")
        held = len(os.listdir("/proc/self/fd")) - files - 2 * MAX_CLIENTS  # noqa: PTH208
        assert held <= MAX_CLIENTS and len(os.listdir("/proc/self/task")) == threads  # noqa: PTH208
        until(lambda: server.counts["timed out"] == 2 * MAX_CLIENTS)
        assert said(server, b"GET /metrics HTTP/1.1\r\n\r\n")[0] == "HTTP/1.1 200 OK"


def test_a_client_that_reads_nothing_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "TIMEOUT_S", 0.2)

    def large(_: str) -> tuple[str, Iterator[bytes]]:
        return "text/plain", iter([bytes(1 << 24)])

    with serving(large) as server, connect(server) as client:
        client.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        until(lambda: server.counts["timed out"] == 1)


def test_a_client_that_breaks_off_is_counted() -> None:
    with serving() as server, connect(server) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        client.close()
        until(lambda: server.counts.total() == 1)
    assert server.counts == {"lost": 1}


def test_a_fault_of_the_page_ends_it_with_the_reason() -> None:
    def faulty(_: str) -> tuple[str, Iterator[bytes]]:
        raise ZeroDivisionError("in the page")

    server = HttpServer("127.0.0.1", 0, "/metrics", faulty)
    server.start()
    server.check()
    with closing(connect(server)) as client:
        client.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        assert client.recv(1) == b""
    server.stop()
    with pytest.raises(ExceptionGroup) as raised:
        server.check()
    assert raised.group_contains(ZeroDivisionError, match="in the page")


def test_it_stops_at_once_with_clients_connected() -> None:
    with serving() as server, connect(server):
        began = time.monotonic()
        server.stop()
        assert time.monotonic() - began < http.TIMEOUT_S / 2


def test_who_scrapes_without_end_gets_a_twentieth_of_the_time() -> None:
    with serving() as server:
        (thread,) = (one for one in threading.enumerate() if one.name == "http")
        clock = time.pthread_getcpuclockid(thread.ident or 0)
        began, worked = time.monotonic(), time.clock_gettime(clock)
        for _ in range(40):
            assert said(server, b"GET /metrics HTTP/1.1\r\n\r\n")[1] == b"one two\n"
        took, worked = time.monotonic() - began, time.clock_gettime(clock) - worked
    assert worked < 0.06 * took + 0.002
