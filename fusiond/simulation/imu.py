"""The simulated inertial sensor: white noise, wandering bias, vibration in narrow bands, the autopilot's low-pass filters,
steps of the reading."""

from __future__ import annotations

import numpy as np

from fusiond.events import Vector3
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import Imu
from fusiond.simulation.truth import Motion

VIBRATION_SPEED = 10.0  # m/s, at which the amplitudes of a scenario hold


def biases(imu: Imu, count: int, random: np.random.Generator) -> tuple[Array, Array]:
    """Bias of gyro (N, 3) [rad/s] and accelerometer (N, 3) [m/s^2]: a first value and a random walk."""

    def walk(first: Vector3 | None, sigma: float, density: float) -> Array:
        drawn = sigma * random.standard_normal(3)
        steps = random.standard_normal((count, 3)) * (density / np.sqrt(imu.rate_hz))
        steps[0] = drawn if first is None else first
        return np.cumsum(steps, axis=0)

    gyro = walk(imu.gyro_bias, imu.gyro_bias_sigma, imu.gyro_bias_walk)
    return gyro, walk(imu.accel_bias, imu.accel_bias_sigma, imu.accel_bias_walk)


def white(imu: Imu, count: int, random: np.random.Generator) -> tuple[Array, Array]:
    """White noise of gyro (N, 3) [rad/s] and accelerometer (N, 3) [m/s^2]."""
    both = random.standard_normal((2, count, 3)) * np.sqrt(imu.rate_hz)
    return both[0] * imu.gyro_noise, both[1] * imu.accel_noise


def vibration(imu: Imu, t: Array, speed: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Vibration of gyro (N, 3) [rad/s] and accelerometer (N, 3) [m/s^2]: sinusoids of wandering phase."""
    total = np.zeros((2, len(t), 3))
    for frequency in imu.vibration_hz:
        phase = random.standard_normal((2, len(t), 3)) * np.sqrt(2 * np.pi * imu.vibration_width_hz / imu.rate_hz)
        phase[:, 0] = random.uniform(0, 2 * np.pi, (2, 3))
        total += np.sin(np.cumsum(phase, axis=1) + (2 * np.pi * frequency * t)[:, None])
    total *= (np.abs(speed) / VIBRATION_SPEED)[:, None]
    return total[0] * np.radians(imu.vibration_deg_s), total[1] * imu.vibration_mps2


def measure(
    imu: Imu, t: Array, motion: Motion, randoms: tuple[np.random.Generator, np.random.Generator, np.random.Generator]
) -> tuple[Array, Array, Array, Array]:
    """Readings of gyro and accelerometer and their biases, (N, 3) each; the generators are those of bias, noise and
    vibration."""
    gyro_bias, accel_bias = biases(imu, len(t), randoms[0])
    gyro_noise, accel_noise = white(imu, len(t), randoms[1])
    gyro_shake, accel_shake = vibration(imu, t, motion.speed, randoms[2])
    gyro = filtered(motion.angular_rate_b + gyro_bias + gyro_noise + gyro_shake, imu.gyro_filter_hz, imu.rate_hz)
    accel = filtered(motion.specific_force_b + accel_bias + accel_noise + accel_shake, imu.accel_filter_hz, imu.rate_hz)
    return stepped(gyro, imu.gyro_resolution), stepped(accel, imu.accel_resolution), gyro_bias, accel_bias


def filtered(values: Array, cutoff_hz: float, rate_hz: float) -> Array:
    """Values (N, 3), `rate_hz` of them a second, behind a Butterworth filter of the second order, as ArduPilot's
    LowPassFilter2p and PX4's LowPassFilter2p are; it begins settled. 0: not at all.

    y'' + sqrt(2) w y' + w^2 y = w^2 u with w = 2 pi cutoff, exact for a u that is linear between samples. So slow motion
    is late by sqrt(2) / w: 56 ms at 4 Hz.
    """
    if cutoff_hz == 0:
        return values
    w = 2 * np.pi * cutoff_hz
    system = np.array([[0, 1, 0, 0], [-w * w, -np.sqrt(2) * w, w * w, 0], [0, 0, 0, 1], [0, 0, 0, 0]]) / rate_hz
    step = np.linalg.matrix_power(_exponential(system / 1024), 1024)[:2]  # of y, y', u, u' in units of a second
    rows, u = np.empty_like(values), values
    change = np.diff(u, axis=0) * rate_hz
    y, speed = u[0], np.zeros(3)
    rows[0] = y
    for k in range(1, len(u)):
        y, speed = step @ np.array([y, speed, u[k - 1], change[k - 1]])
        rows[k] = y
    return rows


def _exponential(small: Array) -> Array:
    """The exponential of a matrix that is small, by its series."""
    total, term = np.eye(len(small)), np.eye(len(small))
    for k in range(1, 8):
        term = term @ small / k
        total = total + term
    return total


def stepped(values: Array, step: float) -> Array:
    """Values rounded to whole steps; 0: not at all."""
    if step == 0:
        return values
    result: Array = np.rint(values / step) * step
    return result
