"""CAN logs of any format: which frames are wanted, and which bus each channel of the log is.

A bus gets the frames of its `log_channel`, by default its own name, as written in the log: .asc and .blf number their
channels from 0, .trc from 1. If only one bus can be in the log and its first wheel frames are all on another channel, that
channel is used: so a log of one bus needs no configuration, and a warning names the channel. A given `log_channel` prevents
that, unless the bus is named with the log (`BUS=path`) or the format has no channels. Frames on other channels are counted;
if all of the first wheel frames are on other channels, that is an error.

Counts: `frames` (all readable ones), `other ids`, `other channels`, `error frames`, `remote frames`, `bad lines`, `bad rows`
(of a .db), `unreadable tail` (the rest of a damaged binary log), `bad stamps` (wheel frames dropped for their stamp).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import chain, islice
from typing import TYPE_CHECKING, NamedTuple

from fusiond.config.schema import Config
from fusiond.events import Received
from fusiond.units import SECOND
from fusiond_adapters.can.decoder import PDU2, CanDecoder, frame_key, parameter_group
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading

if TYPE_CHECKING:
    from fusiond_adapters.logs.survey import Survey

ID_BITS = 0x1FFFFFFF  # in the 8-digit ids of candump
OBD_ANSWERS = range(0x7E8, 0x7F0)  # ids
STEP_NS = SECOND  # a stamp that jumps by more is compared with the next one
DECISION = 100  # wheel frames from which the channels are chosen


class LogFrame(NamedTuple):
    """A data frame of a log."""

    t_ns: int
    channel: str | None
    arbitration_id: int
    is_extended: bool
    data: bytes


class Wanted(NamedTuple):
    """The ids of the frames with a sensor."""

    keys: frozenset[int]  # see `frame_key`
    groups: frozenset[int]  # J1939's PGNs

    def holds(self, arbitration_id: int, is_extended: bool) -> bool:
        if frame_key(arbitration_id, is_extended) in self.keys:
            return True
        return is_extended and parameter_group(arbitration_id) in self.groups

    def patterns(self) -> Iterator[bytes]:
        """Regular expressions of the ids as candump writes them."""
        for key in self.keys:
            yield b"%03X" % key if key <= 0x7FF else b"%08X" % (key & ID_BITS)
        for group in self.groups:  # any priority, any sender, and any destination if it has one
            heads = b"|".join(b"%02X" % (priority << 2 | group >> 16) for priority in range(8))
            rest = b"%04X[0-9A-F]{2}" % (group & 0xFFFF)
            if group >> 8 & 0xFF < PDU2:
                rest = b"%02X[0-9A-F]{4}" % (group >> 8 & 0xFF)
            yield b"(?:%b)%b" % (heads, rest)


class Everything(Wanted):
    """In place of the wanted ids: all."""

    def holds(self, arbitration_id: int, is_extended: bool) -> bool:
        return True

    def patterns(self) -> Iterator[bytes]:
        yield b"[0-9A-F]{3}|[01][0-9A-F]{7}"


EVERYTHING = Everything(frozenset(), frozenset())

FrameReader = Callable[[LogFile, Wanted], Iterator[LogFrame]]
"""The frames of a log whose ids are wanted. It counts all frames, and the bad ones by kind."""


def open_can_log(opening: Opening, read: FrameReader) -> Reading:
    """The reading of a CAN log; `read` returns its frames. Raises LogError if no bus is configured, or not that one;
    ConfigError if the configuration does not fit its DBC files."""
    file, name, config = opening.file, opening.name, opening.config
    if not config.can:
        raise LogError(f"{file.path}: the configuration has no [can.NAME] for it")
    if name is not None and name not in config.can:
        buses = ", ".join(config.can)
        raise LogError(f"{name}={file.path}: a {file.suffix} is a CAN log; configured buses: {buses}")
    decoders = {bus: CanDecoder(config, bus, opening.sequences) for bus in (config.can if name is None else (name,))}
    return Reading("can", list(decoders.values()), _events(opening, read, decoders))


def survey_can_log(found: Survey, read: FrameReader) -> None:
    """Add what is in a CAN log to a survey: a stream for each id of each channel."""
    found.protocol = "can"
    for t_ns, channel, arbitration_id, is_extended, data in _without_strays(read(found.file, EVERYTHING), found.file):
        name = f"0x{arbitration_id:08X}" if is_extended else f"0x{arbitration_id:03X}"
        if arbitration_id in OBD_ANSWERS and not is_extended and len(data) > 2:
            name += f" {data[1]:02X}{data[2]:02X}"  # each service and PID is a stream of its own
        found.ids[name] = arbitration_id, is_extended
        found.add("" if channel is None else channel, name, t_ns).keep(t_ns, data)


def _events(opening: Opening, read: FrameReader, decoders: Mapping[str, CanDecoder]) -> Iterator[list[Received]]:
    """The events of a CAN log, frame by frame in the order of the file. Raises LogError if the file has no CAN frame, or its
    channels fit no bus."""
    file = opening.file
    keys, groups = zip(*((decoder.keys, decoder.groups) for decoder in decoders.values()), strict=True)
    frames = _without_strays(read(file, Wanted(frozenset().union(*keys), frozenset().union(*groups))), file)
    head = list(islice(frames, DECISION))
    channels = [frame.channel for frame in head]
    buses = _decoders_by_channel(file, channels, decoders, opening.config, named=opening.name is not None)
    for t_ns, channel, arbitration_id, is_extended, data in chain(head, frames):
        decoder = buses.get(channel)
        if decoder is None:
            file.counts["other channels"] += 1
        else:
            yield decoder.decode(arbitration_id, is_extended, data, t_ns)
    if not file.counts["frames"]:
        raise LogError(f"{file.path}: no CAN frame in it; is it a {opening.about} log?")


def _without_strays(frames: Iterator[LogFrame], log: LogFile) -> Iterator[LogFrame]:
    """The frames without those whose stamp cannot be one, or alone jumps and returns: a damaged digit would delay everything
    after it. If the next stamps follow a jump, the clock was set."""
    last_ns: int | None = None
    held: LogFrame | None = None
    for frame in frames:
        if not log.takes_stamp(frame.t_ns):
            continue
        if held is not None:
            jump_ns = 0 if last_ns is None else abs(held.t_ns - last_ns)
            if jump_ns > STEP_NS and last_ns is not None and abs(frame.t_ns - held.t_ns) > abs(frame.t_ns - last_ns):
                log.counts["bad stamps"] += 1
            else:
                last_ns = held.t_ns
                yield held
        held = frame
    if held is not None:
        yield held


def _decoders_by_channel(
    log: LogFile, seen: list[str | None], decoders: Mapping[str, CanDecoder], config: Config, *, named: bool
) -> dict[str | None, CanDecoder]:
    """The decoder of each channel, by the rule above; `seen`: the channels of the first wheel frames."""
    buses: dict[str | None, CanDecoder] = {}
    for name, decoder in decoders.items():
        if decoder.keys or decoder.groups:
            given = config.can[name].log_channel
            buses[name if given is None else given] = decoder
    channels = set(seen)
    if not channels or channels & set(buses):
        return buses
    if len(buses) == 1 and len(channels) == 1:
        channel, decoder = seen[0], next(iter(buses.values()))
        if channel is None:
            return {None: decoder}
        if named or config.can[decoder.bus].log_channel is None:
            log.warnings.append(f"{log.path}: channel {channel} is used as the bus {decoder.bus}")
            return {channel: decoder}
    if None in channels:
        raise LogError(f"{log.path}: its format has no channels; name the bus: BUS={log.path}")
    listed = ", ".join(sorted(str(channel) for channel in channels))
    wanted = ", ".join(str(channel) for channel in buses)
    raise LogError(f"{log.path}: wheel frames are on {listed}, wanted on {wanted}: set log_channel in [can.BUS]")
