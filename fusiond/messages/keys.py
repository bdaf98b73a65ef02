"""The Zenoh key of each kind of message."""

from __future__ import annotations


def key(vehicle: str, kind: str, source: str = "") -> str:
    """The Zenoh key of a kind of message; innovations have a key for each source."""
    return f"fusiond/{vehicle}/{kind}" + (f"/{source}" if source else "")
