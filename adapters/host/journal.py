"""Logging: under systemd in the journal's own protocol, with fields; otherwise as lines on stderr, with times.

A record's `extra` gives fields: FUSIOND_SOURCE (the source, input or output concerned), FUSIOND_MODE, MESSAGE_ID (the
kind of event, for `journalctl MESSAGE_ID=...`). Repeats are counted instead of logged; the next record after REPEAT_S gives
their number.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from typing import TextIO

ADDRESS = "/run/systemd/journal/socket"
PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))  # syslog's
REPEAT_S = 30.0  # a record is not repeated within this time
MAX_KEPT = 256  # different messages that are remembered

# MESSAGE_ID by kind of event
EVENTS = {
    "mode": "e13b1fe73096462ca7b80a47ff78f898",
    "reset": "22f152c7f51b46968d1a8e72211a769b",
    "source_lost": "d38d920ccaeb4f778624c5c13553fe82",
    "source_found": "91ee207d6dee4087af9ffdefed58eb49",
    "source_status": "c3ad48b0445f410481aeb313d68164ad",
    "clock": "5f0c2b8e1d5e4a0a9d6b7a3c94f2e816",
}
CONNECTION_LOST = "6f76bece9cb8432588f2d5f2b9136fed"
DATA_LOST = "f9c7bf04bb324984934cfddb280196f7"
STARTED = "6bc34b7cdb044fa78ef50a5cadc4df05"
ENDED = "4d7cc2b0c67c45528deb303a00413de1"
RELOADED = "65be903f1e374e55a4416688a46ade1f"


def about(kind: str, subject: str) -> dict[str, str]:
    """The fields of a published event: its subject is the mode entered, a clock or a source."""
    field = {"mode": "FUSIOND_MODE", "clock": "FUSIOND_CLOCK"}.get(kind, "FUSIOND_SOURCE")
    named = {field: subject} if subject else {}
    return {"MESSAGE_ID": EVENTS[kind], **named} if kind in EVENTS else named


class Repeats(logging.Filter):
    """Passes the first of equal records and counts those within REPEAT_S after it; the next one gives their number."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = now
        self._logged: dict[tuple[int, str], tuple[float, int]] = {}  # by level and text: when it was logged, repeats since

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to log it. An event below warning always is: it reports a change."""
        if record.levelno < logging.WARNING and hasattr(record, "MESSAGE_ID"):
            return True
        key = record.levelno, record.getMessage()
        now = self._now()
        last, count = self._logged.get(key, (None, 0))
        if last is not None and now - last < REPEAT_S:
            self._logged[key] = last, count + 1
            return False
        self._logged.pop(key, None)
        self._logged[key] = now, 0
        if len(self._logged) > MAX_KEPT:
            del self._logged[next(iter(self._logged))]
        if last is not None and count:
            record.msg, record.args = f"{key[1]} ({count} more times in the last {now - last:.0f} s)", ()
        return True


class JournalHandler(logging.Handler):
    """Sends each record to the journal as a datagram. Records that the journal does not take are counted in `lost`."""

    def __init__(self, address: str = ADDRESS) -> None:
        super().__init__()
        self.lost = 0
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)  # a busy journal must not hold up the estimator

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        try:
            self._socket.sendto(b"".join(_field(name, value) for name, value in fields(record)), self._address)
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        super().close()


def fields(record: logging.LogRecord) -> Iterator[tuple[str, str]]:
    """The journal's fields of a record."""
    text = record.getMessage()
    if record.exc_info:
        text += "\n" + "".join(traceback.format_exception(*record.exc_info)).rstrip()
    yield "MESSAGE", text
    yield "PRIORITY", str(next(priority for level, priority in PRIORITIES if record.levelno >= level))
    yield "SYSLOG_IDENTIFIER", "fusiond"
    yield "LOGGER", record.name
    yield "CODE_FILE", record.pathname
    yield "CODE_LINE", str(record.lineno)
    yield "CODE_FUNC", record.funcName or "?"
    yield "THREAD_NAME", record.threadName or "?"
    for name, value in vars(record).items():
        if name.startswith("FUSIOND_") or name == "MESSAGE_ID":
            yield name, str(value)


def _field(name: str, value: str) -> bytes:
    """A field in the native protocol: one line, or for a value of several lines its length and then the value."""
    data = value.encode("utf-8", "backslashreplace")
    if b"\n" not in data:
        return name.encode() + b"=" + data + b"\n"
    return name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"


def is_journal(stream: TextIO) -> bool:
    """Whether a stream goes to the journal: $JOURNAL_STREAM names its device and inode."""
    try:
        status = os.fstat(stream.fileno())
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def set_up(level: int = logging.INFO) -> None:
    """Log to the journal, which has times of its own, if stderr goes there; otherwise to stderr, with the time in UTC."""
    handler: logging.Handler = JournalHandler() if is_journal(sys.stderr) else logging.StreamHandler()
    lines = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    lines.converter = time.gmtime
    handler.setFormatter(lines)
    handler.addFilter(Repeats())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.getLogger("can").setLevel(logging.CRITICAL)  # python-can logs a missing bus and raises it too
    logging.getLogger("foxglove").setLevel(logging.WARNING)  # it logs the address that is hidden behind the gate
