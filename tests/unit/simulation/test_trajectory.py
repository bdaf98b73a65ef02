"""The trajectory: smooth, with speeds and rates that agree, and a rear axle that does not slip unless told to."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.simulation import wgs84
from fusiond.simulation.drive import simulate
from fusiond.simulation.trajectory import Trajectory, blend, blend_integral
from tests.helpers.simulated import mats_nb, scenario


# physics
def test_blend_is_smooth_and_its_derivatives_and_integral_agree() -> None:
    u = np.linspace(0.0, 1.0, 20001)
    value, first, second, third = blend(u)
    step = u[1] - u[0]
    for function, derivative in ((blend_integral(u), value), (value, first), (first, second), (second, third)):
        assert np.allclose(np.gradient(function, step)[1:-1], derivative[1:-1], atol=2e-3 * np.abs(derivative).max())
    assert (value[0], value[-1]) == pytest.approx((0, 1), abs=1e-12)
    assert blend_integral(np.ones(1))[0] == pytest.approx(0.5)
    for ends in (first, second, third):
        assert np.allclose(ends[[0, -1]], 0, atol=1e-9)


def test_rates_and_forces_have_no_steps() -> None:
    truth = simulate(scenario(imu="rate_hz = 200.0\n")).truth
    assert np.abs(np.diff(truth.angular_rate_b, axis=0)).max() < 0.01
    assert np.abs(np.diff(truth.specific_force_b, axis=0)).max() < 0.15


def test_rear_axle_does_not_slip_sideways() -> None:
    imu = "position_m = [1.2, 0.3, -0.6]\nmount_deg = [0.0, 2.0, -3.0]\n"
    made = scenario(imu=imu)
    trajectory, truth = Trajectory(made), simulate(made).truth
    mats = mats_nb(truth)
    rate_b = truth.angular_rate_b - np.einsum("nji,nj->ni", mats, wgs84.earth_rate_n(truth.latitude))
    velocity_b = np.einsum("nji,nj->ni", mats, truth.velocity_n) + np.cross(rate_b, trajectory.lever_b((0, 0, 0)))
    velocity_v = velocity_b @ trajectory.mat_vb.T
    assert np.abs(velocity_v[:, 1:]).max() < 1e-4
    assert velocity_v[:, 0] == pytest.approx(truth.speed, abs=1e-4)
    assert truth.speed.max() == pytest.approx(14) and truth.speed.min() == pytest.approx(-3)


def test_the_rear_axle_slips_out_of_a_bend() -> None:
    lines = "roll_deg_per_mps2 = 0.0\nslip_deg_per_mps2 = 0.5\n"
    made = scenario(vehicle=lines, imu="position_m = [0.0, 0.0, 0.0]\nrate_hz = 200.0\n")
    trajectory = Trajectory(made)
    k = trajectory.kinematics(trajectory.t)
    velocity_b = np.einsum("nji,nj->ni", k.mat_nb, k.velocity_n)
    sideways = k.speed**2 * k.curvature  # m/s^2
    assert np.abs(sideways).max() > 2
    assert velocity_b[:, 1] == pytest.approx(-np.radians(0.5) * sideways * k.speed, abs=1e-9)
    assert velocity_b[:, 2] == pytest.approx(0, abs=1e-9)
    by_difference = np.gradient(k.velocity_n, trajectory.t, axis=0)[1:-1]
    assert by_difference == pytest.approx(k.acceleration_n[1:-1], abs=2e-3)
