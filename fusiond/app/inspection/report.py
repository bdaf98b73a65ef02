"""An inspection as text."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from fusiond.app.inspection.facts import Inspection, LogFacts, SourceFacts
from fusiond.units import SECOND

DATED_FROM_NS = 978_307_200 * SECOND  # 2001: an earlier stamp counts from a boot
LISTED = 60  # streams of a log


def text(found: Inspection) -> str:
    """What was found, for people."""
    return "\n".join(_lines(found))


def _lines(found: Inspection) -> Iterator[str]:
    for log in found.logs:
        yield from _log(log)
    if found.sources:
        yield "read with the configuration made of it:"
        yield f"  {'source':<16} {'valid':>8} {'Hz':>7} {'jitter':>9} {'gap':>8} {'late':>9}"
        for source in found.sources:
            yield from _source(source)
    if found.clocks:
        yield "clocks:"
        yield from (f"  {name}: {words}" for name, words in found.clocks.items())
    if found.wheels:
        yield "speeds on the CAN bus:"
    for wheel in found.wheels:
        how = f"preset {wheel.preset}: {wheel.what}" if wheel.preset else wheel.what
        follows = ""
        if wheel.correlation is not None and wheel.factor is not None:
            ratio = f"{wheel.factor:.3f} times" if wheel.preset else f"{3.6 * wheel.factor:.4g} km/h a bit"
            follows = f"; follows the GNSS speed: correlation {wheel.correlation:.3f}, {ratio}"
        yield f"  channel {wheel.channel or '-'}, {wheel.name}: {how}{follows}"
    yield from (f"note: {note}" for note in found.notes)


def _log(log: LogFacts) -> Iterator[str]:
    seconds = (log.last_ns - log.first_ns) / SECOND
    since = "from boot"
    if log.first_ns > DATED_FROM_NS:
        since = f"from {datetime.fromtimestamp(log.first_ns // SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    sessions = f", {log.sessions} sessions" if log.sessions > 1 else ""
    yield f"{Path(log.path).name}: {log.format}, {seconds:.1f} s {since}{sessions}"
    yield from (f"  {sender}: {words}" for sender, words in log.senders.items())
    yield f"  {'message':<34} {'count':>8} {'Hz':>7} {'jitter':>9} {'longest gap':>20}"
    for stream in log.streams[:LISTED]:
        name = f"{stream.sender.removeprefix('system ').replace(', component ', '/')} {stream.name}".strip()
        gap = f"{stream.gap_s:.2f} s at {stream.gap_at_s:.0f} s" if stream.count > 1 else "-"
        yield f"  {name:<34} {stream.count:>8} {stream.rate_hz:>7.2f} {stream.jitter_ms:>6.1f} ms {gap:>20}"
    if len(log.streams) > LISTED:
        yield f"  and {len(log.streams) - LISTED} more"
    counts = ", ".join(f"{name} {count}" for name, count in log.counts.items())
    if counts:
        yield f"  counts: {counts}"
    yield from (f"  warning: {warning}" for warning in log.warnings)


def _source(source: SourceFacts) -> Iterator[str]:
    yield (
        f"  {source.name:<16} {source.count:>8} {source.rate_hz:>7.2f} {source.jitter_ms:>6.1f} ms {source.gap_s:>6.2f} s "
        f"{source.late_ms:>6.1f} ms   {source.reads}"
    )
    if source.about:
        yield f"  {'':<16} " + ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in source.about.items())
    if source.invalid:
        yield f"  {'':<16} invalid: " + ", ".join(f"{reason} ({count})" for reason, count in source.invalid.items())
