"""Notifications to systemd: ready, alive, reloading, stopping. One datagram each; none without $NOTIFY_SOCKET."""

from __future__ import annotations

import os
import socket
import time

from fusiond.units import MICROSECOND


class Notifier:
    """Sends to the service manager at $NOTIFY_SOCKET, by default that of the environment."""

    def __init__(self, address: str | None = None) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: socket.socket | None = None
        self.lost = 0  # notifications that could not be delivered
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)  # a stuck service manager must not block the daemon

    def ready(self, status: str) -> None:
        """Start, or reload, is complete."""
        self._send("READY=1", f"STATUS={status}")

    def alive(self, status: str) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1", f"STATUS={status}")

    def reloading(self) -> None:
        """A reload has begun; `ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // MICROSECOND}")

    def stopping(self) -> None:
        """A clean end has begun."""
        self._send("STOPPING=1")

    def _send(self, *lines: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto("\n".join(" ".join(line.splitlines()) for line in lines).encode(), self._address)
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def watchdog_s() -> float | None:
    """Longest time between two feeds of the watchdog [s]: half of its timeout; None where there is none."""
    allowed = os.environ.get("WATCHDOG_USEC", "")
    meant = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    return int(allowed) / 2e6 if allowed.isdecimal() and meant else None
