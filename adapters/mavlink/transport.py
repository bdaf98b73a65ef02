"""Byte transports of MAVLink links, by pymavlink's connection strings. They print nothing and detect every loss.

    udpin:HOST:PORT     listen; replies go to every peer that sent within the last minute (udp:HOST:PORT is the same)
    udpout:HOST:PORT    send there first, receive the replies
    udpbcast:HOST:PORT  the same, to a broadcast address
    tcp:HOST:PORT       connect
    tcpin:HOST:PORT     listen; the peer is the latest to connect
    uds:PATH            connect to a Unix domain socket (unix:PATH is the same)
    DEVICE[,BAUD]       a serial line

pymavlink's own classes print, sleep, mistake the end of a stream for a pause and swallow errors.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable
from threading import Lock
from typing import Protocol

import serial

CHUNK = 65536  # bytes read at a time; no UDP datagram is longer
CONNECT_TIMEOUT_S = 5.0
FORGET_S = 60.0  # a UDP peer that sends nothing for this long gets no more replies
MAX_PEERS = 16


class Transport(Protocol):
    """An open connection to a peer. Every method may raise OSError or EOFError: the connection is lost. One thread may read
    while another writes; two must not write at once, and none may write while it is being closed."""

    def read(self, timeout_s: float) -> list[bytes]:
        """The bytes received, after waiting for them up to `timeout_s`."""

    def write(self, data: bytes) -> bool:
        """Send a frame to the peer. False: there is no peer or the line is full, and the frame is lost. Never waits."""

    def close(self) -> None: ...


def opener(connection: str, baud: int) -> Callable[[], Transport]:
    """A function that opens the transport of a connection string; it raises OSError. Raises ValueError for a wrong
    string."""
    scheme, colon, rest = connection.partition(":")
    if scheme in ("uds", "unix"):
        return lambda: _Stream(_unix_socket(rest))
    if scheme in _BY_ADDRESS and colon:
        make, address = _BY_ADDRESS[scheme], _address(connection, rest)
        return lambda: make(address)
    if colon:
        raise ValueError(f"'{connection}': unknown kind of connection; known: {', '.join(_BY_ADDRESS)}, uds, DEVICE,BAUD")
    device, _, given = connection.partition(",")
    if not device or (given and not given.isdecimal()):
        raise ValueError(f"'{connection}': a serial line is DEVICE or DEVICE,BAUD")
    return lambda: _Serial(device, int(given) if given else baud)


def _address(connection: str, rest: str) -> tuple[str, int]:
    host, _, port = rest.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise ValueError(f"'{connection}': HOST:PORT is needed after the first colon")
    return host, int(port)


def _unix_socket(path: str) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        made.connect(path)
    except OSError:
        made.close()
        raise
    return made


class WholeFrames:
    """Frames written to a line that may accept only part of one: the rest is sent first the next time."""

    def __init__(self, write: Callable[[bytes], int]) -> None:
        """`write` returns the number of bytes accepted, or raises BlockingIOError if there is no room."""
        self._write = write
        self._rest = b""

    def put(self, data: bytes) -> bool:
        """Write a frame. Whether it was accepted."""
        try:
            if self._rest:
                self._rest = self._rest[self._write(self._rest) :]
            if not self._rest:
                self._rest = data[self._write(data) :]
                return True
        except BlockingIOError:
            return False
        return False


def _wait(sockets: list[socket.socket], timeout_s: float) -> list[socket.socket]:
    return select.select(sockets, [], [], timeout_s)[0]


class _Udp:
    """Both kinds of UDP: all waiting datagrams are read at once."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)

    def receive(self, timeout_s: float) -> list[tuple[bytes, tuple[str, int]]]:
        found: list[tuple[bytes, tuple[str, int]]] = []
        if _wait([self.socket], timeout_s):
            try:
                while len(found) < 256:
                    found.append(self.socket.recvfrom(CHUNK))
            except BlockingIOError:
                return found
            except ConnectionRefusedError:  # no one listens there yet
                return found
        return found

    def send(self, data: bytes, address: tuple[str, int]) -> bool:
        try:
            self.socket.sendto(data, address)
        except (BlockingIOError, ConnectionRefusedError):
            return False  # the buffer is full, or no one listens there yet: the datagram is lost
        return True

    def close(self) -> None:
        self.socket.close()


class _UdpIn(_Udp):
    def __init__(self, address: tuple[str, int]) -> None:
        super().__init__()
        self._peers: dict[tuple[str, int], float] = {}  # when each last sent, monotonic [s]
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.socket.bind(address)
        except OSError:
            self.close()
            raise

    def read(self, timeout_s: float) -> list[bytes]:
        received = self.receive(timeout_s)
        now = time.monotonic()
        for _, peer in received:
            if peer in self._peers or len(self._peers) < MAX_PEERS:
                self._peers[peer] = now
        return [data for data, _ in received]

    def write(self, data: bytes) -> bool:
        now = time.monotonic()
        peers = list(self._peers.items())  # a copy: the reading thread adds to them
        for peer in [peer for peer, last in peers if now - last >= FORGET_S]:
            self._peers.pop(peer, None)
        return sum(self.send(data, peer) for peer, last in peers if now - last < FORGET_S) > 0


class _UdpOut(_Udp):
    def __init__(self, address: tuple[str, int], *, broadcast: bool = False) -> None:
        super().__init__()
        try:
            self._address = (socket.gethostbyname(address[0]), address[1])
            if broadcast:
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        except OSError:
            self.close()
            raise

    def read(self, timeout_s: float) -> list[bytes]:
        return [data for data, _ in self.receive(timeout_s)]

    def write(self, data: bytes) -> bool:
        return self.send(data, self._address)


class _Stream:
    """A connected stream socket."""

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        connected.setblocking(False)
        if connected.family != socket.AF_UNIX:
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._out = WholeFrames(connected.send)

    def read(self, timeout_s: float) -> list[bytes]:
        if not _wait([self.socket], timeout_s):
            return []
        data = self.socket.recv(CHUNK)
        if not data:
            raise EOFError("closed by the peer")
        return [data]

    def write(self, data: bytes) -> bool:
        return self._out.put(data)

    def close(self) -> None:
        self.socket.close()


class _TcpIn:
    """A listening socket and its latest peer. When the peer disconnects, it waits for the next. Only the loss of the
    listener is an error."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._listener = socket.create_server(address, backlog=1)
        self._listener.setblocking(False)
        self._peer: _Stream | None = None
        self._changing = Lock()  # the peer may be dropped while another thread writes

    def read(self, timeout_s: float) -> list[bytes]:
        peer = self._peer
        ready = _wait([self._listener, *([peer.socket] if peer else [])], timeout_s)
        if self._listener in ready:
            self._follow(_Stream(self._listener.accept()[0]))
            return []
        if not ready or peer is None:
            return []
        try:
            return peer.read(0)
        except (OSError, EOFError):
            self._follow(None)
            return []

    def write(self, data: bytes) -> bool:
        with self._changing:
            try:
                return self._peer is not None and self._peer.write(data)
            except OSError:
                return False  # the reading thread detects the loss

    def _follow(self, peer: _Stream | None) -> None:
        with self._changing:
            if self._peer:
                self._peer.close()
            self._peer = peer

    def close(self) -> None:
        self._follow(None)
        self._listener.close()


class _Serial:
    def __init__(self, device: str, baud: int) -> None:
        self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        self._out = WholeFrames(lambda data: os.write(self._port.fileno(), data))  # pyserial's own spins on a full line

    def read(self, timeout_s: float) -> list[bytes]:
        ready, _, _ = select.select([self._port], [], [], timeout_s)
        if not ready:
            return []
        data = bytes(self._port.read(CHUNK))
        if not data:
            raise EOFError("the device is gone")
        return [data]

    def write(self, data: bytes) -> bool:
        return self._out.put(data)

    def close(self) -> None:
        self._port.close()


_BY_ADDRESS: dict[str, Callable[[tuple[str, int]], Transport]] = {
    "udpin": _UdpIn,
    "udp": _UdpIn,
    "udpout": _UdpOut,
    "udpbcast": lambda address: _UdpOut(address, broadcast=True),
    "tcp": lambda address: _Stream(socket.create_connection(address, CONNECT_TIMEOUT_S)),
    "tcpin": _TcpIn,
}
