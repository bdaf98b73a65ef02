"""The simulated GNSS receiver: noise, fix types, smoothed velocity, outages, jumps, a spoofer, a frozen fix; wire units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.typed import Array
from fusiond.simulation.scenario import FixType, Gnss, Scenario
from fusiond.simulation.trajectory import Trajectory, turned
from fusiond.simulation.transport import Mask, within
from fusiond.simulation.wgs84 import shifted, wrapped

Integers = NDArray[np.int64]
LAG_POINTS = 8  # instants over which the smoothed velocity is a mean
FIX_3D, FIX_NONE = 3, 1  # GPS_FIX_TYPE
FIX_TYPES: dict[FixType, int] = {"single": FIX_3D, "dgps": 4, "float": 5, "fixed": 6}
HEIGHT_FACTOR = 2.0  # how much worse heights are, by quality
UNKNOWN_16 = 65535


@dataclass(frozen=True, slots=True)
class Fixes:
    """N fixes in the units of GPS_RAW_INT; vel_acc [mm/s] is the same for all."""

    fix_type: Integers
    lat: Integers  # 1e-7 deg
    lon: Integers  # 1e-7 deg
    alt: Integers  # mm above mean sea level
    alt_ellipsoid: Integers  # mm
    vel: Integers  # cm/s
    cog: Integers  # 1e-2 deg
    h_acc: Integers  # mm
    v_acc: Integers  # mm
    vel_acc: int


def antenna(trajectory: Trajectory, gnss: Gnss, t: Array) -> tuple[tuple[Array, Array, Array], Array]:
    """True position [rad, rad, m] and velocity (N, 3) [m/s] of the antenna at the times `t` [s]."""
    lever_b = trajectory.lever_b(gnss.antenna_m)
    kinematics = trajectory.kinematics(t)
    offset_n = turned(kinematics.mat_nb, np.broadcast_to(lever_b, (len(t), 3)))
    swing_n = turned(kinematics.mat_nb, np.cross(kinematics.rate_nb_b, lever_b))
    return shifted(*trajectory.position(t), offset_n), kinematics.velocity_n + swing_n


def gauss_markov(count: int, interval: float, correlation: float, random: np.random.Generator) -> Array:
    """Stationary first-order Gauss-Markov noise (N, 3) of unit variance."""
    keep = np.exp(-interval / correlation)
    draws = random.standard_normal((count, 3))
    draws[1:] *= np.sqrt(1 - keep * keep)
    for k in range(1, count):
        draws[k] += keep * draws[k - 1]
    return draws


def measure(
    scenario: Scenario,
    trajectory: Trajectory,
    t: Array,
    randoms: tuple[np.random.Generator, np.random.Generator, np.random.Generator, np.random.Generator],
) -> Fixes:
    """The fixes of the instants `t` (N,) [s]. The generators are those of white, drifting and velocity noise, and of the
    biases by quality."""
    gnss = scenario.gnss
    place, _ = antenna(trajectory, gnss, t)
    velocity = smoothed_velocity(trajectory, gnss, t)
    kind = qualities(gnss, t, randoms[3])
    error_n = randoms[0].standard_normal((len(t), 3)) * kind.white
    error_n += gauss_markov(len(t), 1 / gnss.rate_hz, gnss.correlation_s, randoms[1]) * kind.drift + kind.bias
    velocity = velocity + velocity_noise(gnss, len(t), randoms[2]) * gnss.velocity_sigma_mps
    for jump in gnss.jump:
        error_n[within(t, [(jump.start_s, jump.stop_s)])] += jump.offset_m
    for spoof in gnss.spoof:
        caught = within(t, [(spoof.start_s, spoof.stop_s)])
        error_n[caught] += np.outer(t[caught] - spoof.start_s, spoof.rate_mps)
        velocity[caught] += spoof.rate_mps
    held = last_before(t, within(t, gnss.frozen_s))
    place = (place[0][held], place[1][held], place[2][held])
    kind = replace(kind, fix_type=kind.fix_type[held], sigma=kind.sigma[held])
    return _wire(gnss, shifted(*place, error_n[held]), velocity[held], within(t, gnss.no_fix_s), kind)


@dataclass(frozen=True, slots=True)
class Kind:
    """What N fixes are worth: their type, the sigmas [m] (N, 3) of white and drifting noise, the bias, and all in one."""

    fix_type: Integers
    white: Array
    drift: Array
    bias: Array
    sigma: Array


def qualities(gnss: Gnss, t: Array, random: np.random.Generator) -> Kind:
    """The fixes' worth at the times `t` (N,) [s]."""
    fix_type: Integers = np.full(len(t), FIX_3D)
    white = np.tile([gnss.sigma_m, gnss.sigma_m, gnss.height_sigma_m], (len(t), 1))
    drift = np.tile([gnss.drift_sigma_m, gnss.drift_sigma_m, gnss.height_drift_sigma_m], (len(t), 1))
    bias, sigma = np.zeros((len(t), 3)), np.hypot(white, drift)
    weight = np.array([1.0, 1.0, HEIGHT_FACTOR])
    for quality in gnss.quality:
        drawn, after = random.standard_normal(3), t >= quality.start_s
        fix_type[after] = FIX_TYPES[quality.fix]
        white[after], drift[after] = quality.sigma_m * weight, 0.0
        bias[after] = drawn * quality.bias_sigma_m * weight
        sigma[after] = np.hypot(quality.sigma_m, quality.bias_sigma_m) * weight
    return Kind(fix_type, white, drift, bias, sigma)


def velocity_noise(gnss: Gnss, count: int, random: np.random.Generator) -> Array:
    """Noise (N, 3) of unit variance, white or alike for a while."""
    if gnss.velocity_correlation_s:
        return gauss_markov(count, 1 / gnss.rate_hz, gnss.velocity_correlation_s, random)
    return random.standard_normal((count, 3))


def smoothed_velocity(trajectory: Trajectory, gnss: Gnss, t: Array) -> Array:
    """Velocity (N, 3) [m/s] of the antenna, a mean over the time 2 x lag before."""
    if gnss.velocity_lag_ms == 0:
        return antenna(trajectory, gnss, t)[1]
    window = 2e-3 * gnss.velocity_lag_ms
    points = [antenna(trajectory, gnss, t - window * (k + 0.5) / LAG_POINTS)[1] for k in range(LAG_POINTS)]
    return sum(points[1:], points[0]) / LAG_POINTS


def last_before(t: Array, frozen: Mask) -> Integers:
    """Index (N,) of the fix that each message repeats: its own, but that of the last one before while frozen."""
    own = np.where(frozen, 0, np.arange(len(t)))
    return np.maximum.accumulate(own)


def _wire(gnss: Gnss, place: tuple[Array, Array, Array], velocity: Array, no_fix: Mask, kind: Kind) -> Fixes:
    def whole(values: Array) -> Integers:
        return np.where(no_fix, 0, np.rint(values).astype(np.int64))

    ellipsoid = place[2] * 1000
    course = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0])) % 360
    accuracy = np.rint(kind.sigma * 1000).astype(np.int64) * gnss.report_accuracy
    return Fixes(
        fix_type=np.where(no_fix, FIX_NONE, kind.fix_type),
        lat=whole(np.degrees(place[0]) * 1e7),
        lon=whole(np.degrees(wrapped(place[1])) * 1e7),
        alt=whole(ellipsoid - gnss.geoid_m * 1000),
        alt_ellipsoid=whole(ellipsoid),
        vel=np.where(no_fix, UNKNOWN_16, np.rint(np.hypot(velocity[:, 0], velocity[:, 1]) * 100).astype(np.int64)),
        cog=np.where(no_fix, UNKNOWN_16, np.rint(course * 100).astype(np.int64) % 36000),
        h_acc=accuracy[:, 0],
        v_acc=accuracy[:, 2],
        vel_acc=round(gnss.velocity_sigma_mps * 1000) if gnss.report_accuracy else 0,
    )
