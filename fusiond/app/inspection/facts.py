"""The facts of an inspection, as plain data: for people, for JSON, and for other programs of fusiond."""

from __future__ import annotations

from msgspec import Struct, field


class StreamFacts(Struct, frozen=True, kw_only=True):
    """The messages of one kind from one sender."""

    sender: str  # "system 1, component 1"; a CAN log: the channel
    name: str  # message, record, topic, or CAN id
    count: int
    rate_hz: float  # by the median interval
    jitter_ms: float  # sigma of the intervals, about
    gap_s: float  # the longest interval
    gap_at_s: float  # where it began, from the beginning of the log


class LogFacts(Struct, frozen=True, kw_only=True):
    """One log."""

    path: str
    format: str
    first_ns: int  # Unix time, where the log has it, of the first message
    last_ns: int
    sessions: int  # time lines: each step back of the stamps begins one
    senders: dict[str, str]  # what they say of themselves
    streams: list[StreamFacts]
    counts: dict[str, int]  # damage, by kind
    warnings: list[str]


class SourceFacts(Struct, frozen=True, kw_only=True):
    """What one sensor measured, read with the configuration that was made."""

    name: str  # such as gps0.position
    reads: str
    count: int  # valid ones
    rate_hz: float
    jitter_ms: float
    gap_s: float
    late_ms: float  # median of receipt less instant
    invalid: dict[str, int]  # by reason
    about: dict[str, float] = field(default_factory=dict)  # figures of its kind, see `drive`


class WheelFacts(Struct, frozen=True, kw_only=True):
    """CAN frames that look like speeds."""

    channel: str
    name: str  # CAN id
    what: str  # how it is decoded
    preset: str  # whose preset decodes it; empty: found by its correlation alone
    correlation: float | None  # with the GNSS speed; None without one
    factor: float | None  # GNSS speed [m/s] over the decoded value


class Inspection(Struct, frozen=True, kw_only=True):
    """Everything that was found."""

    logs: list[LogFacts]
    sources: list[SourceFacts]
    wheels: list[WheelFacts]
    clocks: dict[str, str]  # how each clock is aligned
    notes: list[str]  # what is missing or odd, and what to do about it
    config: str | None  # the text of a configuration to start from; None where there cannot be one
    copied: list[str] = field(default_factory=list)  # DBC files of fusiond that it names
