"""A log format: its suffix, its name for users, and its reader."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple, Protocol

from fusiond.config.schema import Config
from fusiond.events import Received

if TYPE_CHECKING:
    from fusiond_adapters.logs.file import LogFile


class Counting(Protocol):
    """The part of a decoder that the merge uses."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of frames by outcome."""


class Opening(NamedTuple):
    """The arguments of a format's `open_log`."""

    file: LogFile
    about: str  # name of the format for users
    name: str | None  # of the link or bus that the user has given
    config: Config
    sequences: dict[str, int]  # last sequence number by source, shared by the logs of one vehicle


class Reading(NamedTuple):
    """A log being read."""

    protocol: str  # its section of the configuration, such as mavlink
    decoders: Sequence[Counting]
    frames: Iterator[list[Received]]  # the events of each frame, in the order of the file


class LogFormat(NamedTuple):
    """A format. Its reader is a module of fusiond_adapters with a function `open_log(opening: Opening) -> Reading`, which
    raises LogError and ConfigError."""

    suffix: str
    about: str  # name for users
    reader: str

    def open(self, opening: Opening) -> Reading:
        """Import the reader and open a log with it. Raises LogError, ConfigError."""
        reading: Reading = import_module(f"fusiond_adapters.{self.reader}").open_log(opening)
        return reading
