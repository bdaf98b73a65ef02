"""Transports of links: connection strings, what the kernel drops, who gets replies, and lines that accept parts."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from fusiond_adapters.mavlink import transport
from fusiond_adapters.mavlink.transport import FORGET_S, IN_KERNEL, MAX_PEERS, SILENT_S, TURNED_AWAY, WholeFrames, opener
from tests.helpers.network import DEADLINE, free_port


def test_a_line_that_accepts_parts_gets_whole_frames() -> None:
    got, room = bytearray(), [0]

    def write(data: bytes) -> int:
        if room[0] == 0:
            raise BlockingIOError
        taken = min(room[0], len(data))
        got.extend(data[:taken])
        room[0] -= taken
        return taken

    line = WholeFrames(write)
    frames = [bytes([number]) * 10 for number in range(40)]
    taken = []
    for number, frame in enumerate(frames):
        room[0] += number % 9
        if line.put(frame):
            taken.append(frame)
    room[0] = 100
    assert line.put(b"last")
    assert bytes(got) == b"".join(taken) + b"last"
    assert 5 < len(taken) < 30


@pytest.mark.parametrize(
    "wrong", ["udpin:14550", "tcp:host:port", "carrier:pigeon", "/dev/ttyACM0,fast", "udpin:h:70000", ""]
)
def test_wrong_connection_strings(wrong: str) -> None:
    with pytest.raises(ValueError):
        opener(wrong, 57600)


@contextmanager
def opened(connection: str) -> Iterator[Any]:
    with closing(opener(connection, 57600)()) as made:
        yield made


def everything(made: Any) -> list[tuple[bytes, Any]]:
    """What is waiting."""
    found: list[tuple[bytes, Any]] = []
    while chunks := made.read(0):
        found += chunks
    return found


class Clock:
    """Stands in for the monotonic clock of the transport."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(transport.time, "monotonic", lambda: self.now_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


# --- UDP


def peers(count: int, stack: ExitStack) -> list[socket.socket]:
    made = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
    for one in made:
        one.bind(("127.0.0.1", 0))
        one.settimeout(0.01)
    return made


def heard_by(made: list[socket.socket]) -> list[int]:
    found = []
    for number, one in enumerate(made):
        try:
            one.recv(100)
            found.append(number)
        except TimeoutError:
            pass
    return found


def test_datagrams_that_the_kernel_drops_are_counted() -> None:
    """As many as the queue does not hold: sent = read + dropped. The kernel tells it with the next that it keeps."""
    port, sent = free_port(), 0
    with opened(f"udpin:127.0.0.1:{port}") as made, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        read = 0
        for _ in range(3):
            for _ in range(6000):
                sent += peer.sendto(b"x" * 40, ("127.0.0.1", port)) == 40
            read += len(everything(made))
        sent += peer.sendto(b"the last", ("127.0.0.1", port)) == 8
        read += len(everything(made))
        assert made.counts["datagrams"] == read
        assert made.counts[IN_KERNEL] > 0
        assert read + made.counts[IN_KERNEL] == sent


def test_the_queue_holds_more_than_by_default() -> None:
    with opened(f"udpin:127.0.0.1:{free_port()}") as made, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as usual:
        size = made.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        assert size >= usual.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        assert size == 2 * min(transport.QUEUE_BYTES, int(Path("/proc/sys/net/core/rmem_max").read_text()))


def test_a_flood_is_read_in_parts() -> None:
    port = free_port()
    with opened(f"udpin:127.0.0.1:{port}") as made, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        for _ in range(transport.DATAGRAMS + 1):
            peer.sendto(b"x", ("127.0.0.1", port))
        assert (len(made.read(1)), made.more) == (transport.DATAGRAMS, True)
        assert (len(made.read(1)), made.more) == (1, False)


@pytest.mark.parametrize("shares", [False, True])
def test_a_second_process_cannot_take_the_port(shares: bool) -> None:
    port = free_port()
    with opened(f"udpin:127.0.0.1:{port}"), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
        if shares:
            second.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        for address in ("127.0.0.1", "0.0.0.0"):
            with pytest.raises(OSError, match="Address already in use"):
                second.bind((address, port))
        with pytest.raises(OSError, match="Address already in use"):
            opener(f"udpin:127.0.0.1:{port}", 57600)()


def test_a_port_that_another_process_shares_is_not_taken() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
        first.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        first.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="Address already in use"):
            opener(f"udpin:127.0.0.1:{first.getsockname()[1]}", 57600)()


def test_replies_go_to_peers_that_sent_valid_frames(clock: Clock) -> None:
    port = free_port()
    with ExitStack() as stack:
        made = stack.enter_context(opened(f"udpin:127.0.0.1:{port}"))
        strangers, (vehicle,) = peers(MAX_PEERS, stack), peers(1, stack)
        for one in (*strangers, vehicle):
            one.sendto(b"hello", ("127.0.0.1", port))
        assert len(everything(made)) == MAX_PEERS + 1
        assert not made.write(b"to no one")
        made.heard(vehicle.getsockname())
        assert made.write(b"to the vehicle")
        assert heard_by([*strangers[:2], vehicle]) == [2]
        clock.now_s += FORGET_S
        assert not made.write(b"too late")


def test_a_new_peer_replaces_the_one_not_heard_for_longest(clock: Clock) -> None:
    port = free_port()
    with ExitStack() as stack:
        made = stack.enter_context(opened(f"udpin:127.0.0.1:{port}"))
        first = peers(MAX_PEERS, stack)
        late = peers(2, stack)
        for one in first:
            clock.now_s += 0.1
            made.heard(one.getsockname())
        made.heard(first[0].getsockname())
        for one in late:
            clock.now_s += 0.1
            made.heard(one.getsockname())
        assert made.write(b"hello")
        assert heard_by([*first[:5], *late]) == [0, 3, 4, 5, 6]


def test_a_link_that_sends_first_reads_nothing_from_strangers() -> None:
    with ExitStack() as stack:
        vehicle, stranger = peers(2, stack)
        made = stack.enter_context(opened(f"udpout:127.0.0.1:{vehicle.getsockname()[1]}"))
        assert made.write(b"hello")
        address = vehicle.recvfrom(100)[1]
        stranger.sendto(b"forged", address)
        vehicle.sendto(b"true", address)
        assert [data for data, _ in everything(made)] == [b"true"]


# --- TCP


@contextmanager
def client(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), DEADLINE) as made:
        made.settimeout(DEADLINE)
        yield made


def test_a_second_client_does_not_displace_the_first(clock: Clock) -> None:
    port = free_port(socket.SOCK_STREAM)
    with opened(f"tcpin:127.0.0.1:{port}") as made, client(port) as first:
        assert made.read(1) == []  # it is accepted
        for _ in range(3):
            clock.now_s += SILENT_S / 2
            first.sendall(b"hello")
            ((_, number),) = made.read(1)
            made.heard(number)
            with client(port) as second:
                assert made.read(1) == []
                assert second.recv(10) == b""  # closed
        first.sendall(b"still here")
        assert made.read(1) == [(b"still here", 1)]
        assert made.write(b"for the first")
        assert first.recv(100) == b"for the first"
        assert made.counts[TURNED_AWAY] == 3


def test_a_client_that_has_lost_its_power_yields_to_the_next(clock: Clock) -> None:
    """It did not disconnect. Bytes that are no valid frames do not keep its place."""
    port = free_port(socket.SOCK_STREAM)
    with opened(f"tcpin:127.0.0.1:{port}") as made, client(port) as first:
        assert made.read(1) == []
        first.sendall(b"garbage")
        assert made.read(1) == [(b"garbage", 1)]
        clock.now_s += SILENT_S
        with client(port) as second:
            assert made.read(1) == []
            second.sendall(b"hello")
            assert made.read(1) == [(b"hello", 2)]
        assert first.recv(10) == b""
        assert made.counts[TURNED_AWAY] == 0
        assert made.read(1) == []  # the second has gone
        with client(port) as third:
            assert made.read(1) == []
            third.sendall(b"now")
            assert made.read(1) == [(b"now", 3)]
