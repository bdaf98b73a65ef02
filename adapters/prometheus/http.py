"""A small HTTP server for one page, in one thread: its clients are limited in number, time and cost.

A connection is for one request and ends with the answer, or after TIMEOUT_S. The page is made at most once in KEPT_S,
whoever asks how often.
"""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections.abc import Callable, Iterator

from fusiond_adapters.host.limited_server import PLAIN, LimitedServer, field

MAX_CLIENTS = 16  # connected at once; as many again wait in the kernel
TIMEOUT_S = 2.0  # for a connection from beginning to end
KEPT_S = 1.0  # how long a page is handed out

Page = Callable[[str], tuple[str, Iterator[bytes]]]
"""Makes the page for any Accept header: one of few content types, and the contents, in pieces that take a fraction of a
millisecond each."""


class HttpServer(LimitedServer):
    """Serves `page` at `path`. `now_s` reads the clock that says how old a page is."""

    def __init__(
        self, host: str, port: int, path: str, page: Page, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(host, port, MAX_CLIENTS, "http")
        self._path, self._page, self._now_s = path, page, now_s
        self._kept: dict[str, tuple[float, bytes]] = {}  # by content type: when it was made, the contents

    async def attend(self, connection: socket.socket) -> None:
        """Answer one request."""
        async with asyncio.timeout(TIMEOUT_S):
            _, head = await self.head(connection)
            status, kind, content = self._answer(head)
            await self.answer(connection, status, kind, content)
        self.counts["answered" if status == "200 OK" else "refused"] += 1

    def _answer(self, head: list[str]) -> tuple[str, str, bytes]:
        """Status, content type and contents."""
        method, _, rest = (head[0] if head else "").partition(" ")
        target, _, version = rest.partition(" ")
        if not version.startswith("HTTP/1."):
            return "400 Bad Request", PLAIN, b"this is no request by HTTP/1\n"
        if method != "GET":
            return "405 Method Not Allowed", PLAIN, b"only GET\n"
        if target.partition("?")[0] != self._path:
            return "404 Not Found", PLAIN, f"the metrics are at {self._path}\n".encode()
        return "200 OK", *self._contents(field(head, "accept") or "")

    def _contents(self, accept: str) -> tuple[str, bytes]:
        kind, pieces = self._page(accept)
        made_s, content = self._kept.get(kind, (-math.inf, b""))
        if self._now_s() - made_s >= KEPT_S:
            gathered = []
            for piece in pieces:
                gathered.append(piece)
                self.rest()
            content = b"".join(gathered)
            self._kept[kind] = self._now_s(), content
        return kind, content
