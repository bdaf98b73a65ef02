"""How the IMU is turned, found from drives: every rotation, its uncertainty, and what is refused."""

from __future__ import annotations

import atexit
import itertools
import math
import re
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from fusiond.__main__ import main
from fusiond.app.mounting import WINDOW, Gathering, Mounting, MountingError, Windows, find, text
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.events import Invalid, Measurement
from fusiond.maths.rotation import matrix_from_euler
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import parse
from fusiond.timeline.clock import Clock
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive
from tests.helpers.paths import ROOT

RAV4 = ROOT.parent / "shared" / "data" / "comma2k19-rav4"
SCENARIO = """
[imu]
rate_hz = 50.0
accel_bias_sigma = 0.1
gyro_bias_sigma = 5e-3
vibration_hz = [17.0]
vibration_mps2 = 0.3
[gnss]
delay_ms = 100.0
velocity_sigma_mps = 0.1
[wheels]
rate_hz = 20.0
[[segment]]
duration_s = 4
[[segment]]
duration_s = 7
speed_mps = 14.0
grade_deg = 3.0
[[segment]]
duration_s = 8
turn_deg = 100.0
[[segment]]
duration_s = 6
speed_mps = 6.0
grade_deg = -2.0
[[segment]]
duration_s = 7
speed_mps = 15.0
turn_deg = -70.0
[[segment]]
duration_s = 8
speed_mps = 0.0
grade_deg = 0.0
[[segment]]
duration_s = 5
"""
NONE = (0.0, 0.0, 0.0)
WITHIN = math.radians(3.0)


TURNED = (170.0, -40.0, 100.0)  # deg: what a misled installer would have configured


@cache
def folder() -> Path:
    """Where the simulated drive's files are."""
    temporary = TemporaryDirectory(prefix="fusiond-mount-")
    atexit.register(temporary.cleanup)
    write_drive(parse(SCENARIO), temporary.name)
    return Path(temporary.name)


@cache
def settings() -> Config:
    return config.load(folder() / "fusiond.toml")


@cache
def events() -> tuple[Measurement, ...]:
    """The simulated drive, aligned."""
    clock = Clock(settings())
    logs = open_logs([str(folder() / name) for name in ("drive.tlog", "drive.log")], settings())
    return tuple(event for event in map(clock.align, logs) if event is not None)


def gathered(*kinds: str) -> Windows:
    """The drive by the sources whose names begin so."""
    gathering = Gathering(settings())
    for event in events():
        if event.source.startswith(kinds):
            gathering.add(event)
    return gathering.windows()


@cache
def windows(*kinds: str) -> Windows:
    return gathered(*kinds)


ALL = ("imu0", "gps0", "front", "rear")
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
        assert found.turned == pytest.approx(_angle_of(true @ configured.T), abs=WITHIN)


def _euler_of(matrix: Array) -> tuple[float, float, float]:
    pitch = -math.asin(matrix[2, 0])
    return math.atan2(matrix[2, 1], matrix[2, 2]), pitch, math.atan2(matrix[1, 0], matrix[0, 0])


def _angle_of(matrix: Array) -> float:
    return math.acos((float(np.trace(matrix)) - 1) / 2)


def test_what_it_rests_on() -> None:
    found = find(windows(*ALL), NONE)
    assert found.speed_from == "wheels"
    assert 40 <= found.seconds <= 45
    assert 5 <= found.standing <= 9
    assert {name for name, *_ in found.directions} == {"level", "forward", "turning"}
    assert all(angle < 3.5 * sigma for _, angle, sigma in found.directions)
    roll, pitch, yaw = re.findall(r"-?[0-9.]+", text(found, "imu0").splitlines()[1])
    np.testing.assert_allclose(np.radians([float(roll), float(pitch), float(yaw)]), found.rotation, atol=math.radians(0.051))
    assert find(windows("imu0", "gps0"), NONE).speed_from == "GNSS"


def test_a_sensor_on_end_keeps_its_heading() -> None:
    """Where roll and yaw are one."""
    for yaw in (-2.0, 0.5):
        mat_vs = matrix_from_euler(0.0, math.pi / 2, yaw)
        assert off(find(turned(windows(*ALL), mat_vs.T), NONE), mat_vs) < WITHIN


def some(drive: Windows, rows: Array) -> Windows:
    return drive._replace(
        number=np.arange(int(rows.sum())),
        force=drive.force[rows],
        rate=drive.rate[rows],
        speed=drive.speed[:, rows],
        turn=drive.turn[rows],
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
        (lambda drive: drive._replace(speed=drive.speed * 3.6), r"grows by 0\.\d\d .* speed of the wheels .* unit, radius"),
        (lambda drive: drive._replace(rate=-drive.rate), r"no rotation fits: 'down, by the .*' is 1[78]\d deg off"),
        (lambda drive: drive._replace(number=drive.number * 2), "in pieces"),
    ],
)
def test_what_cannot_be_is_refused(changed: object, complaint: str) -> None:
    assert callable(changed)
    with pytest.raises(MountingError, match=complaint):
        find(changed(windows(*ALL)), NONE)


def test_what_is_missing_is_said() -> None:
    gathering = Gathering(settings())
    with pytest.raises(MountingError, match="no sample of the inertial sensor"):
        gathering.windows()
    imu = [event for event in events() if event.source == "imu0"]
    for event in imu:
        gathering.add(event)
    gathering.add(Measurement(imu[0].t_ns, "gps0.velocity", 0, imu[0].t_ns, Invalid("no fix")))
    with pytest.raises(MountingError, match="tell the speed for 0 s only; 10 s are needed"):
        gathering.windows()
    assert gathering.elapsed_ns == pytest.approx(45e9, abs=1e9)


def test_gaps_are_passed_over() -> None:
    """Without the IMU for two seconds, and without any speed for three."""
    gathering = Gathering(settings())
    begin = events()[0].t_ns
    for event in events():
        second = (event.t_ns - begin) * 1e-9
        if (event.source == "imu0" and 20 < second < 22) or (event.source != "imu0" and 30 < second < 33):
            continue
        gathering.add(event)
    drive = gathering.windows()
    assert 45 - 10 <= len(drive.number) * WINDOW <= 45 - 5
    assert _angle_of(matrix_from_euler(*find(drive, NONE).rotation)) < WITHIN


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The decoder turns the samples as configured; the command says what should have been configured."""
    told = (folder() / "fusiond.toml").read_text().replace("wheels.dbc", str(folder() / "wheels.dbc"))
    path = tmp_path / "car.toml"
    path.write_text(told.replace("[imu.imu0]\n", f"[imu.imu0]\nrotation_deg = {list(TURNED)}\n"))
    logs = [str(folder() / name) for name in ("drive.tlog", "drive.log")]
    assert main(["mount", "--config", str(path), *logs]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "[imu.imu0]"
    roll, pitch, yaw = (math.radians(float(angle)) for angle in re.findall(r"-?\d+\.\d+", lines[1]))
    assert _angle_of(matrix_from_euler(roll, pitch, yaw)) < WITHIN
    away = math.degrees(_angle_of(matrix_from_euler(*(math.radians(angle) for angle in TURNED))))
    assert float(lines[3].split()[0]) == pytest.approx(away, abs=3.0)


def test_the_command_without_wheels_or_fixes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "car.toml"
    path.write_text('[mavlink.fcu]\n[imu.imu0]\nlink = "fcu"\n')
    assert main(["mount", "--config", str(path), str(folder() / "drive.tlog")]) == 1
    assert "wheels or GNSS tell the speed for 0 s only" in capsys.readouterr().err


@pytest.mark.skipif(not RAV4.is_dir(), reason="the captured drive is not beside the project")
def test_a_captured_drive(capsys: pytest.CaptureFixture[str]) -> None:
    """Half a minute over the hills of San Francisco, hardly a bend in it; the filter finds a pitch of -3.8 deg."""
    logs = [str(RAV4 / name) for name in ("drive.tlog", "drive.candump.log")]
    assert main(["mount", "--config", str(ROOT / "configs" / "rav4.toml"), *logs]) == 0
    roll, pitch, yaw = (float(a) for a in re.findall(r"-?\d+\.\d+", capsys.readouterr().out.splitlines()[1]))
    assert (roll, pitch, yaw) == (pytest.approx(0.0, abs=3.0), pytest.approx(-3.8, abs=3.0), pytest.approx(0.0, abs=3.0))
