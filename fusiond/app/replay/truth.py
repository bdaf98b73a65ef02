"""The reference track ("truth"): its CSV file, its interpolation, and distances from it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from fusiond.errors import UnusableError
from fusiond.maths.wgs84 import radii
from fusiond.units import MICROSECOND, SECOND

MAX_GAP_NS = 2 * SECOND  # between samples of the truth: a longer gap is not interpolated


class TruthError(UnusableError):
    """A truth file that cannot be used; the message names file, line and column."""


class TruthSample(NamedTuple):
    """One instant of the reference track."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    height_m: float
    vn_mps: float
    ve_mps: float
    yaw_deg: float
    pitch_deg: float = math.nan  # not a number where the track does not tell
    roll_deg: float = math.nan


TRUTH_COLUMNS = ("unix_us", "lat_deg", "lon_deg", "height_m", "vn_mps", "ve_mps", "yaw_deg")
LEVEL_COLUMNS = ("pitch_deg", "roll_deg")  # a track may have both
LIMITS_DEG = {"lat_deg": 90.0, "lon_deg": 180.0, "yaw_deg": 360.0, "pitch_deg": 90.0, "roll_deg": 180.0}


def parse_truth(lines: Iterable[str], name: str) -> Iterator[TruthSample]:
    """The samples of a truth CSV: a header with at least TRUTH_COLUMNS, then lines of rising unix_us. Columns other than
    those and LEVEL_COLUMNS are ignored. `name` is the file's, for messages. Raises TruthError."""
    numbered = enumerate(lines, 1)
    header = [column.strip() for column in next(numbered, (1, ""))[1].removeprefix("\ufeff").split(",")]
    missing = [column for column in TRUTH_COLUMNS if column not in header]
    if missing:
        raise TruthError(f"{name}:1: no column {', '.join(missing)}; a truth needs {', '.join(TRUTH_COLUMNS)}")
    columns = TRUTH_COLUMNS + (LEVEL_COLUMNS if all(column in header for column in LEVEL_COLUMNS) else ())
    places = [header.index(column) for column in columns]
    last_ns: int | None = None
    for number, line in numbered:
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != len(header):
            raise TruthError(f"{name}:{number}: {len(cells)} cells where the header has {len(header)} columns")
        sample = _sample([cells[place].strip() for place in places], f"{name}:{number}")
        if last_ns is not None and sample.t_ns <= last_ns:
            stamps = f"{sample.t_ns // MICROSECOND} after {last_ns // MICROSECOND}"
            raise TruthError(f"{name}:{number}: unix_us does not rise: {stamps}")
        last_ns = sample.t_ns
        yield sample
    if last_ns is None:
        raise TruthError(f"{name}: no rows")


def _sample(cells: list[str], where: str) -> TruthSample:
    if not (cells[0].isascii() and cells[0].isdigit()):
        raise TruthError(f"{where}: unix_us: '{cells[0]}' is not a whole number of microseconds")
    numbers = []
    for column, cell in zip((*TRUTH_COLUMNS, *LEVEL_COLUMNS)[1:], cells[1:], strict=False):
        try:
            number = float(cell)
        except ValueError:
            raise TruthError(f"{where}: {column}: '{cell}' is not a number") from None
        if not abs(number) <= LIMITS_DEG.get(column, math.inf) or not math.isfinite(number):
            raise TruthError(f"{where}: {column}: {cell} is out of range")
        numbers.append(number)
    return TruthSample(int(cells[0]) * MICROSECOND, *numbers)


class Truth:
    """A reference track, read as it is needed, and again from its begin for an instant before the last one asked for."""

    def __init__(self, samples: Iterable[TruthSample]) -> None:
        self._all = samples
        self._begin()

    def __iter__(self) -> Iterator[TruthSample]:
        """All samples, from the first on."""
        return iter(self._all)

    def _begin(self) -> None:
        self._samples = iter(self._all)
        self._before: TruthSample | None = None
        self._after = next(self._samples, None)

    def at(self, t_ns: int) -> TruthSample | None:
        """The track at an instant, interpolated linearly (angles the short way round); None outside it and in gaps."""
        if self._before is not None and t_ns < self._before.t_ns:
            self._begin()
        while self._after is not None and self._after.t_ns <= t_ns:
            self._before, self._after = self._after, next(self._samples, None)
        before, after = self._before, self._after
        if before is None or before.t_ns == t_ns:
            return before
        if after is None or after.t_ns - before.t_ns > MAX_GAP_NS:
            return None
        share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)

        def between(a: float, b: float) -> float:
            return a + share * (b - a)

        return TruthSample(
            t_ns,
            between(before.lat_deg, after.lat_deg),
            before.lon_deg + share * wrapped(after.lon_deg - before.lon_deg),
            between(before.height_m, after.height_m),
            between(before.vn_mps, after.vn_mps),
            between(before.ve_mps, after.ve_mps),
            before.yaw_deg + share * wrapped(after.yaw_deg - before.yaw_deg),
            between(before.pitch_deg, after.pitch_deg),
            before.roll_deg + share * wrapped(after.roll_deg - before.roll_deg),
        )


def wrapped(angle_deg: float) -> float:
    """An angle in [-180, 180) deg."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def displacement(lat_deg: float, lon_deg: float, origin: tuple[float, float], height_m: float) -> tuple[float, float]:
    """Metres north and east of a nearby origin (lat, lon) [deg]; `height_m` is above the ellipsoid."""
    latitude = math.radians(origin[0])
    meridian, transverse = radii(latitude)
    north = math.radians(lat_deg - origin[0]) * (meridian + height_m)
    east = math.radians(wrapped(lon_deg - origin[1])) * (transverse + height_m) * math.cos(latitude)
    return north, east
