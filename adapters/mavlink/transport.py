"""Byte transports of MAVLink links, by pymavlink's connection strings. They print nothing and detect every loss.

    udpin:HOST:PORT     listen; replies go to the peers that sent valid frames within the last minute (udp: is the same)
    udpout:HOST:PORT    send there first, receive its replies
    udpbcast:HOST:PORT  the same, to a broadcast address; replies come from anyone
    tcp:HOST:PORT       connect
    tcpin:HOST:PORT     listen; the peer is the first to connect, until it disconnects or sends no valid frame any more
    uds:PATH            connect to a Unix domain socket (unix:PATH is the same)
    DEVICE[,BAUD]       a serial line

pymavlink's own classes print, sleep, mistake the end of a stream for a pause and swallow errors; they let a second process
take a UDP port silently (SO_REUSEADDR), and do not know what the kernel dropped.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections.abc import Callable, Hashable
from contextlib import suppress
from threading import Lock
from typing import Protocol

import serial

DATAGRAM = 65536  # bytes; no UDP datagram is longer
CHUNK = 4096  # bytes of a stream read at a time
DATAGRAMS = 64  # read at a time
QUEUE_BYTES = 1 << 20  # requested receive buffer of UDP; the kernel gives up to net.core.rmem_max
SO_RXQ_OVFL = 40  # asm-generic/socket.h; also the type of its control message: datagrams dropped by the kernel so far
COUNTER = struct.Struct("=I")
CONNECT_TIMEOUT_S = 5.0
FORGET_S = 60.0  # a UDP peer that sends no valid frame for this long gets no more replies
SILENT_S = 3.0  # a TCP client that sends no valid frame for this long yields to the next; heartbeats come each second
MAX_PEERS = 16
BACKLOG = 16  # TCP clients that wait to be turned away; if it were full, the true one could not come back

Peer = Hashable  # an address, or the number of a TCP client
IN_KERNEL, TURNED_AWAY = "lost in the kernel's queue", "clients turned away"


class Transport(Protocol):
    """An open connection to a peer. Every method may raise OSError or EOFError: the connection is lost. One thread may read
    while another writes; two must not write at once, and none may write while it is being closed."""

    datagrams: bool  # each chunk that is read is a datagram, else part of a stream
    more: bool  # the last read stopped at its limit: more is waiting
    counts: dict[str, int]  # since it was opened

    def read(self, timeout_s: float) -> list[tuple[bytes, Peer]]:
        """The bytes received and who sent them, after waiting for them up to `timeout_s`."""

    def heard(self, peer: Peer) -> None:
        """A peer sent a valid frame. Called by the thread that reads."""

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
    """All kinds of UDP: the waiting datagrams are read at once, and those that the kernel dropped are counted."""

    datagrams = True

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE_BYTES)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self.more = False
        self.counts = {"datagrams": 0, IN_KERNEL: 0}
        self._kernel_count = 0  # wraps at 2^32
        self._buffer = bytearray(DATAGRAM)

    def read(self, timeout_s: float) -> list[tuple[bytes, Peer]]:
        self.more = False
        found: list[tuple[bytes, Peer]] = []
        if not _wait([self.socket], timeout_s):
            return found
        try:
            while len(found) < DATAGRAMS:
                size, control, _, peer = self.socket.recvmsg_into([self._buffer], socket.CMSG_SPACE(COUNTER.size))
                if control:
                    self._count_dropped(control)
                found.append((bytes(self._buffer[:size]), peer))
            self.more = True
        except (BlockingIOError, ConnectionRefusedError):  # no more, or no one listens there yet
            pass
        self.counts["datagrams"] += len(found)
        return found

    def _count_dropped(self, control: list[tuple[int, int, bytes]]) -> None:
        for level, kind, data in control:
            if level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL and len(data) >= COUNTER.size:
                (count,) = COUNTER.unpack_from(data)
                self.counts[IN_KERNEL] += (count - self._kernel_count) & 0xFFFFFFFF
                self._kernel_count = count

    def heard(self, peer: Peer) -> None: ...

    def close(self) -> None:
        self.socket.close()


class _UdpIn(_Udp):
    def __init__(self, address: tuple[str, int]) -> None:
        super().__init__()
        self._peers: dict[Peer, float] = {}  # when each last sent a valid frame, monotonic [s]
        try:
            self.socket.bind(address)  # alone: another process that binds the port gets an error, and so does this one
        except OSError:
            self.close()
            raise

    def heard(self, peer: Peer) -> None:
        peers = self._peers
        if peer not in peers and len(peers) >= MAX_PEERS:
            peers.pop(min(peers, key=peers.__getitem__))
        peers[peer] = time.monotonic()

    def write(self, data: bytes) -> bool:
        now = time.monotonic()
        return sum(self._send(data, peer) for peer, last in list(self._peers.items()) if now - last < FORGET_S) > 0

    def _send(self, data: bytes, peer: Peer) -> bool:
        assert isinstance(peer, tuple)
        try:
            self.socket.sendto(data, peer)
        except (BlockingIOError, ConnectionRefusedError):
            return False  # the buffer is full, or no one listens there any more: the datagram is lost
        return True


class _UdpOut(_Udp):
    """Connected, so that the kernel passes on what comes from the peer and nothing else; unless it is a broadcast, where
    the peer is known by its replies only."""

    def __init__(self, address: tuple[str, int], *, broadcast: bool = False) -> None:
        super().__init__()
        try:
            resolved = (socket.gethostbyname(address[0]), address[1])
            self._send: Callable[[bytes], int] = self.socket.send
            if broadcast:
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                self._send = lambda data: self.socket.sendto(data, resolved)
            else:
                self.socket.connect(resolved)
        except OSError:
            self.close()
            raise

    def write(self, data: bytes) -> bool:
        try:
            self._send(data)
        except (BlockingIOError, ConnectionRefusedError):
            return False  # the buffer is full, or no one listens there yet: the datagram is lost
        return True


class _Stream:
    """A connected stream socket."""

    datagrams = False

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        self.more = False
        self.counts: dict[str, int] = {}
        connected.setblocking(False)
        if connected.family != socket.AF_UNIX:
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._out = WholeFrames(connected.send)

    def read(self, timeout_s: float) -> list[tuple[bytes, Peer]]:
        self.more = False
        if not _wait([self.socket], timeout_s):
            return []
        data = self.socket.recv(CHUNK)
        if not data:
            raise EOFError("closed by the peer")
        self.more = len(data) == CHUNK
        return [(data, None)]

    def heard(self, peer: Peer) -> None: ...

    def write(self, data: bytes) -> bool:
        return self._out.put(data)

    def close(self) -> None:
        self.socket.close()


class _TcpIn:
    """A listening socket and its peer. While that sends valid frames, others are turned away; when it has been silent for
    SILENT_S, the next replaces it: a peer that lost its power does not disconnect. Only the loss of the listener is an
    error."""

    datagrams = False

    def __init__(self, address: tuple[str, int]) -> None:
        self._listener = socket.create_server(address, backlog=BACKLOG)
        self._listener.setblocking(False)
        self.more = False
        self.counts = {TURNED_AWAY: 0}
        self._peer: _Stream | None = None
        self._number = 0  # of the peer
        self._heard_s = 0.0  # monotonic
        self._changing = Lock()  # the peer may be dropped while another thread writes

    def read(self, timeout_s: float) -> list[tuple[bytes, Peer]]:
        peer, self.more = self._peer, False
        ready = _wait([self._listener, *([peer.socket] if peer else [])], timeout_s)
        if peer is not None and peer.socket in ready:  # before a newcomer is looked at: it may have closed
            try:
                found: list[tuple[bytes, Peer]] = [(data, self._number) for data, _ in peer.read(0)]
                self.more = peer.more
                return found
            except (OSError, EOFError):
                self._follow(None)
        if self._listener in ready:
            self.more = True  # whoever connects in a loop does so at most once in a pause
            with suppress(BlockingIOError, ConnectionAbortedError):  # it has gone again
                self._welcome(self._listener.accept()[0])
        return []

    def heard(self, peer: Peer) -> None:
        self._heard_s = time.monotonic()

    def write(self, data: bytes) -> bool:
        with self._changing:
            try:
                return self._peer is not None and self._peer.write(data)
            except OSError:
                return False  # the reading thread detects the loss

    def _welcome(self, newcomer: socket.socket) -> None:
        now = time.monotonic()
        if self._peer is not None and now - self._heard_s < SILENT_S:
            self.counts[TURNED_AWAY] += 1
            newcomer.close()
            return
        self._number, self._heard_s = self._number + 1, now
        self._follow(_Stream(newcomer))

    def _follow(self, peer: _Stream | None) -> None:
        with self._changing:
            if self._peer:
                self._peer.close()
            self._peer = peer

    def close(self) -> None:
        self._follow(None)
        self._listener.close()


class _Serial:
    datagrams = False

    def __init__(self, device: str, baud: int) -> None:
        self.more = False
        self.counts: dict[str, int] = {}
        self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        self._out = WholeFrames(lambda data: os.write(self._port.fileno(), data))  # pyserial's own spins on a full line

    def read(self, timeout_s: float) -> list[tuple[bytes, Peer]]:
        ready, _, _ = select.select([self._port], [], [], timeout_s)
        self.more = False
        if not ready:
            return []
        data = bytes(self._port.read(CHUNK))
        if not data:
            raise EOFError("the device is gone")
        self.more = len(data) == CHUNK
        return [(data, None)]

    def heard(self, peer: Peer) -> None: ...

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
