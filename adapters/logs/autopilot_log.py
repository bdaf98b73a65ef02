"""The logs that autopilots keep themselves: samples by column into events of a link's sensors.

A sample becomes the fields of the MAVLink message that the autopilot sends of it, and goes through that message's handler:
so one configuration reads the link, its .tlog and the autopilot's own log alike. `t_receive_ns` is when the autopilot logged
the sample. Its boot time is put on the Unix time line by the first fix; fixes have a clock of their own, `<link>/gps`, since
a log does not tell how late they came (`delay_ms` of the receiver).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fusiond.config.schema import Barometer, Config, DualAntenna, Gnss, Imu
from fusiond.config.sensor import Sensor
from fusiond.events import AnyPayload, Received, boot_clock
from fusiond.units import MICROSECOND
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.format import Opening
from fusiond_adapters.mavlink.decoder import UNIX_FROM_US
from fusiond_adapters.mavlink.sensors import ACCEL_AND_GYRO, HANDLERS, MILLI_G, NORTH, PASCAL, Handler, Stamp

Array = npt.NDArray[Any]
Columns = Mapping[str, Array]

INSTANCES = {  # the sensor, counted from 0, that a message is of
    "RAW_IMU": 0, "SCALED_IMU": 0, "SCALED_IMU2": 1, "SCALED_IMU3": 2,
    "SCALED_PRESSURE": 0, "SCALED_PRESSURE2": 1, "SCALED_PRESSURE3": 2,
    "GPS_RAW_INT": 0, "GPS2_RAW": 1,
}  # fmt: skip
MILLI_RAD = 1e-3


class Samples(NamedTuple):
    """Samples of one sensor."""

    handler: Handler
    order: Array  # (n,) in the log
    t_us: Array  # (n,) when they were logged, from boot
    fields: Columns  # (n,) or (n, k) each, as in the sensor's MAVLink message


class AutopilotLog:
    """The sensors of a link whose autopilot kept the log. Raises LogError where no such link is configured."""

    def __init__(self, opening: Opening) -> None:
        path, links = opening.file.path, opening.config.mavlink
        if not links:
            raise LogError(f"{path}: the configuration has no [mavlink.NAME] for it")
        link = next(iter(links)) if opening.name is None else opening.name
        if link not in links:
            raise LogError(f"{link}={path}: is an autopilot's log; configured links: {', '.join(links)}")
        self.counts = dict.fromkeys(("decoded", "other instances"), 0)
        self.base_ns = 0  # Unix time of the boot
        self._sequences = opening.sequences
        self._boot, self._gps = boot_clock(link), f"{link}/gps"
        self.sensors = list(_sensors(self, opening.config, link))

    def event(self, source: str, stamp: Stamp, t_receive_ns: int, payload: AnyPayload) -> Received:
        """The next event of a source."""
        sequence = self._sequences[source] = self._sequences.get(source, -1) + 1
        return Received(source, sequence, stamp[0], stamp[1], t_receive_ns, payload)

    def stamp(self, time_us: int) -> Stamp:
        """Clock and stamp of a field `time_usec`: boot time, or the Unix time of a fix. None if it is 0."""
        if time_us <= 0:
            return "", None
        return (self._boot if time_us < UNIX_FROM_US else self._gps), time_us * MICROSECOND

    def events(self, samples: Iterable[Samples]) -> Iterator[list[Received]]:
        """The events of samples, in the order of the log."""
        some = [one for one in samples if len(one.order)]
        if not some:
            return
        rows = list(chain.from_iterable(_rows(one) for one in some))
        for place in np.argsort(np.concatenate([one.order for one in some]), kind="stable").tolist():
            handler, t_us, fields = rows[place]
            self.counts["decoded"] += 1
            found = handler.events(fields, self.base_ns + t_us * MICROSECOND)
            if found:
                yield found


def _sensors(decoder: AutopilotLog, config: Config, link: str) -> Iterator[tuple[Sensor, Handler]]:
    for _, name, section in config.sensors(link=link):
        yield section, HANDLERS[type(section)](decoder, name, section, config)


def _rows(samples: Samples) -> Iterator[tuple[Handler, int, tuple[Any, ...]]]:
    """Handler, stamp and fields of each sample."""
    columns: list[list[Any]] = []
    for name in samples.handler.fields:
        column = samples.fields[name]
        columns += [column.tolist()] if column.ndim == 1 else [part.tolist() for part in column.T]
    for t_us, fields in zip(samples.t_us.tolist(), zip(*columns, strict=True), strict=True):
        yield samples.handler, t_us, fields


def instance(section: Sensor) -> int:
    """Which sensor of its kind, counted from 0, a section reads."""
    if isinstance(section, Imu) and section.message == "HIGHRES_IMU":
        return section.instance
    assert isinstance(section, Imu | Gnss | DualAntenna | Barometer), "wheels are told apart by their index"
    return INSTANCES[section.message]


def imu_fields(section: Imu, t_us: Array, force: Array, rate: Array) -> Columns:
    """The fields of an inertial message. `force`: (n, 3) [m/s^2]; `rate`: (n, 3) [rad/s]."""
    is_si = section.message == "HIGHRES_IMU"
    if not is_si:
        force, rate = force / MILLI_G, rate / MILLI_RAD
    names = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")
    whole = dict(zip(names, (*force.T, *rate.T), strict=True))
    flags = np.full(len(t_us), ACCEL_AND_GYRO)
    number = np.full(len(t_us), section.instance)
    return whole | {"time_usec": t_us, "time_boot_ms": t_us // 1000, "fields_updated": flags, "id": number}


def gnss_fields(
    t_us: Array, fix_type: Array, place: Array, motion: Array, sigmas: Array, yaw_deg: Array | None = None
) -> Columns:
    """The fields of a fix. `t_us`: of its time, Unix or boot; `place`: (n, 3) latitude and longitude [deg], height [m];
    `motion`: (n, 2) speed [m/s], course [deg]; `sigmas`: (n, 3) of position and height [m] and speed [m/s], 0 where unknown;
    `yaw_deg`: of two antennas."""
    none = np.zeros(len(t_us), np.int64)
    yaw = none if yaw_deg is None else np.where(yaw_deg == 0, 0, (np.rint(yaw_deg * 100).astype(np.int64) - 1) % NORTH + 1)
    return {
        "time_usec": t_us, "fix_type": fix_type.astype(np.int64),
        "lat": place[:, 0] * 1e7, "lon": place[:, 1] * 1e7, "alt": place[:, 2] * 1e3, "alt_ellipsoid": none,
        "vel": motion[:, 0] * 1e2, "cog": motion[:, 1] % 360 * 1e2,
        "h_acc": sigmas[:, 0] * 1e3, "v_acc": sigmas[:, 1] * 1e3, "vel_acc": sigmas[:, 2] * 1e3,
        "hdg_acc": none, "yaw": yaw,
    }  # fmt: skip


def wheel_fields(t_us: Array, distances: Array) -> Columns:
    """The fields of the distances that wheels have rolled: (n, k) [m]. The message has 16."""
    count, wheels = distances.shape
    padded = np.zeros((count, 16))
    padded[:, :wheels] = distances
    return {"time_usec": t_us, "count": np.full(count, wheels), "distance": padded}


def pressure_fields(t_us: Array, pressure: Array, celsius: Array) -> Columns:
    """The fields of a barometer: pressure [Pa], temperature [degrees Celsius]."""
    return {"time_boot_ms": t_us // 1000, "press_abs": pressure / PASCAL, "temperature": celsius * 100}


