"""What a format of logs is: its suffix, its name for people, and how a log of it is opened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple, Protocol

from fusiond.config.schema import Config
from fusiond.events import Received

if TYPE_CHECKING:
    from fusiond_adapters.logs.file import LogFile


class Counting(Protocol):
    """A decoder, as far as the merge knows it."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What became of the frames so far."""


class Opening(NamedTuple):
    """What the opener of a log is given."""

    file: LogFile
    about: str  # its format, for people
    name: str | None  # of the link or bus that the user says it is of
    config: Config
    sequences: dict[str, int]  # last sequence number by source, which the logs of one vehicle share


class Reading(NamedTuple):
    """A log being read."""

    protocol: str  # its section of the configuration, such as mavlink
    decoders: Sequence[Counting]
    frames: Iterator[list[Received]]  # the events of each frame, in the order of the file


class LogFormat(NamedTuple):
    """A format. Its reader is a module of fusiond_adapters with a function `open_log(opening: Opening) -> Reading`, which
    raises LogError and ConfigError."""

    suffix: str
    about: str  # for people
    reader: str
    zipped: bool = True  # a .gz of it can be read too

    def open(self, opening: Opening) -> Reading:
        """Import the reader and open a log with it. Raises LogError, ConfigError."""
        reading: Reading = import_module(f"fusiond_adapters.{self.reader}").open_log(opening)
        return reading
