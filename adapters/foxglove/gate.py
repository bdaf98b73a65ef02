"""The gate before Foxglove's server, which checks no Origin and takes any number of clients: it lets in those that may come.

A page of any web site can make its reader's browser connect to a server on loopback or in the vehicle's network. Browsers
say by the Origin of which site; pages of sites that are not listed are refused. Programs send none, or one that is no web
site. The server itself listens at a random address of loopback, which no page can guess.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import Sequence

from fusiond_adapters.host.limited_server import PLAIN, LimitedServer, field

MAX_CLIENTS = 8  # connected at once; more are refused
AT_THE_DOOR = 4  # connections beyond that which may be refused at the same time
TIMEOUT_S = 2.0  # for a client to say what it wants
CHUNK = 1 << 18  # bytes passed on at once


def hidden_host() -> str:
    """A random address of loopback, which as a whole is this machine."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


def may_come(origin: str | None, allowed: Sequence[str]) -> bool:
    """Whether a client of this Origin is no browser, or shows a page of an allowed site. "null" is what any site's sandboxed
    page has."""
    if origin is None or origin in allowed:
        return True
    scheme, colon, _ = origin.lower().partition("://")
    return bool(colon) and scheme not in ("http", "https") and "," not in origin


class Gate(LimitedServer):
    """Connects clients of the allowed `origins` to the server at `inside`."""

    def __init__(self, host: str, port: int, inside: tuple[str, int], origins: Sequence[str]) -> None:
        super().__init__(host, port, MAX_CLIENTS + AT_THE_DOOR, "foxglove gate")
        self.clients = 0  # connected now
        self._inside, self._origins = inside, origins

    async def attend(self, connection: socket.socket) -> None:
        """Let a client in, or refuse it."""
        async with asyncio.timeout(TIMEOUT_S):
            gathered, head = await self.head(connection)
            refused = self._refused(head)
            if refused:
                self.counts["refused"] += 1
                await self.answer(connection, refused, PLAIN, b"fusiond: see [foxglove] in its configuration\n")
                return
        self.counts["clients"] += 1
        self.clients += 1
        try:
            await self._join(connection, gathered)
        finally:
            self.clients -= 1

    def _refused(self, head: list[str]) -> str | None:
        if not head:
            return "400 Bad Request"
        if not may_come(field(head, "origin"), self._origins):
            return "403 Forbidden"
        return "503 Service Unavailable" if self.clients >= MAX_CLIENTS else None

    async def _join(self, connection: socket.socket, gathered: bytes) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as server:
            server.setblocking(False)
            await self._loop.sock_connect(server, self._inside)
            await self._loop.sock_sendall(server, gathered)
            ways = [asyncio.create_task(self._pass_on(*way)) for way in ((connection, server), (server, connection))]
            try:
                done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in done:
                    way.result()
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)

    async def _pass_on(self, source: socket.socket, target: socket.socket) -> None:
        """Until the source ends. While the target takes nothing, nothing is read: the server drops messages for it."""
        while data := await self._loop.sock_recv(source, CHUNK):
            await self._loop.sock_sendall(target, data)
            self.rest()
