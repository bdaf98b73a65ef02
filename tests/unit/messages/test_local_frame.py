"""States in local frames against independent matrices; the odometry frame under corrections."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from fusiond.maths.rotation import matrix, matrix_from_euler, quaternion
from fusiond.maths.wgs84 import ecef, mat_ne
from fusiond.messages.local_frame import (
    ENU_FLU,
    MAX_GAP_NS,
    NED_FRD,
    Convention,
    LocalFrame,
    LocalState,
    OdometryFrame,
    Placed,
)
from tests.helpers.estimates import random_state

ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU = np.diag([1.0, -1.0, -1.0])
EARTH_RATE_E = np.array([0.0, 0.0, 7.292115e-5])  # rad/s
AXES = [(ENU_FLU, ENU, FLU), (NED_FRD, np.eye(3), np.eye(3))]
ORIGIN = (math.radians(48.1), math.radians(11.6), 520.0)


def square(block: tuple[float, ...]) -> NDArray[np.float64]:
    return np.array(block).reshape(3, 3)


@pytest.mark.parametrize(("convention", "world", "body"), AXES, ids=["enu_flu", "ned_frd"])
@pytest.mark.parametrize("seed", range(3))
def test_a_state_far_from_the_origin(
    convention: Convention, world: NDArray[np.float64], body: NDArray[np.float64], seed: int
) -> None:
    s = random_state(seed)
    position_e = ecef(math.radians(s.lat_deg), math.radians(s.lon_deg), s.height_m)
    mat_le = world @ mat_ne(ecef(*ORIGIN))
    mat_ln = mat_le @ mat_ne(position_e).T
    mat_nb = matrix(np.array(s.quaternion_nb)) @ body
    mat_lb = mat_ln @ mat_nb
    local = LocalFrame(*ORIGIN, convention).state(s)

    assert_allclose(local.position_l, mat_le @ (position_e - ecef(*ORIGIN)), atol=1e-8)
    assert_allclose(matrix(np.array(local.quaternion_lb)), mat_lb, atol=1e-14)
    assert_allclose(local.velocity_l, mat_ln @ s.velocity_ned_mps, atol=1e-14)
    assert_allclose(local.velocity_b, mat_nb.T @ s.velocity_ned_mps, atol=1e-14)
    rate_b = body @ s.angular_rate_b_rps - mat_lb.T @ mat_le @ EARTH_RATE_E
    assert_allclose(local.angular_rate_b, rate_b, atol=1e-14)
    assert_allclose(local.angular_rate_l, mat_lb @ rate_b, atol=1e-14)
    for found, mat, covariance in (
        (local.covariance_position_l, mat_ln, s.covariance_position_m2),
        (local.covariance_attitude_l, mat_ln, s.covariance_attitude_rad2),
        (local.covariance_velocity_b, mat_nb.T, s.covariance_velocity_m2ps2),
    ):
        assert_allclose(square(found), mat @ square(covariance) @ mat.T, atol=1e-13)
        assert (square(found) == square(found).T).all()
    there = LocalFrame(*ORIGIN, convention).covariance_axes(s.covariance_position_m2)
    assert_allclose(square(there), world @ square(s.covariance_position_m2) @ world.T, atol=1e-14)


def test_conventions_of_ros() -> None:
    """At the origin, heading east, 10 m/s, turning right: along x, yaw 0, turning about -z."""
    east = tuple(quaternion(matrix_from_euler(0.0, 0.0, math.pi / 2)).tolist())
    s = random_state(quaternion_nb=east, velocity_ned_mps=(0.0, 10.0, 0.0), angular_rate_b_rps=(0.0, 0.0, 0.5))
    local = LocalFrame.at(s).state(s)
    assert_allclose(local.position_l, 0.0, atol=1e-9)
    assert_allclose(np.abs(local.quaternion_lb), (1.0, 0.0, 0.0, 0.0), atol=1e-15)
    assert_allclose(local.velocity_l, (10.0, 0.0, 0.0), atol=1e-14)
    assert_allclose(local.velocity_b, (10.0, 0.0, 0.0), atol=1e-14)
    assert_allclose(local.angular_rate_l, (0.0, 0.0, -0.5), atol=1e-4)
    up = LocalFrame.at(s).state(random_state(lat_deg=s.lat_deg, lon_deg=s.lon_deg, height_m=s.height_m + 7.0))
    assert_allclose(up.position_l, (0.0, 0.0, 7.0), atol=1e-8)


# --- The odometry frame

STEP_NS, SPEED, TURN = 20_000_000, 10.0, 0.3  # ns, m/s, rad/s


def driven(number: int, shift: float = 0.0, turned: float = 0.0) -> tuple[int, LocalState]:
    """A circle, with an error of position [m] and of heading [rad]."""
    heading = TURN * number * STEP_NS / 1e9
    radius = SPEED / TURN
    estimated = heading + turned
    none = (0.0,) * 9
    x, y = radius * math.sin(heading) + shift, radius * (1 - math.cos(heading))
    velocity = (SPEED * math.cos(estimated), SPEED * math.sin(estimated), 0.0)
    half = (math.cos(estimated / 2), 0.0, 0.0, math.sin(estimated / 2))
    rate = (0.0, 0.0, TURN)
    return number * STEP_NS, LocalState((x, y, 0.0), half, velocity, (SPEED, 0.0, 0.0), rate, rate, none, none, none)  # type: ignore[arg-type]


def joined(first: Placed, second: Placed) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mat = matrix(np.array(first.quaternion))
    return np.array(first.position) + mat @ second.position, mat @ matrix(np.array(second.quaternion))


def heading(placed: Placed) -> float:
    w, _, _, z = placed.quaternion
    return 2 * math.atan2(z, w)


def test_without_corrections_the_frames_stay_together() -> None:
    frame = OdometryFrame()
    for number in range(500):
        odom, _ = frame.follow(*driven(number))
    assert_allclose(odom.position, 0.0, atol=0.01)
    assert heading(odom) == pytest.approx(0.0, abs=1e-9)


def test_a_reset_moves_the_odometry_frame_and_not_the_body_in_it() -> None:
    frame = OdometryFrame()
    before: Placed | None = None
    for number in range(400):
        jumped = number >= 200
        t_ns, local = driven(number, *((30.0, 0.4) if jumped else (0.0, 0.0)))
        odom, body = frame.follow(t_ns, local)
        position, mat = joined(odom, body)
        assert_allclose(position, local.position_l, atol=1e-9)
        assert_allclose(mat, matrix(np.array(local.quaternion_lb)), atol=1e-12)
        if before is not None:
            assert math.dist(body.position, before.position) == pytest.approx(SPEED * STEP_NS / 1e9, rel=0.03)
            turn = math.remainder(heading(body) - heading(before), math.tau)
            assert turn == pytest.approx(TURN * STEP_NS / 1e9, abs=1e-9)
        before = body
        assert abs(heading(odom)) == pytest.approx(0.4 if jumped else 0.0, abs=1e-9)


def test_in_a_gap_the_odometry_frame_does_not_move() -> None:
    frame = OdometryFrame()
    for number in range(10):
        odom, _ = frame.follow(*driven(number, shift=5.0 if number >= 5 else 0.0))
    resumed = 10 + MAX_GAP_NS // STEP_NS
    after, body = frame.follow(*driven(resumed, shift=5.0))
    assert after == odom
    assert_allclose(joined(after, body)[0], driven(resumed, shift=5.0)[1].position_l, atol=1e-9)


def test_after_a_gap_with_a_reset_the_body_is_where_it_was_in_the_odometry_frame() -> None:
    frame = OdometryFrame()
    for number in range(10):
        _, before = frame.follow(*driven(number))
    t_ns, local = driven(10 + MAX_GAP_NS // STEP_NS, shift=80.0, turned=1.0)
    assert frame.loses_sight(t_ns, 1) and not frame.loses_sight(t_ns, 0)
    odom, body = frame.follow(t_ns, local, 1)
    assert_allclose(body.position, before.position, atol=1e-9)
    assert heading(body) == pytest.approx(heading(before), abs=1e-9)
    position, mat = joined(odom, body)
    assert_allclose(position, local.position_l, atol=1e-9)
    assert_allclose(mat, matrix(np.array(local.quaternion_lb)), atol=1e-12)
    assert not frame.loses_sight(t_ns + 2 * MAX_GAP_NS, 1)  # the reset is known by then
