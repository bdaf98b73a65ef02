"""The state as MAVLink messages for an autopilot's estimator and for a ground station, and texts. No I/O.

Positions are relative to a fixed origin. North and east are metres in the projection that the receiver itself uses to
convert metres back to latitude and longitude: ArduPilot's and PX4's spheres differ from the ellipsoid by up to 3 m per
kilometre, and the receiver must get the latitude and longitude of the state. Down is the difference of heights, not the
third axis of a tangent plane, which at 10 km is off by 8 m. Velocity and attitude are in north-east-down at the vehicle.
`fusiond.messages.local_frame` has the tangent plane.

Angles in covariances are small errors of roll, pitch and yaw, as MAVLink defines them, not rotations about north, east,
down. The state has no correlation between position, velocity and attitude: such elements are zero.

Stamps are those of the state: Unix time on the host's time line, the clock that answers TIMESYNC. PX4 converts stamps by
its TIMESYNC offset (mavlink_receiver.cpp, Timesync.cpp), ArduPilot by the least lag it sees (JitterCorrection.cpp): both
expect the sender's own clock, and a step from one time base to another would cost them that offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from fusiond.estimator.solution import Mode
from fusiond.maths.rotation import matrix
from fusiond.maths.wgs84 import normal_gravity, radii
from fusiond.messages.types import Block, State, StateMessage
from fusiond.units import MICROSECOND, MILLISECOND, SECOND

Array = NDArray[np.float64]

ARDUPILOT_M_PER_DEG = 0.011131884502145034e7  # LOCATION_SCALING_FACTOR, Location.h
ARDUPILOT_MIN_SCALE = 0.01  # Location::longitude_scale
PX4_EARTH_RADIUS = 6_371_000.0  # m, CONSTANTS_RADIUS_OF_EARTH, geo.h
MIN_PITCH_COSINE = 0.1  # of pitch: roll and yaw lose their meaning beyond 84 degrees
GPS_EPOCH_S = 315_964_800  # Unix time of GPS time 0
LEAP_SECONDS = 18  # GPS time less UTC, since 2017
WEEK_MS = 7 * 24 * 3600 * 1000
ASSUMED_SATELLITES = 10  # GPS_INPUT asks for a number; ArduPilot's EKF wants six
NORTH_CDEG = 36_000  # a yaw of north in GPS_INPUT, where 0 is unknown
TEXT_BYTES = 50  # of STATUSTEXT


class Origin(NamedTuple):
    """Origin of the local frame."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    @classmethod
    def of(cls, state: State) -> Origin:
        """At a state."""
        return cls(state.lat_deg, state.lon_deg, state.height_m)


Projection = Callable[[Origin, float, float], tuple[float, float]]
"""Metres north and east of an origin, of latitude and longitude [deg]."""


def ardupilot_projection(origin: Origin, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """ArduPilot's projection (Location::get_distance_NE, offset_latlng)."""
    middle = math.radians((latitude_deg + origin.latitude_deg) / 2)
    scale = max(math.cos(middle), ARDUPILOT_MIN_SCALE)
    east_deg = _half_turn(longitude_deg - origin.longitude_deg)
    return (latitude_deg - origin.latitude_deg) * ARDUPILOT_M_PER_DEG, east_deg * ARDUPILOT_M_PER_DEG * scale


def px4_projection(origin: Origin, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """PX4's azimuthal equidistant projection (MapProjection::project, geo.cpp)."""
    latitude, origin_latitude = math.radians(latitude_deg), math.radians(origin.latitude_deg)
    turn = math.radians(longitude_deg - origin.longitude_deg)
    north = math.cos(origin_latitude) * math.sin(latitude) - math.sin(origin_latitude) * math.cos(latitude) * math.cos(turn)
    east = math.cos(latitude) * math.sin(turn)
    along = math.sin(origin_latitude) * math.sin(latitude) + math.cos(origin_latitude) * math.cos(latitude) * math.cos(turn)
    sine = math.hypot(north, east)
    stretch = PX4_EARTH_RADIUS * (math.atan2(sine, along) / sine if sine > 0 else 1.0)
    return north * stretch, east * stretch


def ellipsoid_projection(origin: Origin, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """True metres along meridian and parallel, by the radii of WGS-84 half way."""
    middle = math.radians((latitude_deg + origin.latitude_deg) / 2)
    meridian, transverse = radii(middle)
    north = math.radians(latitude_deg - origin.latitude_deg) * (meridian + origin.height_m)
    east = math.radians(_half_turn(longitude_deg - origin.longitude_deg)) * (transverse + origin.height_m)
    return north, east * math.cos(middle)


def local_position(state: State, origin: Origin, project: Projection) -> tuple[float, float, float]:
    """North, east, down [m] from the origin."""
    return (*project(origin, state.lat_deg, state.lon_deg), origin.height_m - state.height_m)


# --- For an autopilot


class Conventions(NamedTuple):
    """What one kind of autopilot expects of its messages."""

    local_frame: int  # MAV_FRAME of ODOMETRY's pose: the axes are north, east, down in either
    project: Projection


CONVENTIONS = {
    # any other pair of frames is dropped silently (GCS_Common.cpp, handle_odometry)
    "ardupilot": Conventions(common.MAV_FRAME_LOCAL_FRD, ardupilot_projection),
    # LOCAL_FRD is accepted too, but as a frame of arbitrary heading (mavlink_receiver.cpp, VehicleOdometry.msg)
    "px4": Conventions(common.MAV_FRAME_LOCAL_NED, px4_projection),
}


def odometry(
    message: StateMessage, state: State, origin: Origin, conventions: Conventions, quality: int, reset_counter: int
) -> Any:
    """ODOMETRY: pose in the local frame, velocity and angular rate in body axes. `quality` is 1 to 100."""
    mat_nb = matrix(np.array(state.quaternion_nb))
    twist = mat_nb.T @ _square(state.covariance_velocity_m2ps2) @ mat_nb
    rates = np.diag(np.square(state.sigma_gyro_bias_rps))  # nothing more is known about them
    return common.MAVLink_odometry_message(
        message.t_ns // MICROSECOND, conventions.local_frame, common.MAV_FRAME_BODY_FRD,
        *local_position(state, origin, conventions.project), list(state.quaternion_nb),
        *(mat_nb.T @ state.velocity_ned_mps).tolist(), *state.angular_rate_b_rps,
        _upper(_square(state.covariance_position_m2), _euler_covariance(state)), _upper(twist, rates),
        reset_counter, common.MAV_ESTIMATOR_TYPE_VIO, quality)  # fmt: skip


def vision_position(
    message: StateMessage, state: State, origin: Origin, conventions: Conventions, reset_counter: int
) -> Any:
    """VISION_POSITION_ESTIMATE."""
    covariance = _upper(_square(state.covariance_position_m2), _euler_covariance(state))
    return common.MAVLink_vision_position_estimate_message(
        message.t_ns // MICROSECOND, *local_position(state, origin, conventions.project), *_euler(state), covariance,
        reset_counter,
    )


def gps_input(message: StateMessage, state: State, geoid_m: float, gps_id: int) -> Any:
    """GPS_INPUT of a receiver with two antennas. Its dilutions of precision are the sigmas of position, at 1 m each."""
    week, week_ms = divmod(message.t_ns // MILLISECOND + (LEAP_SECONDS - GPS_EPOCH_S) * 1000, WEEK_MS)
    north, east, down = state.sigma_position_ned_m
    horizontal = max(north, east)
    return common.MAVLink_gps_input_message(
        message.t_ns // MICROSECOND, gps_id, 0, week_ms, week, 3,
        _e7(state.lat_deg), _e7(state.lon_deg), state.height_m - geoid_m, horizontal, down,
        *state.velocity_ned_mps, state.sigma_velocity_mps, horizontal, down, ASSUMED_SATELLITES,
        round(state.yaw_deg % 360 * 100) or NORTH_CDEG)  # fmt: skip


def set_origin(message: StateMessage, origin: Origin, geoid_m: float, system: int) -> Any:
    """SET_GPS_GLOBAL_ORIGIN."""
    height_mm = round((origin.height_m - geoid_m) * 1e3)
    return common.MAVLink_set_gps_global_origin_message(
        system, _e7(origin.latitude_deg), _e7(origin.longitude_deg), height_mm, message.t_ns // MICROSECOND
    )


# --- For a ground station


def global_position(message: StateMessage, state: State, origin: Origin, geoid_m: float) -> Any:
    """GLOBAL_POSITION_INT_COV. Its covariance is of metres north, east and up, then of the velocity."""
    up = np.diag((1.0, 1.0, -1.0))
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = up @ _square(state.covariance_position_m2) @ up
    covariance[3:, 3:] = _square(state.covariance_velocity_m2ps2)
    return common.MAVLink_global_position_int_cov_message(
        message.t_ns // MICROSECOND, common.MAV_ESTIMATOR_TYPE_GPS_INS, _e7(state.lat_deg), _e7(state.lon_deg),
        round((state.height_m - geoid_m) * 1e3), round((state.height_m - origin.height_m) * 1e3),
        *state.velocity_ned_mps, covariance.ravel().tolist())  # fmt: skip


def local_position_ned(message: StateMessage, state: State, origin: Origin) -> Any:
    """LOCAL_POSITION_NED_COV. The variances of the acceleration are those of the accelerometer's bias."""
    mat_nb = matrix(np.array(state.quaternion_nb))
    gravity = normal_gravity(math.sin(math.radians(state.lat_deg)), state.height_m)
    acceleration_n = mat_nb @ state.acceleration_b_mps2 + (0.0, 0.0, gravity)
    bias = mat_nb @ np.diag(np.square(state.sigma_accel_bias_mps2)) @ mat_nb.T
    blocks = (_square(state.covariance_position_m2), _square(state.covariance_velocity_m2ps2), bias)
    return common.MAVLink_local_position_ned_cov_message(
        message.t_ns // MICROSECOND, common.MAV_ESTIMATOR_TYPE_GPS_INS, *local_position(state, origin, ellipsoid_projection),
        *state.velocity_ned_mps, *acceleration_n.tolist(), _upper(*blocks))  # fmt: skip


def attitude_quaternion(message: StateMessage, state: State) -> Any:
    """ATTITUDE_QUATERNION_COV."""
    return common.MAVLink_attitude_quaternion_cov_message(
        message.t_ns // MICROSECOND, list(state.quaternion_nb), *state.angular_rate_b_rps,
        _euler_covariance(state).ravel().tolist(),
    )


class Ratios(NamedTuple):
    """Largest ratio of innovation to gate over the sources; not a number where there is none."""

    velocity: float = math.nan
    horizontal: float = math.nan
    vertical: float = math.nan


def estimator_status(message: StateMessage, ratios: Ratios) -> Any:
    """ESTIMATOR_STATUS. Without a state no flag is set, and the accuracies are not numbers."""
    flags = 0
    horizontal = vertical = math.nan
    if message.state is not None:
        north, east, vertical = message.state.sigma_position_ned_m
        horizontal = math.hypot(north, east)
        flags = common.ESTIMATOR_ATTITUDE | common.ESTIMATOR_VELOCITY_HORIZ | common.ESTIMATOR_VELOCITY_VERT
        flags |= common.ESTIMATOR_POS_HORIZ_REL | common.ESTIMATOR_PRED_POS_HORIZ_REL
        if message.mode is not Mode.LOST:
            flags |= common.ESTIMATOR_POS_HORIZ_ABS | common.ESTIMATOR_POS_VERT_ABS | common.ESTIMATOR_PRED_POS_HORIZ_ABS
    return common.MAVLink_estimator_status_message(
        message.t_ns // MICROSECOND, flags, *ratios, math.nan, math.nan, math.nan, horizontal, vertical
    )


def marker(message: StateMessage, state: State, origin: Origin, geoid_m: float) -> Any:
    """GLOBAL_POSITION_INT. Only for a system id of its own: with the vehicle's it would be mistaken for the
    autopilot's."""
    velocity = [round(component * 100) for component in state.velocity_ned_mps]
    return common.MAVLink_global_position_int_message(
        message.t_ns // MILLISECOND & 0xFFFFFFFF, _e7(state.lat_deg), _e7(state.lon_deg),
        round((state.height_m - geoid_m) * 1e3), round((state.height_m - origin.height_m) * 1e3),
        *velocity, round(state.yaw_deg % 360 * 100) % NORTH_CDEG)  # fmt: skip


def status_texts(severity: int, text: str, number: int) -> Iterator[Any]:
    """STATUSTEXT, in as many chunks as needed. `number`, from 1 to 65535, marks the chunks of one text.

    A chunk with a zero in it is the last. If the text fills all chunks, an empty one follows.
    """
    data = text.encode("ascii", "replace")
    if len(data) <= TEXT_BYTES:
        yield common.MAVLink_statustext_message(severity, data, 0, 0)
        return
    for chunk, start in enumerate(range(0, len(data) + 1, TEXT_BYTES)):
        yield common.MAVLink_statustext_message(severity, data[start : start + TEXT_BYTES], number, chunk)


# --- Numbers


class RateLimiter:
    """Limits messages to a rate, by their stamps."""

    def __init__(self, rate_hz: float) -> None:
        """A rate of 0 lets no message through."""
        self.rate_hz = rate_hz
        self._due_ns: int | None = None

    def due(self, t_ns: int) -> bool:
        """Whether a message is due at this instant; if so, it counts as sent."""
        if self.rate_hz <= 0 or (self._due_ns is not None and t_ns < self._due_ns):
            return False
        period = round(SECOND / self.rate_hz)
        late = self._due_ns is None or t_ns - self._due_ns > period
        self._due_ns = (t_ns if late or self._due_ns is None else self._due_ns) + period
        return True


def _euler(state: State) -> tuple[float, float, float]:
    return math.radians(state.roll_deg), math.radians(state.pitch_deg), math.radians(state.yaw_deg)


def _euler_covariance(state: State) -> Array:
    """Covariance (3, 3) of roll, pitch and yaw [rad^2] from that of small rotations about north, east, down."""
    _, pitch, yaw = _euler(state)
    cosine = max(math.cos(pitch), MIN_PITCH_COSINE)
    sine_yaw, cosine_yaw, sine_pitch = math.sin(yaw), math.cos(yaw), math.sin(pitch)
    roll = (cosine_yaw / cosine, sine_yaw / cosine, 0.0)
    jacobian = np.array([roll, (-sine_yaw, cosine_yaw, 0.0), (roll[0] * sine_pitch, roll[1] * sine_pitch, 1.0)])
    covariance: Array = jacobian @ _square(state.covariance_attitude_rad2) @ jacobian.T
    return covariance


def _square(block: Block) -> Array:
    return np.array(block).reshape(3, 3)


def _upper(*blocks: Array) -> list[float]:
    """The upper triangle, row by row, of the covariance with these blocks (3, 3) on its diagonal."""
    size = 3 * len(blocks)
    whole = np.zeros((size, size))
    for number, block in enumerate(blocks):
        whole[3 * number : 3 * number + 3, 3 * number : 3 * number + 3] = block
    upper: list[float] = whole[np.triu_indices(size)].tolist()
    return upper


def _e7(degrees: float) -> int:
    return round(degrees * 1e7)


def _half_turn(degrees: float) -> float:
    return math.remainder(degrees, 360.0)
