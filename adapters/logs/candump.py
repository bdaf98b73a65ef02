"""Reader of `candump -L` logs. An hour has tens of millions of lines, so unwanted ones are skipped many at a time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

from fusiond.units import MICROSECOND, SECOND
from fusiond_adapters.logs.can_channels import ID_BITS, LogFrame, Wanted, open_can_log, survey_can_log
from fusiond_adapters.logs.file import MAX_LINE, LogFile
from fusiond_adapters.logs.format import Opening, Reading

if TYPE_CHECKING:
    from fusiond_adapters.logs.survey import Survey

LINE = re.compile(
    rb"\s*\((\d{1,10})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"  # (seconds.fraction) channel id
    rb"#(?:#[0-9A-Fa-f])?([0-9A-Fa-f]*|[Rr][0-9A-Fa-f]?)(?:\s+[RTrt])?\s*"  # #data, ##flags data, or #R
)
OTHERS = (  # lines as candump itself writes them, of data frames whose ids are not among those at %(ids)b
    rb"((?:\(\d{1,10}\.\d{1,9}\) \S+ (?!(?:%(ids)b)#)(?:[0-9A-F]{3}|[01][0-9A-F]{7})#[0-9A-F]*+\n)*)"
)
WANTED = rb"(?:\((\d{1,10})\.(\d{6})\) (\S+) (%(ids)b)#((?:[0-9A-F]{2})*)\n)?"  # such a line with an id that is among them
# Only a set of characters may be possessive (`*+`): before 3.11.5 Python matches a possessive group wrongly.
ERROR_FLAG = 0x20000000  # in the 8-digit ids of candump


def open_log(opening: Opening) -> Reading:
    """The reading of a .log. Raises LogError, ConfigError."""
    return open_can_log(opening, _candump)


def survey(found: Survey) -> None:
    """Add what is in a log to a survey. Raises LogError."""
    survey_can_log(found, _line_by_line)


def _candump(log: LogFile, wanted: Wanted) -> Iterator[LogFrame]:
    """The frames of a `candump -L` log whose ids are wanted. Most lines have other ids; one step skips many of them."""
    ids = b"|".join(wanted.patterns()) or b"-"  # no id begins with a dash
    scan = re.compile((OTHERS + WANTED) % {b"ids": ids}).match
    counts = log.counts
    for text in _whole_lines(log):
        at = 0
        while at < len(text):
            found = scan(text, at)
            assert found is not None, "the pattern matches the empty text"
            skipped = text.count(b"\n", at, found.end(1))
            counts["frames"] += skipped
            counts["other ids"] += skipped
            at = found.end()
            seconds, micros, channel, digits, content = found.group(2, 3, 4, 5, 6)
            if digits is not None:
                counts["frames"] += 1
                name, data = channel.decode("utf-8", "replace"), bytes.fromhex(content.decode("ascii"))
                yield LogFrame(int(seconds + micros) * MICROSECOND, name, int(digits, 16), len(digits) == 8, data)
            elif at < len(text):
                end = text.index(b"\n", at) + 1
                frame = _frame(text[at:end], wanted, counts)
                if frame is not None:
                    yield frame
                at = end


def _line_by_line(log: LogFile, wanted: Wanted) -> Iterator[LogFrame]:
    """The same where most ids are wanted."""
    for text in _whole_lines(log):
        for line in text.splitlines():
            frame = _frame(line, wanted, log.counts)
            if frame is not None:
                yield frame


def _frame(line: bytes, wanted: Wanted, counts: Counter[str]) -> LogFrame | None:
    """The frame in a line, if its id is wanted. Every line is counted."""
    found = LINE.fullmatch(line)
    if found is None:
        counts["bad lines"] += bool(line.strip())
        return None
    seconds, fraction, channel, digits, content = found.groups()
    number, is_extended = int(digits, 16), len(digits) == 8
    is_wanted = number <= ID_BITS and wanted.holds(number, is_extended)
    remote = content[:1] in (b"R", b"r")
    if is_wanted and not remote and len(content) % 2:
        counts["bad lines"] += 1
        return None
    counts["frames"] += 1
    if not is_wanted:
        error = is_extended and number & ERROR_FLAG
        counts["error frames" if error else "other ids"] += 1
        return None
    if remote:
        counts["remote frames"] += 1
        return None
    t_ns = int(seconds) * SECOND + int(fraction.ljust(9, b"0"))
    data = bytes.fromhex(content.decode("ascii"))
    return LogFrame(t_ns, channel.decode("utf-8", "replace"), number, is_extended, data)


def _whole_lines(log: LogFile) -> Iterator[bytes]:
    """A text log in pieces of whole lines, in bounded memory."""
    rest = b""
    for block in log.blocks():
        head, end, tail = block.rpartition(b"\n")
        if end:
            yield rest + head + end
            rest = tail
        else:
            rest += tail
        if len(rest) > MAX_LINE:
            log.counts["bad lines"] += 1
            rest = b""
    if rest:
        yield rest + b"\n"
