"""What GNSS says of the wheels: unit, sign, radius, offset, the right signal, and on which side of the vehicle they are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.diagnosis.finding import Finding
from fusiond.app.diagnosis.fits import MIN_READINGS, SURE, Fit, fit
from fusiond.app.mounting.windows import BIN, MAX_GAP, at
from fusiond.config.schema import Config, Wheel
from fusiond.maths.typed import Array

METRES_PER_SECOND = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "knots": 0.514444}  # of one unit
PER_RADIUS = {"rad/s": 1.0, "rpm": 2 * math.pi / 60}
MOVING = 1.0  # m/s, by GNSS
UNIT_SHARE = 0.06  # how far a factor may be from that of a unit: tyres, and the wheels' own scale
LEAST_SHARE = 0.05  # a scale that differs by less is learnt, or does little harm
RELATED = 0.7  # share of a wheel's changes that the speed must explain for it to be that of a wheel
SILENT_SHARE = 0.02  # a wheel that reads less of the speed reads nothing
OFFSET = 1.0  # m/s: a smaller constant is a matter of quantisation
MOST = 0.5  # of the readings
VARIED = 1.0  # m/s: standard deviation of a speed that varies
OTHER_SIDE_M = 0.3  # how far from the middle a wheel is at the least, to be on a side


class Compared(NamedTuple):
    """One wheel against GNSS, at the instants of the receiver's velocities in motion."""

    name: str
    section: Wheel
    reading: Array  # (K,) m/s
    line: Fit  # reading = line[0] * speed + line[1]
    through: Fit  # reading = through[0] * speed


class Motion(NamedTuple):
    """The vehicle by GNSS, at K instants in motion."""

    receiver: str
    t: Array  # (K,) s
    speed: Array  # (K,) m/s
    course: Array  # (K,) rad, without jumps
    turn: Array  # (K,) rad/s, to the right; nan where slow


def motion_by_gnss(evidence: Evidence) -> Motion | None:
    """The motion by the receiver with the most velocities; None if it is too short."""
    name = max(evidence.velocities, key=lambda one: len(evidence.velocities[one]), default=None)
    if name is None or len(evidence.velocities[name]) < MIN_READINGS:
        return None
    t, velocity = evidence.velocities[name].arrays()
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    turn = np.full(len(t), math.nan)
    apart = t[2:] - t[:-2]
    slow = np.minimum(np.minimum(speed[2:], speed[:-2]), speed[1:-1]) < 3 * MOVING
    turn[1:-1] = np.where(slow | (apart > MAX_GAP), math.nan, (course[2:] - course[:-2]) / apart)
    return Motion(name, t, speed, course, turn)


def wheel_findings(evidence: Evidence) -> Iterator[Finding]:
    """What is wrong with the wheels, by GNSS."""
    motion = motion_by_gnss(evidence)
    if motion is None:
        return
    moving = motion.speed > MOVING
    motion = Motion(motion.receiver, *(column[moving] for column in motion[1:]))
    compared = [found for name in evidence.config.wheel if (found := _compared(evidence, name, motion))]
    alike: dict[tuple[str, str, str], list[Compared]] = {}  # findings of several wheels in the same words
    told: dict[tuple[str, str, str], tuple[str, Finding]] = {}
    for one in compared:
        for text, finding in _of_one(one, motion, evidence.config):
            same = (finding.kind, finding.value, finding.key.rpartition(".")[2])
            alike.setdefault(same, []).append(one)
            told.setdefault(same, (text, finding))
    for same, wheels in alike.items():
        text, finding = told[same]
        yield Finding(kind=finding.kind, text=f"{_names(wheels)} {text}", key=finding.key, value=finding.value)
    if not told:
        yield from _sides(compared, motion)


def _compared(evidence: Evidence, name: str, motion: Motion) -> Compared | None:
    bins = evidence.gathering.wheels[name]
    if len(bins) < MIN_READINGS:
        return None
    reading = at(bins, motion.t / BIN, 1)[:, 0]
    line = fit([motion.speed, np.ones(len(motion.t))], reading)
    through = fit([motion.speed], reading)
    return Compared(name, evidence.config.wheel[name], reading, line, through) if line and through else None


def _of_one(one: Compared, motion: Motion, config: Config) -> Iterator[tuple[str, Finding]]:
    """What is wrong with one wheel: a text that follows the names of those for which it is true, and the finding."""
    where, section = f"wheel.{one.name}", one.section
    signal = f"{where}.signal" if section.bus is not None else f"{where}.index"
    known = np.isfinite(one.reading)
    speed, reading = motion.speed[known], one.reading[known]
    ratio, (share, offset) = float(one.through.values[0]), one.line.values.tolist()
    varied = float(np.std(speed)) > VARIED
    constant = abs(offset) > max(SURE * one.line.sigmas[1], OFFSET) and one.line.rest < one.through.rest / 2
    if float(np.mean(np.abs(reading))) < SILENT_SHARE * float(np.mean(speed)):
        yield _told("wheel_zero", f"reads 0 while GNSS says {np.mean(speed):.1f} m/s on average", signal)
        return
    if varied and one.line.explained < RELATED:
        percent = 100 * one.line.explained
        words = f"does not follow the vehicle: its speed by GNSS explains {percent:.0f} % of it; is it the right signal?"
        yield _told("wheel_unrelated", words, signal)
        return
    if varied and constant:
        words = (
            f"reads {share:.2f} times the speed by GNSS and {offset:+.1f} m/s: is the offset of the signal in the DBC right?"
        )
        yield _told("wheel_offset", words, f"can.{section.bus}.dbc" if section.bus else signal)
        return
    fast = speed > max(config.filter.course_speed_mps, MOVING)
    if ratio < 0 and fast.any() and float(np.mean(reading[fast] < 0)) > MOST:
        words = f"reads backwards, {ratio:.2f} times the speed by GNSS, above {config.filter.course_speed_mps:g} m/s"
        yield _told("wheel_sign", words, f"{where}.scale", f"{-section.scale:g}")
    tolerance = max(SURE * math.hypot(config.filter.wheel_scale_sigma, float(one.through.sigmas[0])), LEAST_SHARE)
    if abs(abs(ratio) - 1) > tolerance:
        yield _of_scale(where, section, abs(ratio))


def _of_scale(where: str, section: Wheel, size: float) -> tuple[str, Finding]:
    """A wheel that reads `size` times too much."""
    words = f"reads {size:.3g} times the speed by GNSS"
    unit = _unit(section, size)
    if unit is not None:
        return _told("wheel_unit", f"{words}: is the unit {unit}, not {section.unit}?", f"{where}.unit", f'"{unit}"')
    if section.unit in PER_RADIUS and section.radius_m is not None:
        radius = section.radius_m / size
        return _told("wheel_radius", f"{words}: is the radius {radius:.3g} m?", f"{where}.radius_m", f"{radius:.3g}")
    scale = section.scale / size
    return _told("wheel_scale", f"{words}: is its scale {scale:.3g}?", f"{where}.scale", f"{scale:.3g}")


def _unit(section: Wheel, size: float) -> str | None:
    """The unit with which the wheel would read the vehicle's speed, if there is one."""
    factors = dict(METRES_PER_SECOND)
    if section.radius_m is not None:
        factors |= {unit: factor * section.radius_m for unit, factor in PER_RADIUS.items()}
    now = factors.get(section.unit, 0.0)
    near = [unit for unit, factor in factors.items() if unit != section.unit and abs(size * factor / now - 1) < UNIT_SHARE]
    return near[0] if near and near[0] in ("m/s", "km/h", "mph", "rad/s", "rpm") else None


def _sides(compared: list[Compared], motion: Motion) -> Iterator[Finding]:
    """Wheels that are on the other side of the vehicle: in a bend the outer ones are faster, by the turn rate times their
    distance from the middle."""
    if len(compared) < 2:
        return
    mean = np.mean([one.reading / one.through.values[0] for one in compared], axis=0)
    middle = float(np.mean([one.section.position_m[1] for one in compared]))
    wrong = []
    for one in compared:
        side = one.section.position_m[1] - middle
        found = fit([-motion.turn, motion.speed], one.reading / one.through.values[0] - mean)
        if found is None or abs(side) < OTHER_SIDE_M:
            continue
        place, sigma = float(found.values[0]), float(found.sigmas[0])
        if place * side < 0 and abs(place) > SURE * sigma and abs(place - side) > SURE * sigma and abs(place) > OTHER_SIDE_M:
            wrong.append((one, place, side))
    if wrong:
        first, place, side = wrong[0]
        yield Finding(
            kind="wheel_side",
            text=f"{_names([one for one, _, _ in wrong])} on the other side: in bends {first.name} moves as a wheel "
            f"{abs(place):.1f} m {_side(place)} of the middle, and is configured {abs(side):.1f} m {_side(side)}",
            key=f"wheel.{first.name}.position_m",
        )


def _side(right: float) -> str:
    return "right" if right > 0 else "left"


def _told(kind: str, words: str, key: str, value: str = "") -> tuple[str, Finding]:
    return words, Finding(kind=kind, text="", key=key, value=value)


def _names(wheels: list[Compared]) -> str:
    return ", ".join(one.name for one in wheels) + ("" if len(wheels) == 1 else ": each")
