"""A small HTTP server for one page, in one thread: its clients are limited in number, time and cost.

A connection is for one request and ends with the answer, or after TIMEOUT_S. While MAX_CLIENTS are connected the next ones
wait in the kernel, which costs nothing. The page is made at most once in KEPT_S, whoever asks how often, and all the work is
held to a share of the processor's time.
"""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from threading import Thread

from fusiond_adapters.host.budget import Budget

MAX_CLIENTS = 16  # connected at once; as many again wait in the kernel
TIMEOUT_S = 2.0  # for a connection from beginning to end
KEPT_S = 1.0  # how long a page is handed out
MAX_HEAD = 8192  # bytes of a request
ANSWER = "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {size}\r\nConnection: close\r\n\r\n"

Page = Callable[[str], tuple[str, Iterator[bytes]]]
"""Makes the page for any Accept header: one of few content types, and the contents, in pieces that take a fraction of a
millisecond each."""


class HttpServer:
    """Serves `page` at `path` from its own thread. `now_s` reads the clock that says how old a page is.

    Raises OSError if the address cannot be listened on.
    """

    def __init__(
        self, host: str, port: int, path: str, page: Page, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.counts: Counter[str] = Counter()  # connections by what became of them
        self._path, self._page, self._now_s = path, page, now_s
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        self._listener = socket.create_server((host, port), family=family, backlog=MAX_CLIENTS)
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self._kept: dict[str, tuple[float, bytes]] = {}  # by content type: when it was made, the contents
        self._fault: Exception | None = None
        self._thread = Thread(target=self._run, name="http")

    def start(self) -> None:
        """Serve until `stop`. Raises RuntimeError if no thread can be started."""
        try:
            self._thread.start()
        except RuntimeError:
            self._listener.close()
            self._loop.close()
            raise

    def stop(self) -> None:
        """End all connections and the thread."""
        with suppress(RuntimeError):  # after a fault it has ended by itself
            self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join()

    def check(self) -> None:
        """Raise the exception that has ended the thread, if there was one, such as one of the page."""
        if self._fault:
            raise self._fault

    def _run(self) -> None:
        with self._listener:
            try:
                self._loop.run_until_complete(self._serve())
            except Exception as fault:  # raised in the thread that checks
                self._fault = fault
            finally:
                self._loop.close()

    async def _serve(self) -> None:
        self._budget = Budget()
        self._making = asyncio.Lock()
        tasks = [asyncio.create_task(one) for one in (self._accept(), self._over.wait())]
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        if not tasks[0].cancelled():
            tasks[0].result()

    async def _accept(self) -> None:
        free = asyncio.Semaphore(MAX_CLIENTS)
        async with asyncio.TaskGroup() as clients:
            while True:
                await free.acquire()
                try:
                    connection, _ = await self._loop.sock_accept(self._listener)
                except OSError:  # gone again, or the process has no more files: the next one may do
                    self.counts["lost"] += 1
                    free.release()
                else:
                    connection.setblocking(False)
                    client = clients.create_task(self._attend(connection))
                    client.add_done_callback(lambda _: free.release())
                await self._rest()

    async def _attend(self, connection: socket.socket) -> None:
        with connection:
            try:
                async with asyncio.timeout(TIMEOUT_S):
                    status, kind, content = await self._answer(await self._head(connection))
                    head = ANSWER.format(status=status, kind=kind, size=len(content)).encode("ascii")
                    await self._loop.sock_sendall(connection, head + content)
                self.counts["answered" if status == "200 OK" else "refused"] += 1
            except TimeoutError:
                self.counts["timed out"] += 1
            except OSError:
                self.counts["lost"] += 1

    async def _head(self, connection: socket.socket) -> list[str]:
        """The lines of a request, without its body; none if they are too many."""
        gathered = b""
        while b"\r\n\r\n" not in gathered:
            data = await self._loop.sock_recv(connection, MAX_HEAD)
            gathered += data
            if not data or len(gathered) > MAX_HEAD:
                return []
        return gathered.partition(b"\r\n\r\n")[0].decode("latin-1").split("\r\n")

    async def _answer(self, head: list[str]) -> tuple[str, str, bytes]:
        """Status, content type and contents."""
        method, _, rest = (head[0] if head else "").partition(" ")
        target, _, version = rest.partition(" ")
        plain = "text/plain; charset=utf-8"
        if not version.startswith("HTTP/1."):
            return "400 Bad Request", plain, b"this is no request by HTTP/1\n"
        if method != "GET":
            return "405 Method Not Allowed", plain, b"only GET\n"
        if target.partition("?")[0] != self._path:
            return "404 Not Found", plain, f"the metrics are at {self._path}\n".encode()
        fields = (line.partition(":") for line in head[1:])
        accept = ",".join(value.strip() for name, _, value in fields if name.strip().lower() == "accept")
        return "200 OK", *await self._contents(accept)

    async def _contents(self, accept: str) -> tuple[str, bytes]:
        kind, pieces = self._page(accept)
        async with self._making:
            made_s, content = self._kept.get(kind, (-math.inf, b""))
            if self._now_s() - made_s >= KEPT_S:
                gathered = []
                for piece in pieces:
                    gathered.append(piece)
                    await self._rest()
                content = b"".join(gathered)
                self._kept[kind] = self._now_s(), content
        return kind, content

    async def _rest(self) -> None:
        await asyncio.sleep(self._budget.rest_s())
