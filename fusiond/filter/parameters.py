"""The configuration as the filter needs it: numbers in arrays, one row for each source, everything derived once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

import numpy as np

from fusiond.config.schema import Config, Estimate, Filter, Imu, Source, calibrated, wheel_groups
from fusiond.config.sensor import INERTIAL, Stream
from fusiond.filter.measurement_update import correlation_factor
from fusiond.filter.observations import (
    CONSTRAINTS,
    GNSS_VELOCITY,
    IMU,
    MODEL,
    MODELS,
    ON_AXLE,
    WHEEL_SPEED,
    wheel_speed,
)
from fusiond.filter.observations.model import (
    CLUTTER,
    COMPANION,
    CORRELATION,
    LEVER_ARM_B,
    NOISE_MAX,
    NOISE_MIN,
    SHARED,
    empty_row,
)
from fusiond.filter.state import (
    ANTENNA_ERROR,
    CALIBRATIONS,
    DELAYS_ERROR,
    ERROR_SIZE,
    FURTHER_SCALES_ERROR,
    HEIGHT_OFFSET_ERROR,
    INERTIAL_DELAYS_ERROR,
    MOUNT_ERROR,
    SCALE,
    SLIP_ERROR,
    STEERING_FACTOR_ERROR,
    STEERING_OFFSET_ERROR,
    UNDERSTEER_ERROR,
    WIDE_SIZE,
    YAW_RATE_OFFSET_ERROR,
)
from fusiond.filter.stored_state import StoredState
from fusiond.filter.strapdown import ProcessNoise
from fusiond.maths.portable import square
from fusiond.maths.rotation import matrix_from_euler
from fusiond.maths.statistics import chi_square
from fusiond.maths.typed import Array
from fusiond.units import nanoseconds

SENSOR_AXES = slice(0, 9)  # parameters of the inertial sensor: rotation (3, 3) from its axes to the body's, row by row
CREEPING_TIME = 1.0  # s, over which a vehicle that creeps unseen keeps its speed


@dataclass(frozen=True, slots=True)
class Parameters:
    sources: tuple[str, ...]  # sorted by name: the index of a source orders events as its name does
    models: tuple[int, ...]  # of each source: place in MODELS, or IMU
    model_parameters: Array  # (sources, PARAMETERS)
    constraints: Array  # (3, PARAMETERS): non-holonomic, zero velocity, zero rotation
    gates: tuple[float, ...]  # chi-square limit for 0, 1, 2, 3 degrees of freedom
    noise: ProcessNoise
    size: int  # of the error state
    scales: tuple[str, ...]  # names of the wheel scales, by their number
    calibration_variances: Array  # (size - CALIBRATIONS,): first ones
    imu_source: int
    wheels: tuple[int, ...]  # indices of the sources that are wheels
    velocities: tuple[int, ...]  # and of those that are GNSS velocities
    horizon_ns: int
    snapshot_interval_ns: int
    imu_gap_ns: int
    restart_gap_ns: int
    spoof_cost: float  # loss for each metre by which a lying receiver pulls the state
    estimate: int  # place in Estimate: what is published of a mixture
    dead_reckoning_cost: float  # loss for each metre by which dead reckoning drifts off a receiver that was right
    heading_variance: float  # rad^2: the spread of the headings at which the bank is collapsed
    constraint_interval_ns: int
    still_after_ns: int
    standstill: bool  # detect it
    still_wheel: float  # m/s
    still_gyro: float  # rad/s
    still_accel: float  # m/s^2
    non_holonomic: bool
    course_speed: float  # m/s
    zero_velocity_factor: float  # of the variance: a vehicle that creeps keeps its speed
    filter: Filter
    imu: Imu
    stored: StoredState | None  # of an earlier run, for a hot start
    max_stored_age_ns: int


def make_parameters(config: Config, stored: StoredState | None = None) -> Parameters:
    """Lay a configuration out for the kernel, with what an earlier run has stored."""
    streams = config.streams()
    sources = tuple(sorted(streams))
    models = tuple(model_of(streams[source].stream) for source in sources)
    rows = [_parameters(source, sources, config, streams) for source in sources]
    first, walks = _calibrations(config)
    (imu,) = config.imu.values()
    motion, settings = config.motion, config.filter
    return Parameters(
        sources=sources,
        models=models,
        model_parameters=np.array(rows),
        constraints=np.array([constraint.parameters(motion) for constraint in CONSTRAINTS]),
        gates=(math.inf, *(chi_square(settings.gate_probability, freedom) for freedom in (1, 2, 3))),
        noise=ProcessNoise(
            accel=square(imu.accel_noise),
            gyro=square(imu.gyro_noise),
            accel_bias=square(imu.accel_bias_walk),
            gyro_bias=square(imu.gyro_bias_walk),
            calibrations=tuple(walks.tolist()),
        ),
        size=CALIBRATIONS + len(first),
        scales=_scale_names(config),
        calibration_variances=first,
        imu_source=models.index(IMU),
        wheels=tuple(i for i, model in enumerate(models) if model == WHEEL_SPEED),
        velocities=tuple(i for i, model in enumerate(models) if model == GNSS_VELOCITY),
        horizon_ns=nanoseconds(settings.horizon_s),
        snapshot_interval_ns=nanoseconds(settings.snapshot_interval_s),
        imu_gap_ns=nanoseconds(settings.imu_gap_s),
        restart_gap_ns=nanoseconds(settings.restart_gap_s),
        spoof_cost=settings.spoof_cost,
        estimate=get_args(Estimate).index(settings.estimate),
        dead_reckoning_cost=settings.dead_reckoning_cost,
        heading_variance=square(math.radians(settings.heading_spread_deg)),
        constraint_interval_ns=nanoseconds(motion.interval_s),
        still_after_ns=nanoseconds(motion.still_after_s),
        standstill=motion.standstill,
        still_wheel=motion.still_wheel_mps,
        still_gyro=math.radians(motion.still_gyro_deg_s),
        still_accel=motion.still_accel_mps2,
        non_holonomic=motion.non_holonomic,
        course_speed=settings.course_speed_mps,
        zero_velocity_factor=correlation_factor(motion.interval_s, CREEPING_TIME),
        filter=settings,
        imu=imu,
        stored=stored,
        max_stored_age_ns=nanoseconds(config.state.max_age_s),
    )


def model_of(stream: Stream) -> int:
    """The place in MODELS of the model that a stream feeds, or IMU."""
    return IMU if stream.model == INERTIAL else MODEL[stream.model]


def _parameters(source: str, sources: tuple[str, ...], config: Config, streams: dict[str, Source]) -> Array:
    """The row of one source: what its model wants, and what all have."""
    table, name, section, stream, _ = streams[source]
    model = model_of(stream)
    if model == IMU:
        (imu,) = config.imu.values()
        row = empty_row()
        row[SENSOR_AXES] = matrix_from_euler(*(math.radians(angle) for angle in imu.rotation_deg)).ravel()
        return row
    row = MODELS[model].parameters(section)
    if model in ON_AXLE:
        row[LEVER_ARM_B] = config.motion.point_m
    row[CORRELATION] = stream.correlation_s
    row[NOISE_MIN], row[NOISE_MAX] = square(stream.noise_min), square(stream.noise_max)
    row[SHARED] = _shared(table, stream, streams)
    row[CLUTTER] = stream.outlier_share
    if stream.companion is not None:
        row[COMPANION] = sources.index(name + stream.companion)
    if model == WHEEL_SPEED:
        row[wheel_speed.SCALE_STATE] = scale_state(wheel_groups(config)[source])
    return row


def _shared(table: str, stream: Stream, streams: dict[str, Source]) -> float:
    """By what each variance s_i^2 of a group grows so that all of them, fused one by one, are worth no more than their
    shared error s_c allows (THEORY A5): with 1 + s_c^2 sum 1 / s_j^2 they are worth s_c^2 + 1 / sum 1 / s_j^2 together."""
    if stream.group is None:
        return 1.0
    group = [other.stream.sigma for other in streams.values() if (other.table, other.stream.group) == (table, stream.group)]
    return 1 + square(stream.shared_sigma) * sum(1 / square(sigma) for sigma in group)


def _scale_names(config: Config) -> tuple[str, ...]:
    """Of each wheel scale: the one of all, or with the wheels that share it."""
    groups = wheel_groups(config)
    if len(set(groups.values())) < 2:
        return ("wheel_scale",)
    wheels = ["_".join(name for name, group in groups.items() if group == number) for number in sorted(set(groups.values()))]
    return tuple(f"wheel_scale_{names}" for names in wheels)


def scale_state(group: int) -> int:
    """The error state of a group's wheel scale."""
    return SCALE.start if group == 0 else FURTHER_SCALES_ERROR.start + group - 1


def _calibrations(config: Config) -> tuple[Array, Array]:
    """First variances, and random walks squared, of the error states from CALIBRATIONS on: those that are frozen have
    neither. Short where none of the wider state is wanted: it costs time."""
    settings = config.filter
    first, walks = np.zeros(WIDE_SIZE), np.zeros(WIDE_SIZE)
    scales = [scale_state(group) for group in {0, *wheel_groups(config).values()}]
    first[scales] = square(settings.wheel_scale_sigma)
    walks[scales] = square(settings.wheel_scale_walk) if settings.wheel_scale_sigma else 0.0
    first[MOUNT_ERROR] = square(math.radians(settings.mount_sigma_deg))
    walks[MOUNT_ERROR] = square(math.radians(settings.mount_walk_deg)) if settings.mount_sigma_deg else 0.0
    for gnss in filter(calibrated, config.gnss.values()):
        first[ANTENNA_ERROR] = square(gnss.lever_arm_sigma_m)
        first[DELAYS_ERROR] = square(gnss.delay_sigma_ms * 1e-3), square(gnss.velocity_delay_sigma_ms * 1e-3)
    for barometer in config.barometer.values():
        first[HEIGHT_OFFSET_ERROR] = square(barometer.offset_sigma_m)
        walks[HEIGHT_OFFSET_ERROR] = square(barometer.offset_walk_m)
    for imu in config.imu.values():
        first[INERTIAL_DELAYS_ERROR] = square(imu.delay_sigma_ms * 1e-3)
        if imu.delay_sigma_ms and config.motion.non_holonomic:
            first[SLIP_ERROR] = square(math.radians(config.motion.slip_sigma_deg_per_mps2))
    for sensor in config.yaw_rate.values():
        first[YAW_RATE_OFFSET_ERROR] = square(math.radians(sensor.offset_sigma_deg_s))
        walks[YAW_RATE_OFFSET_ERROR] = square(math.radians(sensor.offset_walk_deg_s)) if sensor.offset_sigma_deg_s else 0.0
    for steering in config.steering.values():
        first[STEERING_OFFSET_ERROR] = square(math.radians(steering.offset_sigma_deg) / steering.ratio)
        first[STEERING_FACTOR_ERROR] = square(steering.factor_sigma)
        first[UNDERSTEER_ERROR] = square(math.radians(steering.understeer_sigma_deg_per_mps2))
    wide = first[ERROR_SIZE:].any() or config.yaw_rate or config.steering
    size = WIDE_SIZE if wide else ERROR_SIZE
    return first[CALIBRATIONS:size], walks[CALIBRATIONS:size]
