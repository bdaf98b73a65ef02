"""A drive that matches the filter's model exactly: the vehicle slips as configured for the non-holonomic constraint, every
noise is of the configured size and correlation, biases and scale walk as configured, mount and biases are drawn at random.

The motion is that of `fusiond.simulation`, with a slip on top: velocities sideways and down whose values at the instants
of the constraint are independent draws, joined smoothly in between, felt by the accelerometer and carried into position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusiond.config.schema import Config, Wheel, wheel_groups
from fusiond.events import (
    GnssPosition,
    GnssVelocity,
    ImuSample,
    Measurement,
    Payload,
    SteeringAngle,
    WheelSpeed,
    YawRate,
)
from fusiond.filter.parameters import make_parameters, scale_state
from fusiond.filter.state import (
    ANTENNA_ERROR,
    CALIBRATIONS,
    DELAYS_ERROR,
    MOUNT_ERROR,
    STEERING_FACTOR_ERROR,
    STEERING_OFFSET_ERROR,
    UNDERSTEER_ERROR,
    WIDE_SIZE,
    YAW_RATE_OFFSET_ERROR,
)
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import ECCENTRICITY2
from fusiond.simulation import imu as inertial_sensor
from fusiond.simulation import wgs84
from fusiond.simulation.gnss import gauss_markov
from fusiond.simulation.scenario import Imu, Scenario
from fusiond.simulation.trajectory import Kinematics, Trajectory, blend, turned
from fusiond.simulation.truth import Motion, inertial
from fusiond.units import SECOND, nanoseconds

T0 = 1_760_000_000 * SECOND
WHEEL_PHASE_S = 0.0013  # wheels report beside the IMU's instants
IMU_KEYS = ("accel_noise", "gyro_noise", "accel_bias_sigma", "gyro_bias_sigma", "accel_bias_walk", "gyro_bias_walk")
FULL_SLIP = 2.0  # m/s, from which on the vehicle slips fully
DERIVATIVE_S = 1e-4
IMU_NAME, GNSS_NAME = "imu0", "gps0"


@dataclass(frozen=True, slots=True)
class Drawn:
    """Random values that are drawn before the drive."""

    calibrations: Array  # (WIDE_SIZE - CALIBRATIONS,): true values of the installation, in the order of the error states

    @property
    def mount(self) -> Array:
        """Pitch and yaw (2,) [rad] of the IMU against the vehicle."""
        return self.calibrations[MOUNT_ERROR.start - CALIBRATIONS : MOUNT_ERROR.stop - CALIBRATIONS]

    @property
    def antenna(self) -> Array:
        """Difference (3,) [m] of the true lever arm from the configured one."""
        return self.calibrations[ANTENNA_ERROR.start - CALIBRATIONS : ANTENNA_ERROR.stop - CALIBRATIONS]

    @property
    def delays(self) -> tuple[float, float]:
        """Delays from measurement to stamp [s] of GNSS position and velocity."""
        position, more = self.calibrations[DELAYS_ERROR.start - CALIBRATIONS : DELAYS_ERROR.stop - CALIBRATIONS]
        return float(position), float(position + more)


class World:
    """The truth of one drive. Times are seconds from its start; instants on the filter's time line are T0 later."""

    def __init__(self, scenario: Scenario, config: Config, random: np.random.Generator, slip: bool = True) -> None:
        """`slip`: whether the vehicle slips as configured, or not at all."""
        motion = config.motion
        self.config, self.random = config, random
        first = np.zeros(WIDE_SIZE - CALIBRATIONS)
        variances = make_parameters(config).calibration_variances
        first[: len(variances)] = np.sqrt(variances)
        own = YAW_RATE_OFFSET_ERROR.start - CALIBRATIONS  # of the car's sensors: drawn only where it has them
        first[:own] *= random.standard_normal(own)
        if first[own:].any():
            first[own:] *= random.standard_normal(len(first) - own)
        self.drawn = Drawn(first)
        (unit,) = config.imu.values()
        mount = (0.0, float(np.degrees(self.drawn.mount[0])), float(np.degrees(self.drawn.mount[1])))
        noise = {key: getattr(unit, key) for key in IMU_KEYS}
        sensor = msgspec.structs.replace(scenario.imu, mount_deg=mount, **noise)
        turned_mount = Trajectory(msgspec.structs.replace(scenario, imu=sensor)).mat_vb
        place = tuple(float(c) for c in -turned_mount @ np.array(motion.point_m))
        self.sensor: Imu = msgspec.structs.replace(sensor, position_m=place)
        self.trajectory = Trajectory(msgspec.structs.replace(scenario, imu=self.sensor))
        self.t = self.trajectory.t
        self.interval = motion.interval_s
        self.knots = np.zeros((int(self.t[-1] / self.interval) + 2, 3))
        if motion.non_holonomic and slip:
            sigmas = [motion.lateral_sigma_mps, motion.vertical_sigma_mps]
            self.knots[:, 1:] = random.standard_normal((len(self.knots), 2)) * sigmas
        self.offset = self._integrated_slip()
        self._sample()

    def slip(self, t: Array) -> tuple[Array, Array]:
        """Velocity (N, 3) [m/s] of slipping in vehicle axes, and its rate."""
        k = np.clip((t / self.interval + 1e-9).astype(np.int64), 0, len(self.knots) - 2)
        step, slope, *_ = blend(np.clip(t / self.interval - k, 0, 1))
        change = self.knots[k + 1] - self.knots[k]
        slip, rate = self.knots[k] + change * step[:, None], change * slope[:, None] / self.interval
        share, growth = self._slipping(t)
        return slip * share[:, None], rate * share[:, None] + slip * growth[:, None]

    def _slipping(self, t: Array) -> tuple[Array, Array]:
        """How much (0 to 1) of the slip there is, and its rate [1/s]: none at standstill, all from FULL_SLIP on."""
        before, now, after = (self.trajectory.kinematics(t + h).speed for h in (-DERIVATIVE_S, 0.0, DERIVATIVE_S))
        share, slope, *_ = blend(np.clip(np.abs(now) / FULL_SLIP, 0, 1))
        return share, slope * (np.abs(after) - np.abs(before)) / (2 * DERIVATIVE_S * FULL_SLIP)

    def kinematics(self, t: Array) -> Kinematics:
        """Motion of the IMU at the times t (N,), slip included."""
        smooth = self.trajectory.kinematics(t)
        mat_nv = smooth.mat_nb @ self.trajectory.mat_vb.T
        slip, change = self.slip(t)
        rate_v = turned(np.broadcast_to(self.trajectory.mat_vb, smooth.mat_nb.shape), smooth.rate_nb_b)
        return replace(
            smooth,
            velocity_n=smooth.velocity_n + turned(mat_nv, slip),
            acceleration_n=smooth.acceleration_n + turned(mat_nv, change + np.cross(rate_v, slip)),
        )

    def _integrated_slip(self) -> Array:
        """Displacement (N, 3) [m], north-east-down, by slip until each instant of the IMU: Simpson's rule."""
        step = np.diff(self.t)[:, None]
        ends, middles = self._slip_n(self.t), self._slip_n(self.t[:-1] + np.diff(self.t) / 2)
        parts = step / 6 * (ends[:-1] + 4 * middles + ends[1:])
        return np.concatenate([np.zeros((1, 3)), np.cumsum(parts, axis=0)])

    def _slip_n(self, t: Array) -> Array:
        return turned(self.trajectory.kinematics(t).mat_nb @ self.trajectory.mat_vb.T, self.slip(t)[0])

    def place(self, t: Array) -> tuple[Array, Array, Array]:
        """Latitude, longitude [rad], height [m] of the IMU."""
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        h = (self.t[i + 1] - self.t[i])[:, None]
        s = (t - self.t[i])[:, None] / h
        p, q = self.offset[i], self.offset[i + 1]
        dp, dq = self._slip_n(self.t[i]) * h, self._slip_n(self.t[i + 1]) * h
        offset = p + s * (dp + s * (3 * (q - p) - 2 * dp - dq + s * (dp + dq - 2 * (q - p))))
        return wgs84.shifted(*self.trajectory.position(t), offset)

    def _sample(self) -> None:
        """The truth at the IMU's instants, and the sensor's errors."""
        kinematics, place = self.kinematics(self.t), self.place(self.t)
        self.latitude, self.longitude, self.height = place
        self.speed = kinematics.speed
        self.velocity_n = kinematics.velocity_n
        self.mat_nb = kinematics.mat_nb
        self.mat_ne = mats_ne(place[0], place[1])
        self.position_e = ecef(*place)
        self.velocity_e = turned(self.mat_ne.transpose(0, 2, 1), kinematics.velocity_n)
        self.mat_eb = self.mat_ne.transpose(0, 2, 1) @ kinematics.mat_nb
        self.rate_b, self.force_b = inertial(kinematics, place[0], place[2])
        randoms = (self.random, self.random, self.random)
        empty = np.zeros(len(self.t))
        motion = Motion(place, self.velocity_n, np.zeros((len(self.t), 3)), self.rate_b, self.force_b, empty)
        sensed = inertial_sensor.measure(self.sensor, self.t, motion, randoms)
        self.gyro, self.accel, self.gyro_bias, self.accel_bias = sensed
        settings = self.config.filter
        walk = settings.wheel_scale_walk / np.sqrt(self.sensor.rate_hz) if settings.wheel_scale_sigma else 0.0
        self.groups = wheel_groups(self.config)
        states = {scale_state(group) for group in {0, *self.groups.values()}}
        self.calibrations = np.tile(self.drawn.calibrations, (len(self.t), 1))  # with their random walk
        for state in sorted(states):
            self.calibrations[:, state - CALIBRATIONS] += np.cumsum(walk * self.random.standard_normal(len(self.t)))

    def times(self, interval: float, phase: float) -> Array:
        """Regular instants inside the drive [s]."""
        return np.asarray(phase + interval * np.arange(int((self.t[-1] - phase) / interval + 1e-6) + 1))

    def turn_rate(self, t: Array) -> Array:
        """Turn rate (N,) [rad/s] about the vehicle's vertical axis."""
        return np.asarray((self.kinematics(t).rate_nb_b @ self.trajectory.mat_vb.T)[:, 2])

    def axle_speed(self, t: Array) -> Array:
        """Forward speed (N,) [m/s] of the middle of the unsteered axle."""
        return self.wheel_speed(Wheel(position_m=self.config.motion.point_m), t)

    def wheel_speed(self, wheel: Wheel, t: Array) -> Array:
        """True speed (N,) [m/s] of a wheel's circumference, scale left out."""
        kinematics = self.kinematics(t)
        velocity_b = turned(kinematics.mat_nb.transpose(0, 2, 1), kinematics.velocity_n)
        velocity_v = (velocity_b + np.cross(kinematics.rate_nb_b, np.array(wheel.position_m))) @ self.trajectory.mat_vb.T
        if wheel.steered:
            return np.asarray(np.copysign(np.hypot(velocity_v[:, 0], velocity_v[:, 1]), velocity_v[:, 0]))
        return np.asarray(velocity_v[:, 0])


def mats_ne(latitude: Array, longitude: Array) -> Array:
    """Rotations (N, 3, 3) from earth-fixed to north-east-down axes."""
    sa, ca, so, co = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(sa)
    rows = [[-sa * co, -sa * so, ca], [-so, co, zero], [-ca * co, -ca * so, -sa]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def ecef(latitude: Array, longitude: Array, height: Array) -> Array:
    """Earth-fixed positions (N, 3) [m]."""
    transverse = wgs84.radii(latitude)[1]
    out = (transverse + height) * np.cos(latitude)
    up = (transverse * (1 - ECCENTRICITY2) + height) * np.sin(latitude)
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), up], -1)


@dataclass(frozen=True, slots=True)
class Fault:
    """What goes wrong with a source, in [start, stop) seconds.

    scale: readings times `size` (a wheel slips; 0: it reads zero). jump: the position is `size` m too far north. drift: it
    moves north at `size` m/s, and so does the velocity. creep: the same, but the velocity stays right. stuck: the last good
    message is repeated. absent: no messages. noisy: additional white noise of `size` configured sigmas.
    """

    source: str
    kind: str
    start: float
    stop: float
    size: float = 0.0


def held(t: Array, inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Index (N,) of each message's content: its own, but inside the fault that of the last message before it."""
    return np.maximum.accumulate(np.where(inside, 0, np.arange(len(t))))


class Sensors:
    """Makes the measurements of a world, with their delays, in the order of receipt."""

    def __init__(
        self, world: World, wheel_hz: float = 50.0, gnss_latency_s: float = 0.1, faults: tuple[Fault, ...] = ()
    ) -> None:
        self.world, self.config, self.random, self.faults = world, world.config, world.random, faults
        self.wheel_hz, self.gnss_latency_s = wheel_hz, gnss_latency_s

    def measurements(self, gnss_from: float = 0.0) -> list[Measurement]:
        """All measurements, sorted by receipt; GNSS only from a time [s] on."""
        found: list[Measurement] = []
        world = self.world
        rows = zip(world.accel.tolist(), world.gyro.tolist(), strict=True)
        self._add(found, IMU_NAME, world.t, [ImuSample(tuple(f), tuple(w)) for f, w in rows], 0.0)
        for name in self.config.gnss:
            self._gnss(found, name, gnss_from)
        t = world.times(1 / self.wheel_hz, WHEEL_PHASE_S)
        for name, wheel in self.config.wheel.items():
            noise = self._noise(len(t), 1 / self.wheel_hz, wheel.correlation_s)[:, 0]
            scale = 1 + np.interp(t, world.t, world.calibrations[:, scale_state(world.groups[name]) - CALIBRATIONS])
            speed = world.wheel_speed(wheel, t)
            turning = (np.abs(speed) >= wheel.least_mps) & (speed != 0)
            readings = np.where(turning, scale * speed + wheel.sigma_mps * noise, 0.0)
            for fault in self._of(name):
                readings = self._spoilt(fault, t, readings, wheel.sigma_mps)
            signal = np.abs(readings) if wheel.unsigned else readings
            self._add(found, name, t, [WheelSpeed(v) for v in signal.tolist()], 0.0)
        self._car(found)
        found.sort(key=lambda m: (m.t_receive_ns, m.t_ns, m.source))
        return found

    def _car(self, found: list[Measurement]) -> None:
        """The car's own yaw rate and steering, where they are configured, at the rate of the wheels."""
        world = self.world
        t = world.times(1 / self.wheel_hz, 2 * WHEEL_PHASE_S)
        turn, speed = world.turn_rate(t), world.axle_speed(t)
        for name, yaw in self.config.yaw_rate.items():
            noise = self._noise(len(t), 1 / self.wheel_hz, yaw.correlation_s)[:, 0]
            readings = turn + self._drawn(YAW_RATE_OFFSET_ERROR) + np.radians(yaw.sigma_deg_s) * noise
            for fault in self._of(name):
                readings = self._spoilt(fault, t, readings, float(np.radians(yaw.sigma_deg_s)))
            self._add(found, name, t, [YawRate(rate) for rate in readings.tolist()], 0.0)
        for name, steering in self.config.steering.items():
            noise = self._noise(len(t), 1 / self.wheel_hz, steering.correlation_s)[:, 0]
            moving = np.abs(speed) > steering.minimum_speed_mps / 2
            needed = np.where(moving, steering.wheelbase_m / np.where(moving, speed, 1.0), 0.0)
            needed += self._drawn(UNDERSTEER_ERROR) * speed
            sigma = float(np.radians(steering.sigma_deg) / steering.ratio)
            angles = self._drawn(STEERING_OFFSET_ERROR) + (1 + self._drawn(STEERING_FACTOR_ERROR)) * needed * turn
            angles += sigma * noise
            for fault in self._of(name):
                angles = self._spoilt(fault, t, angles, sigma)
            self._add(found, name, t, [SteeringAngle(angle) for angle in np.clip(angles, -1.5, 1.5).tolist()], 0.0)

    def _drawn(self, state: slice) -> float:
        """The true value of a calibration."""
        return float(self.world.drawn.calibrations[state.start - CALIBRATIONS])

    def _noise(self, count: int, interval: float, correlation: float) -> Array:
        """Noise (count, 3) of unit variance with a correlation time [s]; white for 0."""
        return gauss_markov(count, interval, correlation, self.random) if correlation else self._white(count)

    def _white(self, count: int) -> Array:
        return self.random.standard_normal((count, 3))

    def _of(self, source: str) -> list[Fault]:
        return [fault for fault in self.faults if fault.source == source]

    def _spoilt(self, fault: Fault, t: Array, values: Array, sigma: float) -> Array:
        inside = (t >= fault.start) & (t < fault.stop)
        if fault.kind == "scale":
            return np.where(inside, values * fault.size, values)
        if fault.kind == "noisy":
            return values + inside * fault.size * sigma * self.random.standard_normal(len(t))
        return values[held(t, inside)] if fault.kind == "stuck" else values

    def _gnss(self, found: list[Measurement], name: str, begin: float) -> None:
        world, gnss = self.world, self.config.gnss[name]
        t = world.times(gnss.interval_s, 0.0)
        delay, velocity_delay = world.drawn.delays
        t = t[t >= max(begin - 1e-9, delay, velocity_delay)]
        errors, off = self._errors(name, t)
        index: NDArray[np.int64] = np.arange(len(t))
        for fault in self._of(name):
            inside = (t >= fault.start) & (t < fault.stop)
            if fault.kind == "jump":
                errors[inside, 0] += fault.size
            elif fault.kind in ("drift", "creep"):
                errors[inside, 0] += fault.size * (t[inside] - fault.start)
                off[inside, 0] += fault.size if fault.kind == "drift" else 0.0
            elif fault.kind == "noisy":
                sigma = np.array([gnss.position_sigma_m, gnss.position_sigma_m, gnss.height_sigma_m])
                errors += inside[:, None] * fault.size * sigma * self.random.standard_normal((len(t), 3))
            elif fault.kind == "stuck":
                index = held(t, inside)
        lever = np.array(gnss.lever_arm_m) + world.drawn.antenna
        mat_nb = world.kinematics(t - delay).mat_nb
        antenna = turned(mat_nb, np.broadcast_to(lever, (len(t), 3))) + errors
        latitude, longitude, height = (part[index].tolist() for part in wgs84.shifted(*world.place(t - delay), antenna))
        places = [GnssPosition(*place) for place in zip(latitude, longitude, height, strict=True)]
        self._add(found, f"{name}.position", t, places, self.gnss_latency_s, fault_of=name)
        if gnss.use_velocity:
            kinematics = world.kinematics(t - velocity_delay)
            swing = turned(kinematics.mat_nb, np.cross(kinematics.rate_nb_b, lever))
            velocities = [GnssVelocity(*v) for v in (kinematics.velocity_n + swing + off)[index].tolist()]
            self._add(found, f"{name}.velocity", t, velocities, self.gnss_latency_s, fault_of=name)

    def _errors(self, name: str, t: Array) -> tuple[Array, Array]:
        """Of a receiver's positions (N, 3) [m] and velocities (N, 3) [m/s], north-east-down."""
        gnss = self.config.gnss[name]
        sigma = np.array([gnss.position_sigma_m, gnss.position_sigma_m, gnss.height_sigma_m])
        position = self._white(len(t))
        if gnss.position_correlation_s:
            slow, white = self._noise(len(t), gnss.interval_s, gnss.position_correlation_s), gnss.position_white_share
            position = np.sqrt(white) * position + np.sqrt(1 - white) * slow
        position *= sigma
        return position, self._noise(len(t), gnss.interval_s, gnss.velocity_correlation_s) * gnss.velocity_sigma_mps

    def _add(
        self,
        found: list[Measurement],
        source: str,
        t: Array,
        payloads: Sequence[Payload],
        late: float,
        fault_of: str | None = None,
    ) -> None:
        absent = [fault for fault in self._of(fault_of or source) if fault.kind == "absent"]
        stamps, delay = T0 + np.rint(t * SECOND).astype(np.int64), nanoseconds(late)
        for k, (stamp, payload) in enumerate(zip(stamps.tolist(), payloads, strict=True)):
            if not any(fault.start <= t[k] < fault.stop for fault in absent):
                found.append(Measurement(stamp, source, k, stamp + delay, payload))
