"""Comparison of published states with a reference track ("truth"), in constant memory for any length of drive."""

from __future__ import annotations

import math
from typing import NamedTuple

from msgspec import Struct

from fusiond.app.replay.statistics import Histogram, Mean
from fusiond.app.replay.truth import TruthSample, displacement, wrapped
from fusiond.maths.statistics import chi_square
from fusiond.messages.types import State, StateMessage
from fusiond.units import SECOND

USUAL_SHARE = 0.68  # of the errors, by which makers of receivers give an accuracy
ELLIPSE_95 = chi_square(0.95, 2)  # squared Mahalanobis distance of the 95 % ellipse: 5.99

POSITION_STEP, POSITION_LIMIT = 1e-3, 1000.0  # m, width and limit of the histogram's bins
SPEED_STEP, SPEED_LIMIT = 1e-3, 100.0  # m/s
ANGLE_STEP, ANGLE_LIMIT = 1e-3, 180.0  # deg


class Errors(NamedTuple):
    """Published less true values at one instant."""

    north_m: float
    east_m: float
    height_m: float
    velocity_mps: float  # horizontal, magnitude
    yaw_deg: float  # wrapped
    nees: float  # squared horizontal position error in units of the published covariance; infinite if that is singular
    true: TruthSample
    pitch_deg: float = math.nan  # not a number where the truth has none
    roll_deg: float = math.nan

    @property
    def horizontal_m(self) -> float:
        return math.hypot(self.north_m, self.east_m)

    @property
    def inside(self) -> bool:
        """Whether the horizontal position error lies in the 95 % ellipse of the published covariance."""
        return self.nees <= ELLIPSE_95


def errors_of(message: StateMessage, true: TruthSample | None) -> Errors | None:
    """The errors of a published state; None if there is no state or no truth."""
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
        _mahalanobis2(north, east, state),
        true,
        state.pitch_deg - true.pitch_deg,
        wrapped(state.roll_deg - true.roll_deg),
    )


def _mahalanobis2(north: float, east: float, state: State) -> float:
    """Squared horizontal error in units of the published covariance; infinite if that is singular."""
    nn, ne, _, _, ee, *_ = state.covariance_position_m2
    determinant = nn * ee - ne * ne
    if determinant <= 0:
        return math.inf
    return (ee * north * north - 2 * ne * north * east + nn * east * east) / determinant


class PositionReport(Struct, frozen=True, kw_only=True):
    """Horizontal position error, published less true [m]."""

    rmse_m: float
    p68_m: float
    p95_m: float
    max_m: float
    offset_north_m: float  # the mean error
    offset_east_m: float
    rmse_offset_removed_m: float
    end_m: float  # in the last state
    inside_95: float  # share of states inside the 95 % ellipse of the published covariance: 0.95 or more is honest
    nees: float | None = None  # mean squared error in units of the published covariance: 2 is honest; null: one is singular


class AngleReport(Struct, frozen=True, kw_only=True):
    """Error of an angle [deg], its mean removed: the truth's axes and the IMU's need not be the same."""

    rmse_deg: float
    p68_deg: float
    p95_deg: float
    offset_deg: float  # the mean that was removed


class TruthReport(Struct, frozen=True, kw_only=True):
    """How far the published states lie from the truth, over a window of the drive."""

    start_s: float  # of the first state compared, from the first event
    stop_s: float
    rows: int  # states compared
    distance_m: float  # travelled in the window, by the truth
    position: PositionReport
    height_rmse_m: float
    velocity_rmse_mps: float  # horizontal
    velocity_p68_mps: float
    velocity_p95_mps: float
    heading: AngleReport
    pitch: AngleReport | None = None  # None if the truth has none
    roll: AngleReport | None = None


class Window(NamedTuple):
    """An interval in seconds from the first event, both ends included."""

    start_s: float = 0.0
    stop_s: float = math.inf


class _Angle:
    """Errors of one angle, counted from the first one, so that an offset near 180 deg does not wrap."""

    def __init__(self) -> None:
        self._first = 0.0
        self._mean, self._histogram = Mean(), Histogram(ANGLE_STEP, ANGLE_LIMIT)

    def add(self, error_deg: float) -> None:
        if not self._mean.count:
            self._first = error_deg
        since = wrapped(error_deg - self._first)
        self._mean.add(since)
        self._histogram.add(since)

    def report(self) -> AngleReport | None:
        if not self._mean.count:
            return None
        return AngleReport(
            rmse_deg=math.sqrt(self._mean.variance),
            p68_deg=self._histogram.quantile_of_distance(USUAL_SHARE, self._mean.value),
            p95_deg=self._histogram.quantile_of_distance(0.95, self._mean.value),
            offset_deg=wrapped(self._first + self._mean.value),
        )


class Comparison:
    """Statistics of the errors within a window of the drive."""

    def __init__(self, window: Window | None = None) -> None:
        self._window = window or Window()
        self._north, self._east, self._height = Mean(), Mean(), Mean()
        self._speed, self._inside, self._nees = Mean(), Mean(), Mean()
        self._horizontals = Histogram(POSITION_STEP, POSITION_LIMIT)
        self._speeds = Histogram(SPEED_STEP, SPEED_LIMIT)
        self._heading, self._pitch, self._roll = _Angle(), _Angle(), _Angle()
        self._level_told = False  # a reference without pitch and roll may have zeros for them
        self._start_s = self._stop_s = self._distance = 0.0
        self._last: Errors | None = None

    def add(self, since_start_ns: int, errors: Errors) -> None:
        """Add the errors of one publication; they must come in order of time."""
        second = since_start_ns / SECOND
        if not self._window.start_s <= second <= self._window.stop_s:
            return
        if self._last is None:
            self._start_s = second
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
        self._nees.add(errors.nees)
        self._horizontals.add(errors.horizontal_m)
        self._speeds.add(errors.velocity_mps)
        self._heading.add(errors.yaw_deg)
        if math.isfinite(errors.pitch_deg) and math.isfinite(errors.roll_deg):
            self._level_told = self._level_told or errors.true.pitch_deg != 0 or errors.true.roll_deg != 0
            self._pitch.add(errors.pitch_deg)
            self._roll.add(errors.roll_deg)

    def report(self) -> TruthReport | None:
        """The statistics; None if nothing could be compared."""
        heading = self._heading.report()
        if self._last is None or heading is None:
            return None
        return TruthReport(
            start_s=self._start_s,
            stop_s=self._stop_s,
            rows=self._north.count,
            distance_m=self._distance,
            position=PositionReport(
                rmse_m=math.sqrt(self._north.square + self._east.square),
                p68_m=self._horizontals.quantile(USUAL_SHARE),
                p95_m=self._horizontals.quantile(0.95),
                max_m=self._horizontals.maximum,
                offset_north_m=self._north.value,
                offset_east_m=self._east.value,
                rmse_offset_removed_m=math.sqrt(self._north.variance + self._east.variance),
                end_m=self._last.horizontal_m,
                inside_95=self._inside.value,
                nees=self._nees.value if math.isfinite(self._nees.value) else None,
            ),
            height_rmse_m=math.sqrt(self._height.square),
            velocity_rmse_mps=math.sqrt(self._speed.square),
            velocity_p68_mps=self._speeds.quantile(USUAL_SHARE),
            velocity_p95_mps=self._speeds.quantile(0.95),
            heading=heading,
            pitch=self._pitch.report() if self._level_told else None,
            roll=self._roll.report() if self._level_told else None,
        )
