"""The sensors of an autopilot: from the fields of MAVLink messages to events. No I/O."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from fusiond.config.schema import Barometer, Config, DualAntenna, Gnss, Imu, Wheel
from fusiond.config.sensor import Sensor
from fusiond.events import (
    AnyPayload,
    GnssYaw,
    ImuSample,
    Invalid,
    Pressure,
    Received,
    WheelSpeed,
)
from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.payloads import InertialAxes, gnss_position, velocity_by_course

MILLI_G = 9.80665e-3  # m/s^2
UNKNOWN_U16 = 65535
NORTH = 36000  # centidegrees: a yaw of 0
ACCEL_AND_GYRO = 0x3F  # HIGHRES_IMU.fields_updated
MIN_INTERVAL_NS = 2 * MILLISECOND  # a message that repeats the previous one sooner than this is a copy of it
MAX_INTERVAL_NS = 2 * SECOND  # the middle of a longer interval is older than what is fused
JERK = 2.0  # m/s^3, of a vehicle on wheels
RESET_M = 1.0  # a counter that falls to exactly 0 from more than this has been reset
PASCAL = 100.0  # in a hectopascal
FREEZING = 273.15  # K
MIN_TEMPERATURE, MAX_TEMPERATURE = 180.0, 400.0  # K, of a sensor that works
MIN_PRESSURE, MAX_PRESSURE = 1_000.0, 120_000.0  # Pa: 31 km up, below the Dead Sea

_AXES = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")
_IMU_STAMP = {"HIGHRES_IMU": "time_usec", "RAW_IMU": "time_usec"}
_IMU_EXTRA = {"HIGHRES_IMU": ("fields_updated", "id")}

Stamp = tuple[str, int | None]  # clock, stamp [ns]


class Decoder(Protocol):
    """The part of `MavlinkDecoder` that a handler needs."""

    counts: dict[str, int]

    def event(self, source: str, stamp: Stamp, t_receive_ns: int, payload: AnyPayload) -> Received: ...
    def stamp(self, time_us: int) -> Stamp: ...


class Handler(Protocol):
    """Makes events of the messages of one sensor: `events` gets the `fields` in this order, and the receive stamp."""

    @property
    def fields(self) -> tuple[str, ...]: ...
    def events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]: ...


class ImuHandler:
    """One [imu.NAME]: fields to ImuSample."""

    def __init__(self, decoder: Decoder, name: str, imu: Imu, _config: Config) -> None:
        self._decoder, self._name, self._imu = decoder, name, imu
        self.fields = (_IMU_STAMP.get(imu.message, "time_boot_ms"), *_AXES, *_IMU_EXTRA.get(imu.message, ()))
        self._axes = InertialAxes(imu)
        self._si = imu.message == "HIGHRES_IMU"
        self._stamp_us = 1 if imu.message in _IMU_STAMP else 1000  # unit of the stamp [us]

    def events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        decoder = self._decoder
        if self._si and fields[8] != self._imu.instance:
            decoder.counts["other instances"] += 1
            return []
        payload = self._payload(fields)
        return [decoder.event(self._name, decoder.stamp(fields[0] * self._stamp_us), t_receive_ns, payload)]

    def _payload(self, fields: tuple[Any, ...]) -> ImuSample | Invalid:
        force, rate = fields[1:4], fields[4:7]
        if not self._si:
            force = (force[0] * MILLI_G, force[1] * MILLI_G, force[2] * MILLI_G)
            rate = (rate[0] / 1e3, rate[1] / 1e3, rate[2] / 1e3)
        elif fields[7] & ACCEL_AND_GYRO != ACCEL_AND_GYRO:
            return Invalid("not updated")
        return self._axes.sample(force, rate)


class GnssHandler:
    """One [gnss.NAME]: fields to GnssPosition and GnssVelocity."""

    fields = (
        "time_usec", "fix_type", "lat", "lon", "alt", "vel", "cog",
        "alt_ellipsoid", "h_acc", "v_acc", "vel_acc",  # extensions
    )  # fmt: skip

    def __init__(self, decoder: Decoder, name: str, gnss: Gnss, _config: Config) -> None:
        self._decoder, self._gnss = decoder, gnss
        self._position, self._velocity = f"{name}.position", f"{name}.velocity"

    def events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        time_us, fix_type, lat, lon, alt, vel, cog, alt_ellipsoid, h_acc, v_acc, vel_acc = fields
        place = lat / 1e7, lon / 1e7, (alt_ellipsoid or alt) / 1e3
        position = gnss_position(self._gnss, fix_type, place, _known(h_acc), _known(v_acc))
        velocity: AnyPayload = position
        if not isinstance(position, Invalid):
            velocity = velocity_by_course(vel / 1e2, math.radians(cog / 1e2), _known(vel_acc))
        decoder = self._decoder
        stamp = decoder.stamp(time_us) if self._gnss.stamp == "sensor" else ("", None)
        events = [decoder.event(self._position, stamp, t_receive_ns, position)]
        if self._gnss.use_velocity and UNKNOWN_U16 not in (vel, cog):
            events.append(decoder.event(self._velocity, stamp, t_receive_ns, velocity))
        return events


class GnssYawHandler:
    """One [dual_antenna.NAME]: fields to GnssYaw.

    In MAVLink 0 means that the receiver gives no yaw; PX4 also sends it when there is none for the moment. It is counted
    as invalid, so that the health shows a receiver that is not set up for yaw.
    """

    fields = ("time_usec", "fix_type", "hdg_acc", "yaw")

    def __init__(self, decoder: Decoder, name: str, antennas: DualAntenna, _config: Config) -> None:
        self._decoder, self._name, self._antennas = decoder, name, antennas

    def events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        time_us, fix_type, accuracy, yaw = fields
        stamp = self._decoder.stamp(time_us) if self._antennas.stamp == "sensor" else ("", None)
        return [self._decoder.event(self._name, stamp, t_receive_ns, self._payload(fix_type, accuracy, yaw))]

    def _payload(self, fix_type: int, accuracy: int, yaw: int) -> GnssYaw | Invalid:
        if yaw == 0:
            return Invalid("no yaw given")
        if yaw == UNKNOWN_U16:
            return Invalid("no yaw at present")
        if yaw > NORTH:
            return Invalid("impossible yaw")
        if fix_type < self._antennas.minimum_fix_type:
            return Invalid("no fix")
        return GnssYaw(math.radians(yaw / 100), math.radians(accuracy / 1e5) if accuracy else None)


@dataclass(slots=True)
class _Reading:
    clock: str
    raw_ns: int  # the message's stamp
    t_ns: int  # that stamp; while it does not change, advanced by the receive stamps
    t_receive_ns: int
    distance: float  # m


class WheelHandler:
    """One [wheel.NAME] of WHEEL_DISTANCE: the mean speed between two messages, stamped at the middle between them.

    An encoder's stamp may be that of its last pulse (ArduPilot). It does not change while the wheel stands still: then the
    receive stamps give the elapsed time. The first message, and an immediate repeat of one, give no event.

    The speed at the middle of an interval T differs from the mean by jerk T^2 / 24 (the mean of t^2/2 over the interval):
    that is part of the reading's sigma, next to nothing at 10 Hz, and 0.08 m/s at the 1 Hz of a stock ArduPilot.
    """

    fields = ("time_usec", "count", "distance")

    def __init__(self, decoder: Decoder, name: str, wheel: Wheel, config: Config) -> None:
        self._decoder, self._name, self._wheel = decoder, name, wheel
        self._fastest = config.filter.v_max_mps
        self._last: _Reading | None = None

    def events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        time_us, count, *distances = fields
        clock, raw_ns = self._decoder.stamp(time_us)
        index = self._wheel.index
        if index is None or index >= count or raw_ns is None or not math.isfinite(distances[index]):
            reason = "no stamp" if raw_ns is None else "no such wheel" if index is None or index >= count else "not finite"
            return [self._decoder.event(self._name, (clock, raw_ns), t_receive_ns, Invalid(reason))]
        last = self._last
        t_ns = raw_ns
        if last is not None and (clock, raw_ns) == (last.clock, last.raw_ns):
            t_ns = last.t_ns + t_receive_ns - last.t_receive_ns
        reading = _Reading(clock, raw_ns, t_ns, t_receive_ns, distances[index])
        if last is None or last.clock != clock:
            self._last = reading
            return []
        interval_ns = t_ns - last.t_ns
        if abs(interval_ns) < MIN_INTERVAL_NS:
            return []
        self._last = reading
        middle_ns = t_ns if interval_ns < 0 else last.t_ns + interval_ns // 2
        payload = self._payload(last.distance, reading.distance, interval_ns)
        return [self._decoder.event(self._name, (clock, middle_ns), t_receive_ns, payload)]

    def _payload(self, before: float, after: float, interval_ns: int) -> WheelSpeed | Invalid:
        wheel = self._wheel
        if interval_ns < 0:
            return Invalid("clock went back")
        if interval_ns > MAX_INTERVAL_NS:
            return Invalid("gap")
        seconds = interval_ns / SECOND
        speed = (after - before) * wheel.scale / seconds
        if (after == 0.0 and abs(before) > RESET_M) or (wheel.unsigned and speed * wheel.scale < 0):
            return Invalid("counter reset")
        if abs(speed) > self._fastest:
            return Invalid("counter jumped")
        quantum = wheel.quantum_m * abs(wheel.scale) / math.sqrt(6) / seconds  # two readings, each with quantum^2 / 12
        return WheelSpeed(speed, math.hypot(quantum, JERK * seconds * seconds / 24))


class PressureHandler:
    """One [barometer.NAME]: fields to Pressure."""

    fields = ("time_boot_ms", "press_abs", "temperature")

    def __init__(self, decoder: Decoder, name: str, _barometer: Barometer, _config: Config) -> None:
        self._decoder, self._name = decoder, name

    def events(self, fields: tuple[Any, ...], t_receive_ns: int) -> list[Received]:
        boot_ms, hectopascal, centi_celsius = fields
        absolute, temperature = hectopascal * PASCAL, centi_celsius / 100 + FREEZING
        payload: AnyPayload = Pressure(absolute, temperature)
        if not MIN_PRESSURE <= absolute <= MAX_PRESSURE:
            payload = Invalid("impossible pressure" if math.isfinite(absolute) else "not finite")
        elif not MIN_TEMPERATURE <= temperature <= MAX_TEMPERATURE:
            payload = Invalid("impossible temperature")
        return [self._decoder.event(self._name, self._decoder.stamp(boot_ms * 1000), t_receive_ns, payload)]


HANDLERS: dict[type[Sensor], Callable[[Decoder, str, Any, Config], Handler]] = {
    Imu: ImuHandler,
    Gnss: GnssHandler,
    Wheel: WheelHandler,
    Barometer: PressureHandler,
    DualAntenna: GnssYawHandler,
}


def _known(thousandths: int) -> float | None:
    """An accuracy of the extension fields [mm or mm/s]; 0 means unknown."""
    return thousandths / 1e3 if thousandths else None
