"""The posterior Cramer-Rao bound of a drive: the Riccati recursion linearised at the true trajectory with the true noise.

For a system with additive Gaussian noise Tichavsky, Muravchik, Nehorai (1998), equation 21, is the covariance recursion of
the Kalman filter with Jacobians at the truth. The transition and its noise are computed here apart from the filter's own;
the Jacobians of the measurements are the models', which tests hold to finite differences. The gyro's noise on the lever arms
counts as noise of the measurement, as if it were another than that which the attitude integrates.
"""

from __future__ import annotations

import numpy as np

from benchmarks.study.runs import start_covariance, true_state
from benchmarks.study.world import T0, WHEEL_PHASE_S, World
from fusiond.config.schema import Config
from fusiond.filter import gnss_error
from fusiond.filter.motion_constraints import NON_HOLONOMIC
from fusiond.filter.observations import CONSTRAINTS, IMU, MODEL, MODELS
from fusiond.filter.observations.model import Observation, with_rate_noise
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    ACCEL_BIAS,
    ATTITUDE,
    ERROR_SIZE,
    GYRO_BIAS,
    MEAN_RATE_B,
    NEVER,
    POSITION,
    QUATERNION_EB,
    RATE_B,
    RATE_VARIANCE,
    SCALE,
    T_GNSS_ERROR,
    VELOCITY,
    VELOCITY_E,
    T,
)
from fusiond.maths.portable import square
from fusiond.maths.rotation import quaternion, skew
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import EARTH_RATE, MU
from fusiond.units import nanoseconds

EARTH_SKEW = skew(np.array([0.0, 0.0, EARTH_RATE]))


def dynamics(world: World, k: int) -> Array:
    """F (n, n) of the error's differential equation between the k-th instant and the next."""
    f = np.zeros((ERROR_SIZE, ERROR_SIZE))
    mat_eb = (world.mat_eb[k] + world.mat_eb[k + 1]) / 2
    force_e = (world.mat_eb[k] @ world.force_b[k] + world.mat_eb[k + 1] @ world.force_b[k + 1]) / 2
    place = world.position_e[k]
    r2 = float(place @ place)
    f[POSITION, VELOCITY] = np.eye(3)
    f[VELOCITY, POSITION] = MU / r2**1.5 * (3 * np.outer(place, place) / r2 - np.eye(3))
    f[VELOCITY, VELOCITY] = -2 * EARTH_SKEW
    f[VELOCITY, ATTITUDE] = -skew(force_e)
    f[VELOCITY, ACCEL_BIAS] = -mat_eb
    f[ATTITUDE, ATTITUDE] = -EARTH_SKEW
    f[ATTITUDE, GYRO_BIAS] = -mat_eb
    return f


def densities(config: Config) -> Array:
    """Noise densities (n,) of the error state."""
    (unit,) = config.imu.values()
    found = np.zeros(ERROR_SIZE)
    found[VELOCITY], found[ATTITUDE] = square(unit.accel_noise), square(unit.gyro_noise)
    found[ACCEL_BIAS], found[GYRO_BIAS] = square(unit.accel_bias_walk), square(unit.gyro_bias_walk)
    found[SCALE] = square(config.filter.wheel_scale_walk) if config.filter.wheel_scale_sigma else 0.0
    return found


def carried(p: Array, f: Array, density: Array, dt: float) -> Array:
    """The covariance dt later; the noise is integrated by Simpson's rule."""

    def transition(h: float) -> Array:
        step = f * h
        return np.eye(ERROR_SIZE) + step + step @ step / 2 + step @ step @ step / 6

    whole, half = transition(dt), transition(dt / 2)
    noise = np.diag(density) + 4 * (half * density) @ half.T + (whole * density) @ whole.T
    return np.asarray(whole @ p @ whole.T + noise * (dt / 6))


def updated(p: Array, seen: Observation) -> Array:
    _, jacobian, variance = seen.trimmed()
    across, noise = p @ jacobian.T, np.diag(variance) + np.outer(seen.common[: seen.m], seen.common[: seen.m])
    gain = np.linalg.solve(jacobian @ across + noise, across.T).T
    keep = np.eye(len(p)) - gain @ jacobian
    p = keep @ p @ keep.T + gain @ noise @ gain.T
    return np.asarray((p + p.T) / 2)


class Bound:
    """The recursion over one world, with the measurements that its configuration has."""

    def __init__(self, world: World, wheel_hz: float, gnss_from: float = 0.0, gnss_until: float = np.inf) -> None:
        self.world, self.config = world, world.config
        self.params = make_parameters(self.config)
        gnss = next(iter(self.config.gnss.values()))
        fixes = world.times(gnss.interval_s, 0.0)
        self.events = [(t, "gnss") for t in fixes if gnss_from - 1e-9 <= t < gnss_until]
        self.events += [(t, "wheel") for t in world.times(1 / wheel_hz, WHEEL_PHASE_S)] if self.config.wheel else []
        if self.config.motion.non_holonomic:
            self.events += [(t, "constraint") for t in world.times(self.config.motion.interval_s, 0.0)[1:]]
        self.events.sort()
        self.carried_ns = NEVER  # instant of the slow error of GNSS positions

    def run(self, looks: list[float]) -> Array:
        """Covariances (looks, n, n), each after all measurements stamped up to its time [s]."""
        world, density = self.world, densities(self.config)
        p, now, found = start_covariance(world, self.params), 0.0, []
        stops = sorted([*self.events, *((t + 1e-9, "look") for t in looks), *((t, "sample") for t in world.t[1:])])
        f = dynamics(world, 0)
        for t, what in stops:
            if t > now + 1e-12:
                k = min(int(now * world.sensor.rate_hz + 1e-6), len(world.t) - 2)
                f = dynamics(world, k)
                if what != "look":
                    p, now = carried(p, f, density, t - now), t
            if what == "look":
                found.append(p)
            elif what != "sample":
                p = self.measured(p, t, what)
        return np.array(found)

    def measured(self, p: Array, t: float, what: str) -> Array:
        """The covariance after all measurements of a kind at one instant."""
        world = self.world
        k = min(round(t * world.sensor.rate_hz), len(world.t) - 1)
        state = true_state(world, k, self.params)
        if what == "wheel":  # beside the IMU's instants
            at = np.array([t])
            kinematics = world.kinematics(at)
            to_n = world.mat_ne[k]
            state.nominal[VELOCITY_E] = to_n.T @ kinematics.velocity_n[0]
            state.nominal[QUATERNION_EB] = quaternion(to_n.T @ kinematics.mat_nb[0])
            state.auxiliary[RATE_B] = state.auxiliary[MEAN_RATE_B] = kinematics.rate_nb_b[0] + world.gyro_bias[k]
        between = t * world.sensor.rate_hz % 1.0 if what == "wheel" else 0.0  # two samples are interpolated
        density = square(self.params.imu.gyro_noise) * world.sensor.rate_hz
        state.auxiliary[RATE_VARIANCE] = density * ((1 - between) ** 2 + between**2)
        state.covariance[:] = p
        if what == "constraint":
            parameter = self.params.constraints[NON_HOLONOMIC]
            seen = Observation(state.size)
            if not CONSTRAINTS[NON_HOLONOMIC].observe(state, parameter, parameter, seen):
                return p
            with_rate_noise(state, seen)
            return updated(p, seen)
        for source, number in enumerate(self.params.models):
            if number == IMU or (number == MODEL["wheel_speed"]) != (what == "wheel"):
                continue
            seen, row = Observation(state.size), self.row(number, source)
            if number == MODEL["gnss_position"]:
                state.covariance[:] = p
                state.stamps[T], state.stamps[T_GNSS_ERROR] = T0 + nanoseconds(t), self.carried_ns
                gnss_error.carry(state, source, row, self.params)
                p, self.carried_ns = state.covariance.copy(), int(state.stamps[T])
            is_seen = MODELS[number].observe(state, row, self.params.model_parameters[source], seen)
            assert is_seen
            with_rate_noise(state, seen)
            p = updated(p, seen)
        return p

    def row(self, number: int, source: int) -> Array:
        """A measurement's row with its variances; the reading itself does not matter to the Jacobian."""
        row = np.zeros(8)
        gnss = next(iter(self.config.gnss.values()))
        if number == MODEL["gnss_position"]:
            row[3:5] = square(gnss.position_sigma_m), square(gnss.height_sigma_m)
        elif number == MODEL["gnss_velocity"]:
            row[3:5] = square(gnss.velocity_sigma_mps), 3.0
        else:
            row[1] = square(self.config.wheel[self.params.sources[source]].sigma_mps)
        return row
