"""The simulated IMU: without noise it integrates back to the truth; its noise has the stated densities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.maths import wgs84 as earth
from fusiond.maths.rotation import matrix, quaternion_exp
from fusiond.simulation.drive import simulate
from fusiond.simulation.imu import filtered
from tests.helpers.simulated import CRUISE, REST, ecef, scenario


@pytest.mark.parametrize(
    "start",
    [
        "latitude_deg = 48.1\nlongitude_deg = 11.6\nheading_deg = 30.0\n",
        "latitude_deg = -77.8\nlongitude_deg = 179.9995\nheight_m = 3000.0\nheading_deg = 95.0\n",
    ],
)
def test_noiseless_imu_integrates_back_to_the_truth(start: str) -> None:
    """An integration of its own: earth-fixed axes, samples interpolated linearly, one minute with bends and hills."""
    truth = simulate(scenario(start=start, imu="mount_deg = [1.0, -2.0, 3.0]\nrate_hz = 200.0\n")).truth
    place = ecef(truth.latitude, truth.longitude, truth.height)
    mat_ne = earth.mat_ne(place[0])
    position, velocity = place[0], mat_ne.T @ truth.velocity_n[0]
    mat_eb = mat_ne.T @ matrix(truth.quaternion_nb[0])
    dt, earth_rate = 1 / 200, np.array([0.0, 0.0, earth.EARTH_RATE])
    earth_turn = matrix(quaternion_exp(-earth_rate * dt))
    worst = 0.0
    for k in range(len(truth.t_ns) - 1):
        rate = (truth.angular_rate_b[k] + truth.angular_rate_b[k + 1]) / 2
        turned = earth_turn @ mat_eb @ matrix(quaternion_exp(rate * dt))
        force = (mat_eb @ truth.specific_force_b[k] + turned @ truth.specific_force_b[k + 1]) / 2
        free = force + earth.gravity_e(position + velocity * dt / 2)
        free -= 2 * np.cross(earth_rate, velocity + free * dt / 2)
        position = position + velocity * dt + free * dt * dt / 2
        velocity, mat_eb = velocity + free * dt, turned
        worst = max(worst, float(np.linalg.norm(position - place[k + 1])))
    assert worst < 5e-3
    mat_ne = earth.mat_ne(place[-1])
    assert mat_ne @ velocity == pytest.approx(truth.velocity_n[-1], abs=1e-3)
    assert mat_ne @ mat_eb == pytest.approx(matrix(truth.quaternion_nb[-1]), abs=1e-5)


def test_filters_delay_slow_motion_and_damp_fast() -> None:
    """A Butterworth filter of the second order: sqrt(2) / w late, and half the power left at its cutoff."""
    t = np.arange(0.0, 10.0, 0.01)
    ramp = np.outer(t, [1.0, -2.0, 0.5])
    late = filtered(ramp, 4.0, 100.0)
    delay = math.sqrt(2) / (2 * math.pi * 4.0)
    assert late[500:] == pytest.approx(ramp[500:] - delay * np.array([1.0, -2.0, 0.5]), abs=1e-9)
    shaken = filtered(np.sin(2 * math.pi * 2.0 * t)[:, None] * np.ones(3), 2.0, 100.0)[500:]
    assert np.sqrt(2 * (shaken**2).mean(axis=0)) == pytest.approx(math.sqrt(0.5), rel=0.01)
    assert filtered(ramp, 0.0, 100.0) is ramp


# noise
def test_imu_noise_and_bias_have_the_stated_densities() -> None:
    imu = "accel_noise = 0.01\ngyro_noise = 1e-3\naccel_bias_walk = 0.02\ngyro_bias_walk = 1e-3\n"
    drive = simulate(scenario(REST.format(200), clean=False, imu=imu, wheels="chatter = false\n"))
    for read, bias, true, density in (
        (drive.imu.specific_force_b, drive.truth.accel_bias_b, drive.truth.specific_force_b, 0.01),
        (drive.imu.angular_rate_b, drive.truth.gyro_bias_b, drive.truth.angular_rate_b, 1e-3),
    ):
        white = (read - bias - true)[:20000]
        assert white.std(axis=0) == pytest.approx(density * 10, rel=0.03)
        means = white.reshape(-1, 100, 3).mean(axis=1)  # Allan deviation at 1 s is the density
        allan = np.sqrt((np.diff(means, axis=0) ** 2).mean(axis=0) / 2)
        assert allan == pytest.approx(density, rel=0.25)
        assert np.diff(bias, axis=0).std(axis=0) == pytest.approx(density * (2 if density > 5e-3 else 1) / 10, rel=0.03)


def test_vibration_grows_with_speed_and_keeps_to_its_band() -> None:
    imu = "vibration_hz = [20.0]\nvibration_mps2 = 0.5\n"
    moving = simulate(scenario(CRUISE.format(40), imu=imu))
    shake = moving.imu.specific_force_b - moving.truth.specific_force_b
    assert shake.std(axis=0) == pytest.approx(0.5 / math.sqrt(2), rel=0.1)
    power = np.abs(np.fft.rfft(shake, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(shake), 0.01)
    assert power[np.abs(frequency - 20) < 5].sum() > 0.9 * power.sum()
    resting = simulate(scenario(REST.format(5), imu=imu))
    assert resting.imu.specific_force_b == pytest.approx(resting.truth.specific_force_b, abs=1e-5)
