"""Comparison of published states with a reference track ("truth"), in constant memory however long the drive."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from msgspec import Struct

from fusiond.errors import UnusableError
from fusiond.maths.statistics import chi_square
from fusiond.maths.wgs84 import radii
from fusiond.messages.types import State, StateMessage

ELLIPSE_95 = chi_square(0.95, 2)  # squared Mahalanobis distance of the 95 % ellipse: 5.99
LONGEST_GAP_NS = 2_000_000_000  # between rows of the truth: a longer hole is not interpolated across

POSITION_STEP, POSITION_LIMIT = 1e-3, 1000.0  # m, bins of the error histograms and where they end
SPEED_STEP, SPEED_LIMIT = 1e-3, 100.0  # m/s
ANGLE_STEP, ANGLE_LIMIT = 1e-3, 180.0  # deg


class TruthError(UnusableError):
    """A truth file that cannot be used; the message names file, line and column."""


# --- The reference


class TruthRow(NamedTuple):
    """One instant of the reference track."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    height_m: float
    vn_mps: float
    ve_mps: float
    yaw_deg: float


TRUTH_COLUMNS = ("unix_us", *TruthRow._fields[1:])
LIMITS_DEG = {"lat_deg": 90.0, "lon_deg": 180.0, "yaw_deg": 360.0}


def parse_truth(lines: Iterable[str], name: str) -> Iterator[TruthRow]:
    """The rows of a truth CSV: a header with at least TRUTH_COLUMNS, then rows of rising unix_us. Other columns are
    passed over. `name` is the file's, for messages. Raises TruthError."""
    numbered = enumerate(lines, 1)
    header = [column.strip() for column in next(numbered, (1, ""))[1].removeprefix("\ufeff").split(",")]
    missing = [column for column in TRUTH_COLUMNS if column not in header]
    if missing:
        raise TruthError(f"{name}:1: no column {', '.join(missing)}; a truth needs {', '.join(TRUTH_COLUMNS)}")
    places = [header.index(column) for column in TRUTH_COLUMNS]
    last_ns = None
    for number, line in numbered:
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != len(header):
            raise TruthError(f"{name}:{number}: {len(cells)} cells where the header has {len(header)} columns")
        row = _truth_row([cells[place].strip() for place in places], f"{name}:{number}")
        if last_ns is not None and row.t_ns <= last_ns:
            raise TruthError(f"{name}:{number}: unix_us does not rise: {row.t_ns // 1000} after {last_ns // 1000}")
        last_ns = row.t_ns
        yield row
    if last_ns is None:
        raise TruthError(f"{name}: no rows")


def _truth_row(cells: list[str], where: str) -> TruthRow:
    if not (cells[0].isascii() and cells[0].isdigit()):
        raise TruthError(f"{where}: unix_us: '{cells[0]}' is not a whole number of microseconds")
    numbers = []
    for column, cell in zip(TRUTH_COLUMNS[1:], cells[1:], strict=True):
        try:
            number = float(cell)
        except ValueError:
            raise TruthError(f"{where}: {column}: '{cell}' is not a number") from None
        if not abs(number) <= LIMITS_DEG.get(column, math.inf) or not math.isfinite(number):
            raise TruthError(f"{where}: {column}: {cell} is out of range")
        numbers.append(number)
    return TruthRow(int(cells[0]) * 1000, *numbers)


class Truth:
    """A reference track that is asked for instants that never go back, and reads its rows as it goes."""

    def __init__(self, rows: Iterable[TruthRow]) -> None:
        self._rows = iter(rows)
        self._before: TruthRow | None = None
        self._after = next(self._rows, None)

    def at(self, t_ns: int) -> TruthRow | None:
        """The track at an instant, interpolated linearly (angles the short way round); None outside of it."""
        while self._after is not None and self._after.t_ns <= t_ns:
            self._before, self._after = self._after, next(self._rows, None)
        before, after = self._before, self._after
        if before is None or before.t_ns == t_ns:
            return before
        if after is None or after.t_ns - before.t_ns > LONGEST_GAP_NS:
            return None
        share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)

        def between(a: float, b: float) -> float:
            return a + share * (b - a)

        return TruthRow(
            t_ns,
            between(before.lat_deg, after.lat_deg),
            before.lon_deg + share * wrapped(after.lon_deg - before.lon_deg),
            between(before.height_m, after.height_m),
            between(before.vn_mps, after.vn_mps),
            between(before.ve_mps, after.ve_mps),
            before.yaw_deg + share * wrapped(after.yaw_deg - before.yaw_deg),
        )


def wrapped(angle_deg: float) -> float:
    """An angle in [-180, 180) deg."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def displacement(lat_deg: float, lon_deg: float, origin: tuple[float, float], height_m: float) -> tuple[float, float]:
    """Metres north and east of an origin (lat, lon) [deg] nearby; `height_m` above the ellipsoid."""
    latitude = math.radians(origin[0])
    meridian, transverse = radii(latitude)
    north = math.radians(lat_deg - origin[0]) * (meridian + height_m)
    east = math.radians(wrapped(lon_deg - origin[1])) * (transverse + height_m) * math.cos(latitude)
    return north, east


# --- The errors


class Errors(NamedTuple):
    """Published less true, at one instant."""

    north_m: float
    east_m: float
    height_m: float
    velocity_mps: float  # horizontal, amount
    yaw_deg: float  # wrapped
    inside: bool  # the horizontal position error lies in the 95 % ellipse of the published covariance
    true: TruthRow

    @property
    def horizontal_m(self) -> float:
        return math.hypot(self.north_m, self.east_m)


def errors_of(message: StateMessage, true: TruthRow | None) -> Errors | None:
    """The errors of a published state; None where there is no state or no truth."""
    state = message.state
    if state is None or true is None:
        return None
    north, east = displacement(state.lat_deg, state.lon_deg, (true.lat_deg, true.lon_deg), true.height_m)
    vn, ve, _ = state.velocity_ned_mps
    return Errors(
        north,
        east,
        state.height_m - true.height_m,
        math.hypot(vn - true.vn_mps, ve - true.ve_mps),
        wrapped(state.yaw_deg - true.yaw_deg),
        _mahalanobis2(north, east, state) <= ELLIPSE_95,
        true,
    )


def _mahalanobis2(north: float, east: float, state: State) -> float:
    """Squared horizontal error in units of the published covariance; infinite where that is singular."""
    nn, ne, _, _, ee, *_ = state.covariance_position_m2
    determinant = nn * ee - ne * ne
    if determinant <= 0:
        return math.inf
    return (ee * north * north - 2 * ne * north * east + nn * east * east) / determinant


# --- What they come to


class Histogram:
    """Counts in bins of one width up to a limit either side of zero; what lies beyond goes into the last bins.

    Quantiles are those of the bins' middles, so right to half a width; least and greatest value are exact.
    """

    def __init__(self, step: float, limit: float) -> None:
        self._step, self._last = step, round(limit / step)
        self._bins: defaultdict[int, int] = defaultdict(int)
        self.count = 0
        self.least, self.greatest = math.inf, -math.inf

    def add(self, value: float, count: int = 1) -> None:
        """Count a value, `count` times over."""
        place = math.floor(value / self._step)
        if not -self._last <= place <= self._last:
            place = self._last if place > 0 else -self._last
        self._bins[place] += count
        self.count += count
        if value < self.least:
            self.least = value
        if value > self.greatest:
            self.greatest = value

    def quantile(self, share: float) -> float:
        """The least value that at least this share of all does not exceed."""
        return self._ranked(share, sorted((self._middle(place), count) for place, count in self._bins.items()))

    def quantile_of_distance(self, share: float, centre: float) -> float:
        """The same of the distances from a centre."""
        distances = ((abs(self._middle(place) - centre), count) for place, count in self._bins.items())
        return self._ranked(share, sorted(distances))

    def _middle(self, place: int) -> float:
        return max(self.least, min(self.greatest, (place + 0.5) * self._step))

    def _ranked(self, share: float, bins: list[tuple[float, int]]) -> float:
        seen, wanted = 0, share * self.count
        for value, count in bins:
            seen += count
            if seen >= wanted:
                return value
        raise ValueError("no value was counted")


class Mean:
    """Mean and mean square of values, as they come."""

    def __init__(self) -> None:
        self.count = 0
        self._sum = self._squares = 0.0

    def add(self, value: float) -> None:
        self.count += 1
        self._sum += value
        self._squares += value * value

    @property
    def value(self) -> float:
        return self._sum / self.count

    @property
    def square(self) -> float:
        return self._squares / self.count

    @property
    def variance(self) -> float:
        return max(0.0, self.square - self.value**2)


class PositionReport(Struct, frozen=True, kw_only=True):
    """Horizontal position error, published less true [m]."""

    rmse_m: float
    p95_m: float
    max_m: float
    offset_north_m: float  # the mean error
    offset_east_m: float
    rmse_offset_removed_m: float
    end_m: float  # in the last row
    inside_95: float  # share of rows inside the 95 % ellipse of the published covariance: 0.95 or more is honest


class HeadingReport(Struct, frozen=True, kw_only=True):
    """Heading error [deg], its mean removed: the truth's axes and the IMU's need not be the same."""

    rmse_deg: float
    p95_deg: float
    offset_deg: float  # the mean that was removed


class TruthReport(Struct, frozen=True, kw_only=True):
    """How far the published states lie from the truth, over a window of the drive."""

    start_s: float  # of the first row compared, from the first event
    stop_s: float
    rows: int
    distance_m: float  # travelled in the window, by the truth
    position: PositionReport
    height_rmse_m: float
    velocity_rmse_mps: float  # horizontal
    velocity_p95_mps: float
    heading: HeadingReport


class Window(NamedTuple):
    """An interval in seconds from the first event, both ends included."""

    start_s: float = 0.0
    stop_s: float = math.inf


class Comparison:
    """Gathers the errors within a window of the drive."""

    def __init__(self, window: Window | None = None) -> None:
        self._window = window or Window()
        self._north, self._east, self._height, self._heading = Mean(), Mean(), Mean(), Mean()
        self._speed, self._inside = Mean(), Mean()
        self._horizontals = Histogram(POSITION_STEP, POSITION_LIMIT)
        self._speeds = Histogram(SPEED_STEP, SPEED_LIMIT)
        self._headings = Histogram(ANGLE_STEP, ANGLE_LIMIT)
        self._first_yaw = 0.0  # heading errors are taken against the first, so that an offset near 180 does no harm
        self._start_s = self._stop_s = self._distance = 0.0
        self._last: Errors | None = None

    def add(self, since_start_ns: int, errors: Errors) -> None:
        """Take the errors of one publication; they must come in order of time."""
        second = since_start_ns / 1e9
        if not self._window.start_s <= second <= self._window.stop_s:
            return
        if self._last is None:
            self._start_s, self._first_yaw = second, errors.yaw_deg
        else:
            before, true = self._last.true, errors.true
            origin = before.lat_deg, before.lon_deg
            self._distance += math.hypot(*displacement(true.lat_deg, true.lon_deg, origin, true.height_m))
        self._stop_s, self._last = second, errors
        self._north.add(errors.north_m)
        self._east.add(errors.east_m)
        self._height.add(errors.height_m)
        self._speed.add(errors.velocity_mps)
        self._inside.add(float(errors.inside))
        heading = wrapped(errors.yaw_deg - self._first_yaw)
        self._heading.add(heading)
        self._horizontals.add(errors.horizontal_m)
        self._speeds.add(errors.velocity_mps)
        self._headings.add(heading)

    def report(self) -> TruthReport | None:
        """What the errors come to; None where nothing could be compared."""
        if self._last is None:
            return None
        return TruthReport(
            start_s=self._start_s,
            stop_s=self._stop_s,
            rows=self._north.count,
            distance_m=self._distance,
            position=PositionReport(
                rmse_m=math.sqrt(self._north.square + self._east.square),
                p95_m=self._horizontals.quantile(0.95),
                max_m=self._horizontals.greatest,
                offset_north_m=self._north.value,
                offset_east_m=self._east.value,
                rmse_offset_removed_m=math.sqrt(self._north.variance + self._east.variance),
                end_m=self._last.horizontal_m,
                inside_95=self._inside.value,
            ),
            height_rmse_m=math.sqrt(self._height.square),
            velocity_rmse_mps=math.sqrt(self._speed.square),
            velocity_p95_mps=self._speeds.quantile(0.95),
            heading=HeadingReport(
                rmse_deg=math.sqrt(self._heading.variance),
                p95_deg=self._headings.quantile_of_distance(0.95, self._heading.value),
                offset_deg=wrapped(self._first_yaw + self._heading.value),
            ),
        )
