"""A TCP server in one thread whose clients are limited in number and cost, for outputs that listen.

While it has as many connections as it may, the next ones wait in the kernel, which costs nothing here. All the work is held
to a share of the processor's time.
"""

from __future__ import annotations

import asyncio
import socket
from abc import ABC, abstractmethod
from collections import Counter
from contextlib import suppress
from threading import Thread

from fusiond_adapters.host.budget import Budget

MAX_HEAD = 8192  # bytes of a request
ABANDONED_MS = 30_000  # a peer that has acknowledged nothing for this long is given up
ANSWER = "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {size}\r\nConnection: close\r\n\r\n"
PLAIN = "text/plain; charset=utf-8"


class LimitedServer(ABC):
    """Calls `attend` for each connection, at most `connections` at once, in a thread of its own from `start` to `stop`.

    Raises OSError if the address cannot be listened on.
    """

    def __init__(self, host: str, port: int, connections: int, name: str) -> None:
        self.counts: Counter[str] = Counter()  # connections by what became of them
        self._connections = connections
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        self._listener = socket.create_server((host, port), family=family, backlog=connections)
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self._fault: Exception | None = None
        self._thread = Thread(target=self._run, name=name)

    @abstractmethod
    async def attend(self, connection: socket.socket) -> None:
        """Serve a connection, which is closed afterwards. TimeoutError and OSError are counted; what else it raises ends the
        server."""

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
        """Raise the exception that has ended the thread, if there was one."""
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
        tasks = [asyncio.create_task(one) for one in (self._accept(), self._over.wait())]
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        if not tasks[0].cancelled():
            tasks[0].result()

    async def _accept(self) -> None:
        free = asyncio.Semaphore(self._connections)
        async with asyncio.TaskGroup() as clients:
            while True:
                await free.acquire()
                try:
                    connection, _ = await self._loop.sock_accept(self._listener)
                except OSError:  # gone again, or the process has no more files: the next one may do
                    self.counts["lost"] += 1
                    free.release()
                else:
                    client = clients.create_task(self._attend(connection))
                    client.add_done_callback(lambda _: free.release())
                self.rest()

    async def _attend(self, connection: socket.socket) -> None:
        with connection:
            try:
                connection.setblocking(False)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, ABANDONED_MS)
                await self.attend(connection)
            except TimeoutError:
                self.counts["timed out"] += 1
            except OSError:
                self.counts["lost"] += 1

    # --- For `attend`

    def rest(self) -> None:
        """Pay for the work done so far by sleeping."""
        self._budget.rest()

    async def head(self, connection: socket.socket) -> tuple[bytes, list[str]]:
        """The bytes of a request up to the end of its head at least, and the lines of the head; no lines if they are too
        many, or the connection ends."""
        gathered = b""
        while b"\r\n\r\n" not in gathered:
            data = await self._loop.sock_recv(connection, MAX_HEAD)
            gathered += data
            if not data or len(gathered) > MAX_HEAD:
                return gathered, []
            self.rest()
        return gathered, gathered.partition(b"\r\n\r\n")[0].decode("latin-1").split("\r\n")

    async def answer(self, connection: socket.socket, status: str, kind: str, content: bytes) -> None:
        """Send a whole answer."""
        head = ANSWER.format(status=status, kind=kind, size=len(content)).encode("ascii")
        await self._loop.sock_sendall(connection, head + content)


def field(head: list[str], wanted: str) -> str | None:
    """The values of a field of a head, such as "accept", joined by commas; None if it is missing."""
    fields = (line.partition(":") for line in head[1:])
    found = [value.strip() for name, _, value in fields if name.strip().lower() == wanted]
    return ",".join(found) if found else None
