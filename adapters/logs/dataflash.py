"""Reader of .bin, the DataFlash logs of ArduPilot: records described by the log itself, taken by column.

Used are IMU, GPS with GPA, BARO and WENC (or RWOH, which logs for replay have), each by its instance: its column `I`, or in
old logs the number in its name (IMU2). Counts: `records`, `decoded`, `bad bytes` (between records), `truncated tail`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from struct import Struct
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fusiond.config.schema import Barometer, DualAntenna, Gnss, Imu, Wheel
from fusiond.config.sensor import Sensor
from fusiond.events import FIX_3D, Received
from fusiond.units import MICROSECOND
from fusiond_adapters.logs.autopilot_log import (
    Array,
    AutopilotLog,
    Samples,
    gnss_fields,
    imu_fields,
    instance,
    pressure_fields,
    wheel_fields,
)
from fusiond_adapters.logs.file import LogError, LogFile
from fusiond_adapters.logs.format import Opening, Reading
from fusiond_adapters.mavlink.sensors import Handler

if TYPE_CHECKING:
    from fusiond_adapters.logs.survey import Survey

HEAD = b"\xa3\x95"
HEADER = 3  # bytes: these two, and the type
FMT, FMT_SIZE = 128, 89
FMT_BODY = Struct("<BB4s16s64s")  # type, length, name, format, columns
TOLD = 200  # characters of the autopilot's messages about itself
PIECE = 1 << 22  # bytes taken at a time
CODES = {  # of a column: numpy's type, and the factor to its unit
    "a": ("(32,)<i2", 1), "b": ("i1", 1), "B": ("u1", 1), "h": ("<i2", 1), "H": ("<u2", 1), "i": ("<i4", 1), "I": ("<u4", 1),
    "f": ("<f4", 1), "d": ("<f8", 1), "g": ("<f2", 1), "n": ("S4", 1), "N": ("S16", 1), "Z": ("S64", 1), "M": ("u1", 1),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01), "L": ("<i4", 1e-7),
    "q": ("<i8", 1), "Q": ("<u8", 1),
}  # fmt: skip
NUMBERED = re.compile(r"(IMU|GPS|GPA|BARO|BAR|WENC|RWOH)([23]?)")  # kind, and the number of the instance in old logs
GPS_EPOCH_S = 315_964_800  # Unix time of week 0
WEEK_S = 604_800
LEAPS = ((1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16), (0, 15))  # from then on GPS is ahead by [s]


class Records(NamedTuple):
    """The records of one kind in a piece of a log."""

    order: Array  # (n,) places in the log [bytes]
    columns: Mapping[str, Array]  # (n,) each, in the unit of the log


class _Format(NamedTuple):
    name: str
    size: int  # bytes of a record
    dtype: np.dtype[Any] | None  # None if it cannot be read
    factors: Mapping[str, float]


def open_log(opening: Opening) -> Reading:
    """The reading of a .bin, by default of the first link. Raises LogError."""
    decoder = AutopilotLog(opening)
    return Reading("mavlink", [decoder], _events(opening.file, decoder))


def _events(log: LogFile, decoder: AutopilotLog) -> Iterator[list[Received]]:
    decoder.base_ns = boot_unix_ns(log)
    makers = [_maker(section, handler) for section, handler in decoder.sensors]
    for records in pieces(log, log.counts):
        yield from decoder.events(samples for maker in makers for samples in maker(records))
    if not log.counts["records"]:
        raise LogError(f"{log.path}: no record in it; is it a DataFlash log?")


def survey(found: Survey) -> None:
    """Add what is in a .bin to a survey: a stream for each kind of record, by instance. Raises LogError."""
    found.protocol, log = "mavlink", found.file
    base_ns = boot_unix_ns(log)
    for records in pieces(log, log.counts):
        for name, (_, columns) in records.items():
            numbers = columns.get("I", columns.get("C"))
            t_ns = base_ns + log_time_us(name, columns) * MICROSECOND
            if numbers is None or numbers.ndim != 1 or numbers.dtype.kind not in "iu":
                found.add_all("autopilot", name, t_ns.tolist())
                continue
            for number in np.unique(numbers).tolist():
                found.add_all("autopilot", f"{name}[{number}]", t_ns[numbers == number].tolist())
        if "MSG" in records:
            told = b" ".join(records["MSG"].columns["Message"].tolist()).decode("ascii", "replace")
            found.senders["autopilot"] = (found.senders.get("autopilot", "ARDUPILOTMEGA") + f" {told}")[:TOLD]


def pieces(log: LogFile, counts: Counter[str]) -> Iterator[dict[str, Records]]:
    """A log piece by piece: the records of each kind. Kinds whose description cannot be read are left out."""
    formats: dict[int, _Format] = {FMT: _Format("FMT", FMT_SIZE, None, {})}
    rest, start = b"", 0  # start: place of the rest in the log
    for block in _gathered(log.blocks()):
        data = rest + block
        places, end = _walk(data, formats, counts)
        yield {
            formats[kind].name: _records(data, np.array(found), formats[kind], start)
            for kind, found in places.items()
            if formats[kind].dtype is not None
        }
        rest, start = data[end:], start + end
    if rest:
        counts["truncated tail" if rest.startswith(HEAD) else "bad bytes"] += 1 if rest.startswith(HEAD) else len(rest)


def _gathered(blocks: Iterator[bytes]) -> Iterator[bytes]:
    """The same bytes in larger blocks."""
    some: list[bytes] = []
    for block in blocks:
        some.append(block)
        if sum(map(len, some)) >= PIECE:
            yield b"".join(some)
            some = []
    if some:
        yield b"".join(some)


def _walk(data: bytes, formats: dict[int, _Format], counts: Counter[str]) -> tuple[dict[int, list[int]], int]:
    """The places of the records by type, and where the first one begins that is not whole."""
    places: dict[int, list[int]] = {}
    sizes = {kind: one.size for kind, one in formats.items()}
    at, last, records, bad = 0, len(data) - HEADER, 0, 0
    while at <= last:
        kind = data[at + 2]
        size = sizes.get(kind, 0) if data[at] == 0xA3 and data[at + 1] == 0x95 else 0
        if not size:
            found = data.find(HEAD, at + 1)
            start = len(data) - 1 if found < 0 else found
            bad, at = bad + start - at, start
            continue
        if at + size > len(data):
            break
        if kind == FMT:
            described = _format(data[at + HEADER : at + size])
            formats[described[0]], sizes[described[0]] = described[1], described[1].size
        places.setdefault(kind, []).append(at)
        records += 1
        at += size
    counts["records"] += records
    if bad:
        counts["bad bytes"] += bad
    return places, at


def _format(body: bytes) -> tuple[int, _Format]:
    """The description of a kind of record: its type, and how it is read."""
    kind, size, name, codes, labels = FMT_BODY.unpack(body)
    letters, columns = _text(codes), _text(labels).split(",")
    dtype = None
    if len(letters) == len(columns) == len(set(columns)) and set(letters) <= set(CODES):
        dtype = np.dtype([(column, CODES[letter][0]) for column, letter in zip(columns, letters, strict=True)])
        if dtype.itemsize != size - HEADER:
            dtype = None
    factors = {column: CODES[letter][1] for column, letter in zip(columns, letters, strict=False) if letter in CODES}
    return kind, _Format(_text(name), size if size > HEADER else 0, dtype if kind != FMT else None, factors)


def _text(padded: bytes) -> str:
    return padded.partition(b"\0")[0].decode("ascii", "replace")


def _records(data: bytes, places: Array, form: _Format, start: int) -> Records:
    assert form.dtype is not None, "the caller has checked"
    body = np.frombuffer(data, np.uint8)[places[:, None] + np.arange(HEADER, form.size)]
    table = np.ascontiguousarray(body).view(form.dtype)[:, 0]
    columns = {
        name: table[name] if form.factors[name] == 1 else table[name] * form.factors[name] for name in form.dtype.names or ()
    }
    return Records(places + start, columns)


def log_time_us(name: str, columns: Mapping[str, Array]) -> Array:
    """When records were logged, from boot [us]."""
    if "TimeUS" in columns:
        return columns["TimeUS"].astype(np.int64)
    old = "T" if name.startswith("GPS") and "T" in columns else "TimeMS"  # the TimeMS of an old GPS is GPS time
    return columns[old].astype(np.int64) * 1000 if old in columns else np.zeros(len(next(iter(columns.values()))), np.int64)


def fix_time_us(columns: Mapping[str, Array]) -> Array:
    """Unix time of fixes [us]; 0 where it is unknown."""
    week, milliseconds = (
        columns[new if new in columns else old].astype(np.int64) for new, old in (("GWk", "Week"), ("GMS", "TimeMS"))
    )
    gps_s = GPS_EPOCH_S + week * WEEK_S + milliseconds // 1000
    leap_s = np.select([gps_s >= since for since, _ in LEAPS], [leap for _, leap in LEAPS])
    return np.where(week > 0, (gps_s - leap_s) * 10**6 + milliseconds % 1000 * 1000, 0)


def boot_unix_ns(log: LogFile) -> int:
    """Unix time of the boot, by the first fix; 0 if there is none. A log does not tell how late a fix came."""
    for records in pieces(log, Counter()):
        found = []
        for name, (_, columns) in records.items():
            if name.startswith("GPS") and {"Status", "Lat"} <= set(columns):
                t_us, unix_us = log_time_us(name, columns), fix_time_us(columns)
                good = (columns["Status"] >= FIX_3D) & (unix_us > 0)
                found += (unix_us - t_us)[good][:1].tolist()
        if found:
            return int(found[0]) * MICROSECOND
    return 0


def of_kind(pieces: Mapping[str, Records], kinds: tuple[str, ...], number: int) -> Iterator[tuple[str, Records]]:
    """The records of some kinds, of the instance of that number (from 0), with their names."""
    for name, (order, columns) in pieces.items():
        found = NUMBERED.fullmatch(name)
        if found and found[1] in kinds:
            if "I" in columns:
                rows = columns["I"] == number
                yield name, Records(order[rows], {label: column[rows] for label, column in columns.items()})
            elif number == int(found[2] or 1) - 1:
                yield name, Records(order, columns)


Maker = Callable[[Mapping[str, Records]], Iterator[Samples]]


def _maker(section: Sensor, handler: Handler) -> Maker:
    """A function that makes the samples of a sensor out of the records in a piece of a log."""
    match section:
        case Imu():
            return partial(_imu, section, handler)
        case Gnss() | DualAntenna():
            return _Fixes(section, handler).samples
        case Barometer():
            return partial(_barometer, section, handler)
        case Wheel():
            return _Wheels(handler).samples
    raise TypeError(f"no record is of a {section.label}")


def _imu(section: Imu, handler: Handler, records: Mapping[str, Records]) -> Iterator[Samples]:
    for name, (order, columns) in of_kind(records, ("IMU",), instance(section)):
        t_us = log_time_us(name, columns)
        force, rate = (np.stack([columns[f"{kind}{axis}"] for axis in "XYZ"], 1).astype(float) for kind in ("Acc", "Gyr"))
        yield Samples(handler, order, t_us, imu_fields(section, t_us, force, rate))


def _barometer(section: Barometer, handler: Handler, records: Mapping[str, Records]) -> Iterator[Samples]:
    for name, (order, columns) in of_kind(records, ("BARO", "BAR"), instance(section)):
        t_us = log_time_us(name, columns)
        fields = pressure_fields(t_us, columns["Press"].astype(float), columns["Temp"].astype(float))
        yield Samples(handler, order, t_us, fields)


class _Fixes:
    """The fixes of a receiver, each with the accuracies (GPA) that came last before it."""

    def __init__(self, section: Gnss | DualAntenna, handler: Handler) -> None:
        self._handler, self._number = handler, instance(section)
        self._sigmas = np.zeros((1, 3))  # the latest: of position and height [m], and speed [m/s]

    def samples(self, records: Mapping[str, Records]) -> Iterator[Samples]:
        orders, sigmas = [np.full(1, -1)], [self._sigmas]
        for _, (order, columns) in of_kind(records, ("GPA",), self._number):
            orders.append(order)
            known = (columns.get(key, np.zeros(len(order))) for key in ("HAcc", "VAcc", "SAcc"))
            sigmas.append(np.stack([column.astype(float) for column in known], 1))
        stamps, accuracies = np.concatenate(orders), np.concatenate(sigmas)
        for name, (order, columns) in of_kind(records, ("GPS",), self._number):
            latest = accuracies[np.searchsorted(stamps, order) - 1]
            place = np.stack([columns[key] for key in ("Lat", "Lng", "Alt")], 1)
            motion = np.stack([columns[key] for key in ("Spd", "GCrs")], 1).astype(float)
            fix_us, yaw = fix_time_us(columns), columns.get("Yaw")
            fields = gnss_fields(fix_us, columns["Status"], place, motion, latest, yaw)
            yield Samples(self._handler, order, log_time_us(name, columns), fields)
        self._sigmas = accuracies[-1:]


class _Wheels:
    """The distances that wheels have rolled: of WENC, or summed up from the RWOH of logs for replay."""

    def __init__(self, handler: Handler) -> None:
        self._handler = handler
        self._has_distances = False
        self._turned: dict[tuple[float, ...], float] = {}  # by the place of a wheel: distance so far [m]

    def samples(self, records: Mapping[str, Records]) -> Iterator[Samples]:
        if "WENC" in records:
            self._has_distances = True
            order, columns = records["WENC"]
            t_us = log_time_us("WENC", columns)
            distances = np.stack([columns[key] for key in ("Dist0", "Dist1")], 1).astype(float)
            yield Samples(self._handler, order, t_us, wheel_fields(t_us, distances))
        elif "RWOH" in records and not self._has_distances:
            yield self._summed(*records["RWOH"])

    def _summed(self, order: Array, columns: Mapping[str, Array]) -> Samples:
        rows = []
        turns = (columns[key].tolist() for key in ("DA", "R", "PX", "PY", "PZ"))
        for angle, radius, *place in zip(*turns, strict=True):
            wheel = tuple(place)
            self._turned[wheel] = self._turned.get(wheel, 0.0) + angle * radius
            rows.append((*self._turned.values(), *[0.0] * 16)[:16])
        t_us = columns["TS"].astype(np.int64) * 1000
        fields = wheel_fields(t_us, np.array(rows).reshape(len(rows), 16))
        return Samples(self._handler, order, t_us, fields)
