"""How far the body may have drifted in the odometry frame: closed forms, and a simulated drive against its truth."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest

from fusiond.estimator.solution import Mode
from fusiond.maths.wgs84 import ecef, mat_ne
from fusiond.messages.drift import TURN_NOISE, VELOCITY_ERROR_S, Drift
from fusiond.messages.local_frame import LocalFrame, LocalState, OdometryFrame, Placed
from fusiond.messages.types import Block, StateMessage, Triple
from fusiond.units import SECOND
from tests.helpers.drive import folder, messages

NONE: Block = (0.0,) * 9  # type: ignore[assignment]
HERE = Placed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
STEP_NS = SECOND // 50


def moving(speed: float = 0.0, sigma: float = 0.0, tilt: float = 0.0) -> LocalState:
    """Straight on along x, with sigmas of the velocity [m/s] and of roll and pitch [rad]."""
    velocity, square = (speed, 0.0, 0.0), sigma * sigma
    covariance = (square, 0.0, 0.0, 0.0, square, 0.0, 0.0, 0.0, square)
    attitude = (tilt * tilt, 0.0, 0.0, 0.0, tilt * tilt, 0.0, 0.0, 0.0, 0.0)
    zero = (0.0, 0.0, 0.0)
    return LocalState(zero, HERE.quaternion, velocity, velocity, zero, zero, NONE, attitude, covariance)


def after(seconds: float, state: LocalState, sigma_gyro_bias: Triple = (0.0, 0.0, 0.0)) -> np.ndarray:
    drift = Drift()
    for number in range(int(seconds * 50) + 1):
        drift.follow(number * STEP_NS, state, HERE, sigma_gyro_bias)
    return np.reshape(drift.covariance(state, HERE), (6, 6))


def test_it_begins_with_none() -> None:
    covariance = after(0.0, moving(10.0, 1.0, tilt=0.02))
    assert np.diag(covariance).tolist() == [0.0, 0.0, 0.0, 0.02**2, 0.02**2, 0.0]


def test_an_error_of_the_velocity() -> None:
    """A Gauss-Markov error, integrated: at first as a constant, then as a random walk."""
    for seconds in (1.0, 100.0):
        covariance, ratio = after(seconds, moving(sigma=0.1)), seconds / VELOCITY_ERROR_S
        want = 2 * (0.1 * VELOCITY_ERROR_S) ** 2 * (ratio - 1 + math.exp(-ratio))
        assert np.diag(covariance)[:3] == pytest.approx([want] * 3, rel=0.03)


def test_an_error_of_the_gyro() -> None:
    """The heading goes off in proportion to time, and the position across with its square."""
    speed, bias, seconds = 10.0, 1e-3, 100.0
    covariance = after(seconds, moving(speed), (0.0, 0.0, bias))
    heading = (bias * seconds) ** 2 + TURN_NOISE**2 * seconds
    across = (speed * bias * seconds**2 / 2) ** 2 + (speed * TURN_NOISE) ** 2 * seconds**3 / 3
    assert covariance[5, 5] == pytest.approx(heading, rel=0.01)
    assert covariance[1, 1] == pytest.approx(across, rel=0.01)
    assert 0 < covariance[1, 5] < math.sqrt(covariance[1, 1] * covariance[5, 5])
    assert covariance[0, 0] == pytest.approx(0.0, abs=1e-12)


def test_after_a_gap_with_a_reset_the_body_may_be_as_far_as_it_could_drive() -> None:
    drift = Drift()
    drift.follow(0, moving(10.0), HERE, (0.0, 0.0, 0.0))
    drift.lose_sight(5 * SECOND, 50.0)
    covariance = np.reshape(drift.covariance(moving(10.0), HERE), (6, 6))
    assert np.sqrt(np.diag(covariance)[[0, 1, 2, 5]]) == pytest.approx([50.0, 50.0, 50.0, math.pi / math.sqrt(3)])


def test_a_drive_drifts_no_more_than_it_says() -> None:
    """Position and heading in the odometry frame against the truth of a simulated drive, through the loss of GNSS."""
    with (folder() / "truth.csv").open() as file:
        rows = {name: np.array(column, float) for name, column in _columns(file).items()}
    frame: LocalFrame | None = None
    odometry, drift = OdometryFrame(), Drift()
    first: tuple[np.ndarray, float, np.ndarray, float] | None = None
    checked = 0
    for message in messages():
        if not isinstance(message, StateMessage) or message.state is None or message.mode is Mode.LOST:
            continue
        frame = frame or LocalFrame.at(message.state)
        local = frame.state(message.state)
        _, body = odometry.follow(message.t_ns, local)
        drift.follow(message.t_ns, local, body, message.state.sigma_gyro_bias_rps)
        latitude, longitude, height, yaw = (
            float(np.interp(message.t_ns / 1000, rows["unix_us"], rows[name]))
            for name in ("lat_deg", "lon_deg", "height_m", "yaw_deg")
        )
        place = ecef(math.radians(latitude), math.radians(longitude), height)
        w, x, y, z = body.quaternion
        heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        now = np.array(body.position), heading, place, math.pi / 2 - math.radians(yaw)
        if first is None:
            first, to_enu = now, mat_ne(place)[[1, 0, 2]] * np.array([[1], [1], [-1]])
            continue
        turn = first[1] - first[3]  # the odometry frame against the truth, where it begins
        turned = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        error = now[0] - first[0] - turned @ to_enu @ (place - first[2])
        covariance = np.reshape(drift.covariance(local, body), (6, 6))
        assert np.linalg.eigvalsh(covariance).min() > -1e-12
        wrong = np.array([*error[:2], math.remainder(now[1] - first[1] - (now[3] - first[3]), math.tau)])
        errors = [0, 1, 5]
        assert wrong @ np.linalg.solve(covariance[np.ix_(errors, errors)] + 1e-6 * np.eye(3), wrong) < 16.3  # 0.999, 3 dof
        checked += 1
    assert checked > 250 and 0.05 < np.sqrt(covariance[0, 0] + covariance[1, 1]) < 1.0


def _columns(file: object) -> dict[str, list[str]]:
    header, *lines = csv.reader(file)  # type: ignore[call-overload]
    return dict(zip(header, map(list, zip(*lines, strict=True)), strict=True))
