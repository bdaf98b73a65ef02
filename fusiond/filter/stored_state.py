"""The stored state: what a run leaves for the next one's start, and the text that it is kept as, checked when read."""

from __future__ import annotations

import zlib
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct

from fusiond.config.schema import Config, sensor_tables
from fusiond.filter.state import (
    ACCEL_BIAS,
    ACCEL_BIAS_B,
    ATTITUDE,
    CALIBRATIONS,
    ERROR_SIZE,
    GNSS_ERROR,
    GYRO_BIAS,
    GYRO_BIAS_B,
    NEVER,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    T_STILL,
    WIDE_SIZE,
    FilterState,
    T,
)
from fusiond.maths.rotation import euler, matrix, product
from fusiond.maths.wgs84 import geodetic, mat_ne

VERSION = 3
Variance = Annotated[float, Meta(ge=0, le=1e12)]
Angle = Annotated[float, Meta(ge=-4, le=4)]  # rad
Bias = Annotated[float, Meta(ge=-100, le=100)]  # rad/s, m/s^2
Origin = tuple[
    Annotated[float, Meta(ge=-90, le=90)], Annotated[float, Meta(ge=-360, le=360)], Annotated[float, Meta(ge=-1e6, le=1e6)]
]  # deg, deg, m
ThreeBiases = tuple[Bias, Bias, Bias]
ThreeVariances = tuple[Variance, Variance, Variance]


class StoredStateError(Exception):
    """What is stored cannot be used; the message says why."""


class DamagedStateError(StoredStateError):
    """No run has written it as it is: it is torn or altered."""


class StoredState(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A filter's state at an instant, as far as the next start can use it. SI and radians."""

    version: int
    vehicle: str
    installation: int  # stands for what the configuration says of the sensors: with another, nothing of this holds
    t_ns: int
    at_rest: bool
    latitude: Annotated[float, Meta(ge=-2, le=2)]  # of the IMU
    longitude: Angle
    height: Annotated[float, Meta(ge=-1e6, le=1e6)]
    position_variance: Variance  # horizontal, per axis
    roll: Angle
    pitch: Angle
    yaw: Angle
    yaw_variance: Variance
    gyro_bias: ThreeBiases
    gyro_bias_variance: ThreeVariances
    accel_bias: ThreeBiases
    accel_bias_variance: ThreeVariances
    calibrations: list[Annotated[float, Meta(ge=-1e6, le=1e6)]]  # values of the error states from CALIBRATIONS on
    calibration_variances: list[Variance]
    origin: Origin | None = None  # not the filter's: of the local frame sent to an autopilot
    reset_counter: Annotated[int, Meta(ge=0, le=255)] | None = None  # and the newest number of jumps that it was told of
    checksum: int = 0  # CRC-32 of all the rest


def installation(config: Config) -> int:
    """A number that changes when the configuration of sensors does: what is learnt is learnt against it."""
    parts = ({table: getattr(config, table) for table in sensor_tables()}, config.filter.wheel_scale_by)
    return zlib.crc32(msgspec.json.encode(parts, order="sorted"))


def stored_state(state: FilterState, config: Config) -> StoredState:
    """What to keep of a state that holds nominal values and a covariance."""
    x, covariance, variances = state.nominal, state.covariance, np.maximum(np.diag(state.covariance), 0.0)
    to_n = mat_ne(x[POSITION_E])
    latitude, longitude, height = geodetic(x[POSITION_E])
    roll, pitch, yaw = euler(product(to_n, matrix(x[QUATERNION_EB])))
    spread = product(product(to_n, covariance[POSITION, POSITION]), to_n.T)
    calibrations, kept = x[CALIBRATIONS + 1 : state.size + 1].copy(), variances[CALIBRATIONS:].copy()
    sky = slice(GNSS_ERROR.start - CALIBRATIONS, GNSS_ERROR.stop - CALIBRATIONS)
    calibrations[sky] = kept[sky] = 0.0  # the next start has another sky
    turn = float(to_n[2] @ covariance[ATTITUDE, ATTITUDE] @ to_n[2])
    found = StoredState(
        version=VERSION,
        vehicle=config.vehicle.name,
        installation=installation(config),
        t_ns=int(state.stamps[T]),
        at_rest=bool(state.stamps[T_STILL] != NEVER),
        latitude=latitude,
        longitude=longitude,
        height=height,
        position_variance=max(0.0, float(spread[0, 0] + spread[1, 1]) / 2),
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        yaw_variance=max(0.0, turn),
        gyro_bias=tuple(x[GYRO_BIAS_B].tolist()),
        gyro_bias_variance=tuple(variances[GYRO_BIAS].tolist()),
        accel_bias=tuple(x[ACCEL_BIAS_B].tolist()),
        accel_bias_variance=tuple(variances[ACCEL_BIAS].tolist()),
        calibrations=calibrations.tolist(),
        calibration_variances=kept.tolist(),
    )
    return msgspec.structs.replace(found, checksum=_checksum(found))


def with_frame(stored: StoredState, origin: Origin | None, reset_counter: int | None) -> StoredState:
    """The same with the local frame of an autopilot."""
    framed = msgspec.structs.replace(stored, origin=origin, reset_counter=reset_counter)
    return msgspec.structs.replace(framed, checksum=_checksum(framed))


def to_text(stored: StoredState) -> bytes:
    """As it is written to a file: JSON, a key a line."""
    return msgspec.json.format(msgspec.json.encode(stored), indent=1) + b"\n"


def from_text(text: bytes) -> StoredState:
    """Read what `to_text` made. Raises StoredStateError; DamagedStateError where it is damaged."""
    try:
        version = msgspec.json.decode(text, type=_Versioned).version
        if version != VERSION:
            raise StoredStateError(f"its version is {version}, not {VERSION}")
        stored = msgspec.json.decode(text, type=StoredState)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DamagedStateError(f"torn or altered: {error}") from error
    if stored.checksum != _checksum(stored):
        raise DamagedStateError("torn or altered: its checksum is wrong")
    sizes = len(stored.calibrations), len(stored.calibration_variances)
    if sizes[0] != sizes[1] or sizes[0] not in (ERROR_SIZE - CALIBRATIONS, WIDE_SIZE - CALIBRATIONS):
        raise DamagedStateError(f"torn or altered: it has {sizes[0]} calibrations and {sizes[1]} variances of them")
    return stored


def check(stored: StoredState, config: Config, t_ns: int | None = None) -> None:
    """Raise StoredStateError where a stored state is not for this configuration; or not for this instant, if given."""
    if stored.vehicle != config.vehicle.name:
        raise StoredStateError(f"it is of the vehicle '{stored.vehicle}'")
    if stored.installation != installation(config):
        raise StoredStateError("the sensors are configured otherwise than they were")
    if t_ns is None:
        return
    age_s = (t_ns - stored.t_ns) / 1e9
    if age_s < 0:
        raise StoredStateError(f"it is from the future, by {-age_s:.0f} s")
    if age_s > config.state.max_age_s:
        raise StoredStateError(f"it is {age_s / 3600:.1f} h old")


class _Versioned(Struct):
    version: int


def _checksum(stored: StoredState) -> int:
    return zlib.crc32(msgspec.json.encode(msgspec.structs.replace(stored, checksum=0)))
