"""Units of time, in the nanoseconds that every stamp is counted in."""

from __future__ import annotations

MICROSECOND = 1_000  # ns
MILLISECOND = 1_000_000  # ns
SECOND = 1_000_000_000  # ns


def nanoseconds(seconds: float) -> int:
    """A time of the configuration [s] in whole nanoseconds."""
    return round(seconds * SECOND)
