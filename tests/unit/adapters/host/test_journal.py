"""What is logged: the journal's own protocol over a real socket, its fields, repeats counted, and when it is stderr."""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusiond_adapters.host import journal


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "journal"))
        bound.settimeout(5.0)
        yield bound


@pytest.fixture
def log(receiver: socket.socket) -> Iterator[logging.Logger]:
    logger = logging.Logger("fusiond")
    handler = journal.JournalHandler(receiver.getsockname())
    logger.addHandler(handler)
    yield logger
    handler.close()


def entry(datagram: bytes) -> dict[str, str]:
    """A datagram read as systemd's documentation has it."""
    found = {}
    while datagram:
        line, _, rest = datagram.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            size = int.from_bytes(rest[:8], "little")
            value, rest = rest[8 : 8 + size], rest[8 + size :]
            assert rest[:1] == b"\n"
            rest = rest[1:]
        found[name.decode()] = value.decode()
        datagram = rest
    return found


def test_fields(log: logging.Logger, receiver: socket.socket) -> None:
    log.warning("%s: lost", "CAN car", extra={"FUSIOND_SOURCE": "car", "MESSAGE_ID": journal.CONNECTION_LOST})
    found = entry(receiver.recv(65536))
    assert found["MESSAGE"] == "CAN car: lost"
    assert (found["PRIORITY"], found["SYSLOG_IDENTIFIER"], found["FUSIOND_SOURCE"]) == ("4", "fusiond", "car")
    assert (found["CODE_FILE"], found["CODE_FUNC"]) == (__file__, "test_fields")
    assert found["CODE_LINE"].isdecimal() and len(found["MESSAGE_ID"]) == 32


def test_a_value_of_several_lines_keeps_them(log: logging.Logger, receiver: socket.socket) -> None:
    try:
        raise ValueError("of\nthis kind")
    except ValueError:
        log.exception("failed = badly")
    found = entry(receiver.recv(65536))
    assert found["MESSAGE"].startswith("failed = badly\nTraceback") and found["MESSAGE"].endswith("of\nthis kind")
    assert found["PRIORITY"] == "3"


def test_a_journal_that_is_away_is_no_error(tmp_path: Path) -> None:
    handler = journal.JournalHandler(str(tmp_path / "nobody"))
    handler.handle(logging.makeLogRecord({"name": "fusiond", "msg": "lost", "levelno": logging.INFO}))
    handler.close()
    assert handler.lost == 1


def test_events_have_ids_of_their_own() -> None:
    assert journal.about("mode", "nominal") == {"FUSIOND_MODE": "nominal", "MESSAGE_ID": journal.EVENTS["mode"]}
    assert journal.about("source_lost", "gps0.position")["FUSIOND_SOURCE"] == "gps0.position"
    assert journal.about("clock", "fc/1/boot")["FUSIOND_CLOCK"] == "fc/1/boot"
    own = (journal.CONNECTION_LOST, journal.DATA_LOST, journal.STARTED, journal.ENDED, journal.RELOADED)
    ids = [*journal.EVENTS.values(), *own]
    assert len(set(ids)) == len(ids) and all(len(bytes.fromhex(number)) == 16 for number in ids)


def test_repeated_warnings_are_counted() -> None:
    now, said = 0.0, []
    repeats = journal.Repeats(lambda: now)
    for second in range(100):
        now = float(second)
        record = logging.makeLogRecord({"msg": "lost: %s", "args": ("no route",), "levelno": logging.WARNING})
        if repeats.filter(record):
            said.append(record.getMessage())
    assert said == ["lost: no route"] + ["lost: no route (29 more times in the last 30 s)"] * 3
    mode = {"msg": "mode: nominal", "levelno": logging.INFO, **journal.about("mode", "nominal")}
    assert all(repeats.filter(logging.makeLogRecord(mode)) for _ in range(3))
    chatter = {"msg": "the controller is active", "levelno": logging.INFO}
    assert [repeats.filter(logging.makeLogRecord(chatter)) for _ in range(3)] == [True, False, False]


def test_what_repeats_remembers_is_bounded() -> None:
    repeats = journal.Repeats(lambda: 0.0)
    for number in range(10 * journal.MAX_KEPT):
        repeats.filter(logging.makeLogRecord({"msg": f"{number}", "levelno": logging.ERROR}))
    assert len(repeats._logged) == journal.MAX_KEPT


def test_lines_outside_the_journal_begin_with_the_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    root, packets = logging.getLogger(), logging.getLogger("can")
    before, level, of_packets = root.handlers[:], root.level, packets.level
    try:
        journal.set_up()
        record = logging.makeLogRecord({"msg": "gps0 is back", "levelno": logging.INFO, "levelname": "INFO"})
        record.created, record.msecs = 1_767_225_600.0425, 42.0  # 2026-01-01
        root.handle(record)
    finally:
        root.handlers[:] = before
        root.setLevel(level)
        packets.setLevel(of_packets)
    assert capsys.readouterr().err == "2026-01-01T00:00:00.042Z INFO gps0 is back\n"


def test_the_journal_is_distinguished_from_other_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "stderr").open("w") as stream:
        status = os.fstat(stream.fileno())
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.delenv("JOURNAL_STREAM", raising=False)
        assert not journal.is_journal(stream)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
        assert not journal.is_journal(stream)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert journal.is_journal(stream)
