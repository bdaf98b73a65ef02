"""The simulated wheels: motion of their contact points, noise, faults, standstill."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.simulation import wgs84, wheels
from fusiond.simulation.drive import simulate
from fusiond.simulation.trajectory import Trajectory
from tests.helpers.simulated import CRUISE, DRIVE, ecef, mats_nb, scenario, seconds


def test_wheels_measure_the_motion_of_their_contact_points() -> None:
    flat = "\n".join(line for line in DRIVE.splitlines() if "grade" not in line) + "\n"
    made = scenario(flat, vehicle="roll_deg_per_mps2 = 0.0\n", imu="rate_hz = 200.0\n")
    trajectory, truth = Trajectory(made), simulate(made).truth
    speeds = wheels.true_speeds(made, trajectory.kinematics(trajectory.t))
    mats, place = mats_nb(truth), (truth.latitude, truth.longitude, truth.height)
    for column, point in enumerate(wheels.positions_v(made)):
        path = ecef(*wgs84.shifted(*place, mats @ trajectory.lever_b(tuple(point))))
        moved = np.linalg.norm(path[2:] - path[:-2], axis=1) * 100.0
        assert moved == pytest.approx(np.abs(speeds[1:-1, column]), abs=3e-3)
    bend = 17 * 200  # to the right: the left wheels are faster, the front ones roll farther than the rear ones
    front_left, front_right, rear_left, rear_right = speeds[bend]
    assert front_left > rear_left > rear_right and front_right > rear_right


def test_wheel_noise_scale_and_resolution() -> None:
    spec = "sigma_mps = 0.05\nscale_error = 0.02\nscale_errors = [0.0, 0.0, 0.01, -0.01]\nresolution_kmh = 0.02\n"
    drive = simulate(scenario(CRUISE.format(100), wheels=spec))
    speeds = drive.wheels.raw * 0.02 / 3.6
    assert speeds.mean(axis=0) == pytest.approx([10.2, 10.2, 10.302, 10.098], abs=0.003)
    assert speeds.std(axis=0) == pytest.approx(0.05, rel=0.04)
    assert drive.truth.wheel_scale == pytest.approx((0.02, 0.02, 0.0302, 0.0098))


def test_wheel_faults() -> None:
    spec = """
fault_s = [[2, 3]]
silent_s = [[4, 5]]
[[wheels.slip]]
wheel = "front_left"
start_s = 6
stop_s = 7
factor = 1.3
[[wheels.stuck]]
wheel = "rear_right"
start_s = 8
stop_s = 12
"""
    drive = simulate(scenario(wheels=spec))
    plain = simulate(scenario())
    t = seconds(drive, drive.wheels.t_receive_us)
    same = np.isin(plain.wheels.t_receive_us, drive.wheels.t_receive_us)
    raw, clean = drive.wheels.raw, plain.wheels.raw[same]
    assert drive.wheels.fault.sum() == 100 and drive.wheels.fault[(t > 2.01) & (t < 2.99)].all()
    assert not ((t > 4.01) & (t < 4.99)).any()
    slip = (t > 6.01) & (t < 6.99)
    assert raw[slip, 0] == pytest.approx(clean[slip, 0] * 1.3, abs=1) and np.array_equal(raw[slip, 1:], clean[slip, 1:])
    stuck = (t > 8.01) & (t < 11.99)
    assert len(set(raw[stuck, 3])) == 1 and len(set(clean[stuck, 3])) > 100
    assert np.array_equal(raw[t > 12.1], clean[t > 12.1])


def test_standing_wheels_read_zero_and_unsigned_ones_hide_the_direction() -> None:
    spec = "sigma_mps = 0.05\nleast_mps = 0.2\nunsigned = {}\n"
    signed, unsigned = (simulate(scenario(wheels=spec.format(word))).wheels.raw for word in ("false", "true"))
    assert (unsigned[:290] == 0).all()
    assert unsigned.min() == 0 and signed[-800:].min() * 0.01 / 3.6 == pytest.approx(-3.2, abs=0.4)
    assert np.array_equal(np.abs(signed), unsigned)


def test_wheels_of_a_skid_steered_vehicle_differ_more_than_the_bend_asks_for() -> None:
    made = scenario(DRIVE, vehicle='steering = "skid"\nskid = 2.0\ntrack_m = 1.0\nwheelbase_m = 0.6\n')
    kinematics = Trajectory(made).kinematics(np.array([17.0]))
    ((front_left, front_right, rear_left, rear_right),) = wheels.true_speeds(made, kinematics)
    assert front_left == rear_left and front_right == rear_right
    assert front_left - front_right == pytest.approx(2.0 * float(kinematics.yaw_rate[0]))
    assert wheels.positions_v(made)[:, 0].tolist() == [0.3, 0.3, -0.3, -0.3]
