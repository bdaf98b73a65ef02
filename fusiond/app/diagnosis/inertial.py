"""What gravity and GNSS say of the inertial sensor: units, axes, mount, and by how much it is late."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.diagnosis.finding import Finding
from fusiond.app.diagnosis.fits import MIN_READINGS, SURE
from fusiond.app.mounting.rotation import angle_between, directions_of, find, turning_axis
from fusiond.app.mounting.windows import MountingError, means_of
from fusiond.config.sensor import vector_in_words
from fusiond.maths.typed import Array

GRAVITY = 9.81  # m/s^2
GRAVITY_SHARE = 0.08  # how far from it a mean specific force may be: bias, a drive that only accelerates
FORCE_UNITS = {"g": 1 / GRAVITY, "mg": 1e3 / GRAVITY, "cm/s^2": 100.0, "mm/s^2": 1000.0}  # what gravity then reads over 9.81
RATE_UNITS = {"deg/s": math.degrees(1), "mrad/s": 1e3}
UNIT_SHARE = 0.15  # how far a factor may be from that of a unit
GAIN = 0.2  # a gyro's scale that is off by less is no mistake of unit
LEVEL = math.radians(20.0)  # slopes and biases alone put gravity off by less


def inertial_findings(evidence: Evidence) -> Iterator[Finding]:
    """What is wrong with the inertial sensor."""
    config, bins = evidence.config, evidence.gathering.imu
    if len(bins) < MIN_READINGS:
        return
    ((name, section),) = config.imu.items()
    where = f"imu.{name}"
    spacing = float(np.median(evidence.spacing)) if evidence.spacing else 0.0
    if spacing > config.filter.imu_gap_s:
        yield Finding(
            kind="imu_slow",
            text=f"{name} comes at {1 / spacing:.1f} Hz: its samples are {spacing:.2g} s apart, more than filter.imu_gap_s "
            f"({config.filter.imu_gap_s:g} s), so the filter coasts between them; it needs 10 Hz or more, 50 Hz is good",
            key=f"{where}.message",
        )
        return
    _, means = means_of(bins)
    wrong_unit = list(_units(evidence, where, means))
    yield from wrong_unit
    if not wrong_unit:
        yield from _mount(evidence, where, section.rotation_deg)


def _units(evidence: Evidence, where: str, means: Array) -> Iterator[Finding]:
    name = where.partition(".")[2]
    force = float(np.linalg.norm(means[:, :3].mean(axis=0)))
    if abs(force / GRAVITY - 1) > GRAVITY_SHARE:
        unit = _unit(FORCE_UNITS, force / GRAVITY)
        yield Finding(
            kind="accel_unit",
            text=f"{name}: the accelerometer reads {force:.3g} m/s^2 on average, and gravity is {GRAVITY}"
            + (f": does it give {unit}?" if unit else ""),
            key=f"{where}.message",
        )
    try:
        windows = evidence.gathering.windows(by_gnss=_knows_course(evidence))
    except MountingError:
        return
    axis = turning_axis(windows)
    if axis is not None and axis.gain > SURE * axis.gain_sigma and abs(axis.gain - 1) > max(SURE * axis.gain_sigma, GAIN):
        unit = _unit(RATE_UNITS, axis.gain)
        yield Finding(
            kind="gyro_unit",
            text=f"{name}: the gyro reads {axis.gain:.3g} times the rate at which the course changes"
            + (f": does it give {unit}?" if unit else "; is its unit or range right?"),
            key=f"{where}.message",
        )


def _unit(units: dict[str, float], factor: float) -> str | None:
    return next((unit for unit, one in units.items() if abs(factor / one - 1) < UNIT_SHARE), None)


def _knows_course(evidence: Evidence) -> bool:
    return any(len(one) >= MIN_READINGS for one in evidence.velocities.values())


def _mount(evidence: Evidence, where: str, configured: tuple[float, float, float]) -> Iterator[Finding]:
    """The sensor's rotation: as found from gravity, acceleration and turns, against the configured one."""
    name, prior = where.partition(".")[2], math.radians(evidence.config.filter.mount_sigma_deg)
    try:
        windows = evidence.gathering.windows(by_gnss=_knows_course(evidence))
        directions = directions_of(windows)
    except MountingError:
        yield from _level(evidence, where)
        return
    try:
        found = find(windows, configured)
    except MountingError:
        off = [(angle_between(one.sensed, one.vehicle), one) for one in directions if one.name in ("level", "turning")]
        between = angle_between(off[0][1].sensed, off[-1][1].sensed) if len(off) == 2 else 0.0
        if between > math.radians(45.0) and all(one.sigma < LEVEL / 2 for _, one in off):
            yield Finding(
                kind="imu_axes",
                text=f"{name}: down by gravity and down by turning are {math.degrees(between):.0f} deg apart: an axis of "
                "the accelerometer or of the gyro is reversed, or two are swapped",
                key=f"{where}.rotation_deg",
            )
        else:
            yield from _level(evidence, where)
        return
    tolerance = SURE * math.hypot(prior, max(found.sigma))
    if found.turned > tolerance:
        roll, pitch, yaw = (round(math.degrees(angle), 1) + 0.0 for angle in found.rotation)
        yield Finding(
            kind="imu_mount",
            text=f"{name} is mounted {math.degrees(found.turned):.0f} deg from rotation_deg = "
            f"[{', '.join(f'{angle:g}' for angle in configured)}], by gravity, acceleration and turns "
            f"(+- {math.degrees(max(found.sigma)):.0f} deg)",
            key=f"{where}.rotation_deg",
            value=f"[{roll}, {pitch}, {yaw}]",
        )


def _level(evidence: Evidence, where: str) -> Iterator[Finding]:
    """Where a drive does not determine the whole rotation, gravity still tells roll and pitch."""
    _, means = means_of(evidence.gathering.imu)
    force = means[:, :3].mean(axis=0)
    off = angle_between(-force, np.array([0.0, 0.0, 1.0]))
    if off > LEVEL:
        yield Finding(
            kind="imu_mount",
            text=f"{where.partition('.')[2]}: gravity is {math.degrees(off):.0f} deg off its down axis: it reads "
            f"{vector_in_words((float(force[0]), float(force[1]), float(force[2])))} m/s^2 on average, 0 0 -9.8 is level",
            key=f"{where}.rotation_deg",
        )
