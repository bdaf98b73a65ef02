"""The rotation of the IMU estimated from drives: every rotation, its uncertainty, and what is refused."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from fusiond.app.mounting.rotation import Mounting, find
from fusiond.app.mounting.windows import MountingError, Windows
from fusiond.maths.rotation import matrix_from_euler
from fusiond.maths.typed import Array
from tests.helpers.mounting import ALL, WITHIN, angle_of, windows

NONE = (0.0, 0.0, 0.0)
SOURCES = {
    "wheels and GNSS": ALL,
    "wheels": ("imu0", "front", "rear"),
    "steered wheels": ("imu0", "front"),
    "GNSS": ("imu0", "gps0"),
}


def turned(drive: Windows, mat_sv: Array) -> Windows:
    """The drive as a sensor feels it whose axes are turned: vector in s = mat_sv @ vector in v."""
    return drive._replace(force=drive.force @ mat_sv.T, rate=drive.rate @ mat_sv.T)


def off(found: Mounting, mat_vs: Array) -> float:
    """Angle [rad] between a rotation found and the true one."""
    return math.acos(min(1.0, (float(np.trace(matrix_from_euler(*found.rotation) @ mat_vs.T)) - 1) / 2))


def permutations() -> list[Array]:
    """The 24 ways to lay a box along the axes."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return found


@pytest.mark.parametrize("sources", SOURCES.values(), ids=SOURCES)
def test_every_way_to_lay_it_along_the_axes(sources: tuple[str, ...]) -> None:
    assert len(permutations()) == 24
    for mat_vs in permutations():
        found = find(turned(windows(*sources), mat_vs.T), NONE)
        assert off(found, mat_vs) < WITHIN
        assert max(found.sigma) < WITHIN


@pytest.mark.parametrize("sources", SOURCES.values(), ids=SOURCES)
def test_any_rotation_on_top_of_a_configured_one(sources: tuple[str, ...]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        true, configured = (matrix_from_euler(*angles) for angles in rng.uniform(-math.pi, math.pi, (2, 3)))
        angles = np.degrees(np.array(_euler_of(configured)))
        found = find(turned(windows(*sources), configured @ true.T), (angles[0], angles[1], angles[2]))
        assert off(found, true) < WITHIN
        assert found.turned == pytest.approx(angle_of(true @ configured.T), abs=WITHIN)


def _euler_of(matrix: Array) -> tuple[float, float, float]:
    pitch = -math.asin(matrix[2, 0])
    return math.atan2(matrix[2, 1], matrix[2, 2]), pitch, math.atan2(matrix[1, 0], matrix[0, 0])


def test_the_evidence_is_reported() -> None:
    found = find(windows(*ALL), NONE)
    assert found.speed_from == "wheels"
    assert 40 <= found.seconds <= 45
    assert 5 <= found.standing <= 9
    assert {name for name, *_ in found.directions} == {"level", "forward", "turning"}
    assert all(angle < 3.5 * sigma for _, angle, sigma in found.directions)
    assert find(windows("imu0", "gps0"), NONE).speed_from == "GNSS"


def test_a_sensor_on_end_keeps_its_heading() -> None:
    """Where roll and yaw are one."""
    for yaw in (-2.0, 0.5):
        mat_vs = matrix_from_euler(0.0, math.pi / 2, yaw)
        assert off(find(turned(windows(*ALL), mat_vs.T), NONE), mat_vs) < WITHIN


def some(drive: Windows, chosen: Array) -> Windows:
    return drive._replace(
        number=np.arange(int(chosen.sum())),
        force=drive.force[chosen],
        rate=drive.rate[chosen],
        speed=drive.speed[:, chosen],
        turn=drive.turn[chosen],
    )


def test_too_little_motion_is_refused() -> None:
    drive = windows(*ALL)
    rest = some(drive, drive.speed.max(axis=0) == 0)
    for quiet in (
        some(drive, np.abs(drive.acceleration) < 0.15),
        rest._replace(**{name: np.concatenate([getattr(rest, name)] * 3) for name in ("force", "rate", "turn")})._replace(
            number=np.arange(3 * len(rest.number)), speed=np.tile(rest.speed, 3)
        ),
    ):
        with pytest.raises(MountingError, match=r"too little motion.*pull away and brake"):
            find(quiet, NONE)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        (lambda drive: drive._replace(force=drive.force / 9.81), "not gravity"),
        (lambda drive: drive._replace(speed=drive.speed * 3.6), r"grows by 0\.\d\d .* speed of the wheels.* unit, radius"),
        (lambda drive: drive._replace(rate=-drive.rate), r"no rotation fits: 'down, by the .*' is 1[78]\d deg from"),
        (lambda drive: drive._replace(number=drive.number * 2), "too many gaps"),
    ],
)
def test_what_cannot_be_is_refused(changed: object, complaint: str) -> None:
    assert callable(changed)
    with pytest.raises(MountingError, match=complaint):
        find(changed(windows(*ALL)), NONE)
