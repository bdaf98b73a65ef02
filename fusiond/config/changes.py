"""Which changes of the configuration a running daemon accepts, and which need a restart."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec

from fusiond.config.schema import Config, sensor_tables
from fusiond.config.toml import Section

LIVE_MAVLINK = frozenset({"connection", "baud", "own_system", "own_component", "request", "timesync"})
LIVE_CAN = frozenset({"interface", "channel", "config_context", "fd", "bitrate"})
LIVE_LIVE = frozenset({"reopen_max_s"})
LIVE_RECORD = frozenset({"folder", "file_mb", "total_mb"})
LIVE_STATE = frozenset({"every_s"})
LIVE = {"mavlink": LIVE_MAVLINK, "can": LIVE_CAN, "live": LIVE_LIVE, "record": LIVE_RECORD, "state": LIVE_STATE}


class Changes(NamedTuple):
    """Dotted keys that differ between two configurations."""

    taken: tuple[str, ...]
    refused: tuple[str, ...]  # they need a restart: the estimate, or how it is published, depends on them


def changes(old: Config, new: Config) -> Changes:
    """How two configurations differ. If any key is refused, none is taken."""
    found = list(_differences(old, new))
    live = LIVE | {table: kind.live for table, kind in sensor_tables().items()}
    refused = tuple(".".join(key) for key in found if key[-1] not in live.get(key[0], ()))
    return Changes(tuple(".".join(key) for key in found) if not refused else (), refused)


def _differences(old: object, new: object, at: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if isinstance(old, Section | dict) and isinstance(new, Section | dict):
        before, after = _items(old), _items(new)
        for key in sorted(before.keys() | after.keys()):
            yield from _differences(before.get(key), after.get(key), (*at, key))
    elif old != new:
        yield at


def _items(table: Section | dict[str, object]) -> dict[str, object]:
    return table if isinstance(table, dict) else {
        field.name: getattr(table, field.name) for field in msgspec.structs.fields(table) if field.name != "directory"
    }
