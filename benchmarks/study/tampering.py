"""What can happen to the events of a drive on their way: pure mappings of a list of events, in the order of receipt.

A mapping gets the events, the receipt [ns] from which on it acts, and a generator of its own, and gives the events that
the estimator is fed in place of them. `lasting` limits one to a time and `together` joins several.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from msgspec.structs import replace

from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Received, Vector3, WheelSpeed
from fusiond.maths.typed import Array
from fusiond.simulation.wgs84 import radii
from fusiond.units import SECOND, nanoseconds

Random = np.random.Generator
Tamper = Callable[[Sequence[Received], int, Random], list[Received]]
Edit = Callable[[Received, float], Received | None]  # an event and its time since the beginning [s] to what becomes of it
Shift = Callable[[float], float]  # time since the beginning [s] to metres, or metres a second

GYRO, ACCEL = "gyro", "accel"


def edited(edit: Callable[[Random], Edit], seconds: float = math.inf) -> Tamper:
    """Change, or with None remove, each event that is received from the beginning on, for so many seconds. `edit` is made
    anew for each drive, so it may remember what it has seen."""

    def tamper(events: Sequence[Received], begin_ns: int, random: Random) -> list[Received]:
        change = edit(random)
        found = []
        for event in events:
            since = (event.t_receive_ns - begin_ns) / SECOND
            kept = change(event, since) if 0 <= since < seconds else event
            if kept is not None:
                found.append(kept)
        return found

    return tamper


def later(seconds: float, tamper: Tamper) -> Tamper:
    """The mapping, begun so much later."""
    return lambda events, begin_ns, random: tamper(events, begin_ns + nanoseconds(seconds), random)


def together(*tampers: Tamper) -> Tamper:
    """One mapping after the other."""

    def tamper(events: Sequence[Received], begin_ns: int, random: Random) -> list[Received]:
        found = list(events)
        for one in tampers:
            found = one(found, begin_ns, random)
        return found

    return tamper


def nothing(events: Sequence[Received], begin_ns: int, random: Random) -> list[Received]:
    """No harm."""
    return list(events)


# --- The inertial sensor

Reading = Callable[[float, float], float]  # what an axis reads, and the sign that was drawn, to what it is made to read


def inertial(sensor: str, axes: str, reading: Reading, seconds: float = math.inf, samples: int | None = None) -> Tamper:
    """Change the readings of axes ("x", "yz") of the gyro or the accelerometer, for some seconds or samples."""

    def make(random: Random) -> Edit:
        sign = float(random.choice((-1.0, 1.0)))
        left = [math.inf if samples is None else samples]

        def edit(event: Received, since: float) -> Received:
            if not isinstance(event.payload, ImuSample) or left[0] < 1:
                return event
            left[0] -= 1
            force, rate = event.payload.specific_force_b, event.payload.angular_rate_b
            if sensor == GYRO:
                return replace(event, payload=ImuSample(force, _changed(rate, axes, reading, sign)))
            return replace(event, payload=ImuSample(_changed(force, axes, reading, sign), rate))

        return edit

    return edited(make, seconds)


def _changed(vector: Vector3, axes: str, reading: Reading, sign: float) -> Vector3:
    x, y, z = (reading(value, sign) if axis in axes else value for axis, value in zip("xyz", vector, strict=True))
    return x, y, z


def reads(value: float) -> Reading:
    """The value, of either sign."""
    return lambda _, sign: sign * value


def adds(value: float) -> Reading:
    """So much more or less."""
    return lambda reading, sign: reading + sign * value


def clipped(limit: float) -> Reading:
    """No more than a limit, either way."""
    return lambda reading, _: max(-limit, min(limit, reading))


def frozen(seconds: float, sensor: str, axes: str) -> Tamper:
    """Axes go on to give their last reading."""

    def make(_: Random) -> Edit:
        held: list[Vector3] = []

        def edit(event: Received, __: float) -> Received:
            if not isinstance(event.payload, ImuSample):
                return event
            force, rate = event.payload.specific_force_b, event.payload.angular_rate_b
            now = rate if sensor == GYRO else force
            held[:] = held or [now]
            x, y, z = (old if axis in axes else new for axis, old, new in zip("xyz", held[0], now, strict=True))
            return replace(event, payload=ImuSample(force, (x, y, z)) if sensor == GYRO else ImuSample((x, y, z), rate))

        return edit

    return edited(make, seconds)


def silent(kind: type, seconds: float) -> Tamper:
    """No events with this kind of payload."""
    return edited(lambda _: lambda event, since: None if isinstance(event.payload, kind) else event, seconds)


# --- The GNSS receiver


def moved(place: GnssPosition, offset: Array) -> GnssPosition:
    """The position with an offset (2,) [m], north and east."""
    meridian, transverse = radii(np.array(place.latitude))
    return replace(
        place,
        latitude=place.latitude + float(offset[0] / (meridian + place.height)),
        longitude=place.longitude + float(offset[1] / ((transverse + place.height) * math.cos(place.latitude))),
    )


def spoof(offset: Shift, speed: Shift, seconds: float) -> Tamper:
    """The position is off by so many metres, the velocity by so many metres a second, in one horizontal direction."""

    def make(random: Random) -> Edit:
        course = random.uniform(-math.pi, math.pi)
        ahead = np.array([math.cos(course), math.sin(course)])

        def edit(event: Received, since: float) -> Received:
            payload = event.payload
            if isinstance(payload, GnssPosition):
                return replace(event, payload=moved(payload, offset(since) * ahead))
            if isinstance(payload, GnssVelocity):
                north, east = (speed(since) * ahead).tolist()
                return replace(event, payload=replace(payload, north=payload.north + north, east=payload.east + east))
            return event

        return edit

    return edited(make, seconds)


def position_only(rate: float, seconds: float) -> Tamper:
    """A position that creeps off while the velocity is right."""
    return spoof(lambda since: rate * since, lambda _: 0.0, seconds)


def with_velocity(rate: float, seconds: float, step: float = 0.0) -> Tamper:
    """A position that drifts off, after a step [m], and a velocity that agrees with the drift."""
    return spoof(lambda since: step + rate * since, lambda _: rate, seconds)


def jump(metres: float, seconds: float) -> Tamper:
    """A position that is elsewhere."""
    return spoof(lambda _: metres, lambda _: 0.0, seconds)


def meaconed(growth: float, seconds: float) -> Tamper:
    """Old fixes with new stamps: their age grows by so many seconds a second."""

    def tamper(events: Sequence[Received], begin_ns: int, random: Random) -> list[Received]:
        kinds = GnssPosition, GnssVelocity
        past = {kind: [event for event in events if isinstance(event.payload, kind)] for kind in kinds}
        times = {kind: [event.t_receive_ns for event in kept] for kind, kept in past.items()}

        def make(_: Random) -> Edit:
            def edit(event: Received, since: float) -> Received:
                kind = type(event.payload)
                if kind not in past:
                    return event
                then = event.t_receive_ns - nanoseconds(growth * since)
                index = int(np.searchsorted(times[kind], then, side="right")) - 1
                return replace(event, payload=past[kind][max(index, 0)].payload)

            return edit

        return edited(make, seconds)(events, begin_ns, random)

    return tamper


def outage(seconds: float) -> Tamper:
    """No fixes."""
    return together(silent(GnssPosition, seconds), silent(GnssVelocity, seconds))


# --- The wheels


def wheels(factor: float, seconds: float = math.inf, which: Sequence[str] = ()) -> Tamper:
    """Wheels, all of them unless named, turn at so many times their speed; 0: they stand, or their channel is dead."""

    def edit(event: Received, since: float) -> Received:
        if isinstance(event.payload, WheelSpeed) and (not which or event.source in which):
            return replace(event, payload=replace(event.payload, speed=event.payload.speed * factor))
        return event

    return edited(lambda _: edit, seconds)


def forged_wheels(rate_hz: float, seconds: float, fastest: float) -> Tamper:
    """Frames that say anything up to a speed [m/s], for all wheels, come as well at random instants."""

    def tamper(events: Sequence[Received], begin_ns: int, random: Random) -> list[Received]:
        last = {event.source: event for event in events if isinstance(event.payload, WheelSpeed)}
        sequence = {source: event.sequence for source, event in last.items()}
        found = list(events)
        for since in np.sort(random.uniform(0.0, seconds, round(rate_hz * seconds))):
            t_ns = begin_ns + nanoseconds(float(since))
            for source, event in last.items():
                sequence[source] += 1
                speed = WheelSpeed(float(random.uniform(-fastest, fastest)))
                found.append(replace(event, sequence=sequence[source], t_receive_ns=t_ns, payload=speed))
        return sorted(found, key=lambda event: event.t_receive_ns)

    return tamper
