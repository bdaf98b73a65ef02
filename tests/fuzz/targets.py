"""What is fuzzed: each target makes one case by dice, runs it, and checks that everything received is accounted for."""

from __future__ import annotations

import gzip
import io
import math
import random
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from functools import cache
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import can

from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.engine import Engine
from fusiond.events import Received
from fusiond.messages import Message, StateMessage
from fusiond.ports.inputs import Inbox
from fusiond_adapters.can.bus import CanBus
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.can.kernel_socket import CanFrame
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.play import can_records, mavlink_records
from fusiond_adapters.mavlink.decoder import Dialect, FrameSplitter, MavlinkDecoder
from fusiond_adapters.mavlink.housekeeping import Housekeeping
from tests.fuzz.damage import damaged, damaged_text, odd_frame
from tests.helpers.paths import ROOT

DEMO = ROOT / "fusiond" / "app" / "demo" / "data"
LINK, BUS = "fcu", "car"
BATCH = 1000  # frames of a case
TEXTS = (".log", ".asc", ".trc", ".csv")  # logs
LONGEST_FRAME = 280  # bytes of a MAVLink frame
MAVLINK_COUNTS = ("decoded", "skipped", "other systems", "other components", "bad checksum", "undecodable")  # of frames
NO_FRAMES = {  # counts of a CAN log that are not of its frames
    "frames", "bad lines", "bad rows", "unreadable tail", "damaged gzip", "stamps run back", "steps back",
}  # fmt: skip


class Unaccounted(Exception):
    """Something received is in no count, or what was published is no number."""


class Case(NamedTuple):
    """What a case was."""

    tried: int  # frames, texts or files
    outcomes: Counter[str]


def check(what: str, received: int, counted: int) -> None:
    """Raise Unaccounted if two counts differ."""
    if received != counted:
        raise Unaccounted(f"{what}: {received} received, {counted} counted")


class Fused:
    """An engine that checks its accounts and its messages."""

    def __init__(self, settings: Config, dice: random.Random) -> None:
        if dice.random() < 0.1:
            self.engine = Engine(settings, self._look)
        else:
            self.engine = Engine(settings, self._look, rate_hz=10.0, only_states=True)
        self._receipts = 0

    def feed(self, event: Received) -> None:
        self._receipts += self.engine.feed(event) is not None

    def end(self) -> Counter[str]:
        """Finish. Returns the outcomes."""
        self.engine.finish()
        outcomes: Counter[str] = Counter()
        for counts in self.engine.fusion.outcomes().values():
            outcomes.update({name.lower(): count for name, count in counts.items()})
        check("measurements", self._receipts, outcomes.total())
        return +outcomes

    def _look(self, message: Message) -> None:
        if isinstance(message, StateMessage):
            for number in _numbers(message):
                if not math.isfinite(number):
                    raise Unaccounted(f"published: {message}")


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _numbers(inner)
    elif hasattr(value, "__struct_fields__"):
        for name in value.__struct_fields__:
            yield from _numbers(getattr(value, name))


# --- A drive, some of whose frames are damaged


@cache
def drive() -> tuple[Config, list[tuple[int, str, Any]]]:
    """The demonstration's configuration, and its records in order: stamp, `mavlink` or `can`, frame."""
    settings = config.load(DEMO / "fusiond.toml")
    records: list[tuple[int, str, Any]] = [(t_ns, "mavlink", one) for t_ns, one in mavlink_records(DEMO / "drive.tlog.gz")]
    records += [(t_ns, "can", one) for t_ns, one in can_records(DEMO / "drive.log.gz")]
    return settings, sorted(records, key=lambda record: record[0])


@cache
def dialect() -> Dialect:
    return Dialect(drive()[0].mavlink[LINK].dialect)


@cache
def kinds() -> tuple[list[Any], list[Any]]:
    """pymavlink's classes of all messages, and of those that fusiond reads."""
    every = [dialect().type_of(name) for name in dialect().ids]
    read = {"HEARTBEAT", "HIGHRES_IMU", "GPS_RAW_INT", "SYSTEM_TIME", "TIMESYNC", "SCALED_PRESSURE", "COMMAND_ACK"}
    return every, [kind for kind in every if kind.msgname in read]


def part(dice: random.Random, kind: str) -> list[tuple[int, str, Any]]:
    """A part of the drive with BATCH frames of a kind; half of the parts begin with its first frame."""
    records = drive()[1]
    begin = 0 if dice.random() < 0.5 else dice.randrange(len(records) // 2)
    found, count = [], 0
    for record in records[begin:]:
        found.append(record)
        count += record[1] == kind
        if count == BATCH:
            break
    return found


def fuzz_mavlink(dice: random.Random, _folder: Path) -> Case:
    """Frames through splitter, housekeeping, decoder and filter."""
    settings = drive()[0]
    decoder, housekeeping = MavlinkDecoder(settings, LINK), Housekeeping(settings, LINK)
    splitter, bus, fused = FrameSplitter(dialect()), CanDecoder(settings, BUS), Fused(settings, dice)
    sent = cut = frames = tried = 0
    rate = dice.choice((0.02, 0.2, 0.9))  # of damaged frames
    for t_ns, kind, item in part(dice, "mavlink"):
        if kind == "can":
            events = bus.decode(item.arbitration_id, item.is_extended_id, bytes(item.data), t_ns)
        else:
            tried += 1
            data, events = _bytes(item, dice, rate), []
            sent += len(data)
            for one in splitter.feed(data):
                frames, cut = frames + 1, cut + len(one)
                housekeeping.receive(one, t_ns)
                events += decoder.decode(one, t_ns)
            housekeeping.due(t_ns, alive=True)
            housekeeping.changes.clear()
        for event in events:
            fused.feed(event)
    left = sent - cut - splitter.skipped_bytes
    if not 0 <= left <= LONGEST_FRAME:
        raise Unaccounted(f"{sent} bytes received, {cut} in frames, {splitter.skipped_bytes} skipped")
    check("MAVLink frames", frames, sum(decoder.counts[name] for name in MAVLINK_COUNTS))
    return Case(tried, fused.end() + Counter({f"frames {name}": count for name, count in decoder.counts.items()}))


def _bytes(item: bytes, dice: random.Random, rate: float) -> bytes:
    if dice.random() > rate:
        return item
    every, read = kinds()
    makers: tuple[Callable[[], bytes], ...] = (
        lambda: damaged(item, dice),
        lambda: damaged(item, dice, most=1),
        lambda: item + odd_frame(every, dice),
        lambda: odd_frame(read, dice) + item,
        lambda: item[: dice.randrange(len(item))],
        lambda: dice.randbytes(dice.randrange(1, 40)) + item,
        lambda: item * dice.randrange(3),
    )
    return dice.choice(makers)()


def fuzz_can(dice: random.Random, _folder: Path) -> Case:
    """CAN frames, error and remote frames through the live bus and the filter."""
    settings = drive()[0]
    inbox: Inbox[CanFrame] = Inbox(BATCH, Event().set, lambda frame: frame.arbitration_id)
    bus, link, fused = CanBus(settings, BUS, inbox, HostClock()), MavlinkDecoder(settings, LINK), Fused(settings, dice)
    bus.prepare()
    wanted = sorted(bus.decoder.keys) if bus.decoder else []
    rate, tried = dice.choice((0.02, 0.2, 0.9)), 0
    for t_ns, kind, item in part(dice, "can"):
        if kind == "mavlink":
            events = link.decode(item, t_ns)
        else:
            tried += 1
            frame = CanFrame(item.arbitration_id, item.is_extended_id, bytes(item.data))
            if dice.random() < rate:
                size = dice.choice((0, 1, 4, 7, 8, 8, 8, 12, 64))
                number = dice.choice(wanted) if dice.random() < 0.7 else dice.getrandbits(29)
                extended, flags = bool(dice.randrange(2)) and number > 0x7FF, dice.choice((None, 0, 1, 3))
                error, remote = dice.random() < 0.1, dice.random() < 0.1
                frame = CanFrame(number, extended, dice.randbytes(size), flags, remote, error)
            bus.record(frame, t_ns)
            events = bus.decode(frame, t_ns)
        for event in events:
            fused.feed(event)
    counts = bus.counts()
    seen = ("error frames", "remote frames", "decoded", "other ids", "undecodable")
    check("CAN frames", tried, sum(counts.get(name, 0) for name in seen))
    return Case(tried, fused.end() + Counter({f"frames {name}": counts.get(name, 0) for name in seen}))


# --- Files


@cache
def tables() -> list[tuple[Path, bytes]]:
    """Every DBC of the project."""
    return [(path, path.read_bytes()) for path in (*sorted((ROOT / "configs").rglob("*.dbc")), DEMO / "wheels.dbc")]


def fuzz_dbc(dice: random.Random, folder: Path) -> Case:
    """A DBC into a decoder, and frames of its ids through it."""
    path, content = dice.choice(tables())
    settings = drive()[0] if path.parent == DEMO else config.load(ROOT / "configs" / "rav4.toml")
    bus = next(iter(settings.can))
    damaged_path = folder / "fuzz.dbc"
    damaged_path.write_bytes(damaged_text(content, dice, most=dice.choice((1, 8))))
    sections = {"can": {bus: _replaced(settings.can[bus], dbc=(str(damaged_path),))}}
    outcomes: Counter[str] = Counter()
    try:
        decoder = CanDecoder(_replaced(settings, **sections), bus)
    except ConfigError:
        return Case(1, Counter(refused=1))
    for key in sorted(decoder.keys):
        for size in (0, 3, 8, 64):
            for event in decoder.decode(key & 0x1FFFFFFF, key >= 1 << 31, dice.randbytes(size), 1):
                outcomes[type(event.payload).__name__] += 1
    return Case(1, outcomes + Counter(read=1))


def _replaced(value: Any, **fields: Any) -> Any:
    import msgspec.structs  # noqa: PLC0415

    return msgspec.structs.replace(value, **fields)


@cache
def configurations() -> list[tuple[Path, bytes]]:
    """Every configuration of a vehicle in the project."""
    paths = (*sorted((ROOT / "configs").rglob("*.toml")), DEMO / "fusiond.toml")
    return [(path, path.read_bytes()) for path in paths if not path.name.startswith("simulate")]


def fuzz_toml(dice: random.Random, _folder: Path) -> Case:
    """A configuration, read and checked."""
    path, content = dice.choice(configurations())
    try:
        config.parse(damaged_text(content, dice).decode("utf-8", "replace"), path)
    except ConfigError:
        return Case(1, Counter(refused=1))
    return Case(1, Counter(read=1))


@cache
def logs() -> dict[str, bytes]:
    """The begin of the drive in every format of log, by suffix."""
    import tempfile  # noqa: PLC0415

    found = {}
    content = gzip.decompress((DEMO / "drive.tlog.gz").read_bytes())
    found[".tlog"] = content[: 60 * BATCH]
    frames = [item for _, kind, item in drive()[1][: 4 * BATCH] if kind == "can"]
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".log", ".asc", ".blf", ".trc", ".csv", ".db"):
            path = Path(folder) / f"drive{suffix}"
            with can.Logger(str(path)) as writer:
                for message in frames:
                    message.channel = 0 if suffix != ".log" else "can0"
                    writer(message)
            found[suffix] = path.read_bytes()
    for suffix in (".tlog", ".log"):
        found[f"{suffix}.gz"] = gzip.compress(found[suffix], 1)
    return found


def fuzz_logs(dice: random.Random, folder: Path) -> Case:
    """A log file through its reader and the filter."""
    suffix, content = dice.choice(sorted(logs().items()))
    path = folder / f"fuzz{suffix}"
    damage = damaged_text if suffix in TEXTS and dice.random() < 0.7 else damaged
    path.write_bytes(damage(content, dice, most=dice.choice((1, 4, 40))))
    name = LINK if suffix.startswith(".tlog") else BUS
    read, fused = open_logs([f"{name}={path}"], drive()[0]), Fused(drive()[0], dice)
    try:
        with redirect_stderr(io.StringIO()):
            for event in read:
                fused.feed(event)
    except LogError:
        return Case(1, Counter({f"{suffix} refused": 1}))
    counts = Counter(read.counts[str(path)])
    if suffix.startswith(".tlog"):
        check(f"{suffix} records", counts["records"], sum(counts[name] for name in (*MAVLINK_COUNTS, "bad stamps")))
    else:
        check(f"{suffix} frames", counts["frames"], sum(counts[name] for name in counts.keys() - NO_FRAMES))
    return Case(1, fused.end() + Counter({f"{suffix} read": 1}))


class Target(NamedTuple):
    """One target, and how many frames, texts or files a full run tries."""

    run: Callable[[random.Random, Path], Case]
    about: str
    full: int


TARGETS = {
    "mavlink": Target(fuzz_mavlink, "MAVLink frames", 1_000_000),
    "can": Target(fuzz_can, "CAN frames", 200_000),
    "dbc": Target(fuzz_dbc, "DBC files", 10_000),
    "logs": Target(fuzz_logs, "log files", 1_000),
    "toml": Target(fuzz_toml, "configurations", 10_000),
}
