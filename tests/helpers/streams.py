"""Configurations, drives and measurements for the tests of the filter. Everything is seeded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, Payload, WheelSpeed
from fusiond.filter.rows import ROW, Outcome
from fusiond.filter.state import (
    ERROR_SIZE,
    PHASE,
    POSITION_E,
    QUATERNION_EB,
    RESET_REASON,
    RESET_SOURCE,
    RESETS,
    RUNNING,
    T_FIRST_VELOCITY,
    T_POSITION,
    VELOCITY_E,
    YAW_RATE_OFFSET,
    FilterState,
    ResetReason,
    T,
)
from fusiond.maths.rotation import matrix_from_euler, quaternion
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import EARTH_RATE, ecef, geodetic, gravity_e, mat_ne, radii
from fusiond.units import MILLISECOND as MS
from fusiond.units import SECOND, nanoseconds

T0 = 1_700_000_000 * SECOND
MUNICH = (math.radians(48.1), math.radians(11.6), 520.0)  # rad, rad, m
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
EARTH_RATE_E = np.array([0.0, 0.0, EARTH_RATE])
WHITE = {"position_correlation_s": 0.0, "velocity_correlation_s": 0.0, "stamp_sigma_ms": 0.0}  # as `measurements` has it
PULLS_AWAY_S = 3.0  # when drives that begin at rest pull away
Curve = Callable[[Array], Array]


def ramp(t: Array, begin: float, length: float) -> Array:
    """From 0 to 1 in `length` seconds, smoothly."""
    u = np.clip((t - begin) / length, 0.0, 1.0)
    return u * u * (3 - 2 * u)


def ramped(t: Array, begin: float, length: float) -> Array:
    """The integral of a ramp over the time."""
    u = np.clip((t - begin) / length, 0.0, 1.0)
    return length * (u**3 - u**4 / 2) + np.clip(t - begin - length, 0.0, None)


def config(wheels: Iterable[str] = WHEELS, **tables: dict[str, Any]) -> Config:
    """A configuration of one IMU, one GNSS receiver of white errors and some wheels; `tables` holds keys of filter, motion,
    imu, gnss and of all wheels (wheel)."""
    wheel = {"bus": "bus", "message": "m", "signal": "s"} | tables.pop("wheel", {})
    raw = {
        "mavlink": {"link": {}},
        "can": {"bus": {}},
        "imu": {"imu0": {"link": "link"} | tables.pop("imu", {})},
        "gnss": {"gps0": {"link": "link"} | WHITE | tables.pop("gnss", {})},
        "wheel": dict.fromkeys(wheels, wheel),
    }
    return msgspec.convert(raw | tables, Config)


@dataclass(frozen=True, slots=True)
class Drive:
    """A level vehicle's true motion at N instants; the inertial quantities are those that an ideal IMU measures."""

    seconds: Array  # (N,)
    position_e: Array  # (N, 3) m
    velocity_e: Array  # (N, 3) m/s
    mat_eb: Array  # (N, 3, 3)
    force_b: Array  # (N, 3) m/s^2
    rate_b: Array  # (N, 3) rad/s
    velocity_n: Array  # (N, 3) m/s
    speed: Array  # (N,) m/s

    def at(self, second: float) -> int:
        return int(np.searchsorted(self.seconds, second - 1e-9))


def drive(
    duration: float, speed: Curve, yaw: Curve, rate: float = 100.0, start: tuple[float, float, float] = MUNICH
) -> Drive:
    """Drive with a forward speed [m/s] and a yaw [rad], both smooth functions of time [s], at constant height."""
    dt = 1 / rate
    seconds = np.arange(round(duration * rate) + 1) * dt
    speeds, yaws = speed(seconds) + 0 * seconds, yaw(seconds) + 0 * seconds
    velocity_n = np.stack([speeds * np.cos(yaws), speeds * np.sin(yaws), 0 * speeds], axis=1)
    position_e, velocity_e, mat_eb = [], [], []
    latitude, longitude, height = start
    for k in range(len(seconds)):
        if k:
            north, east, _ = (velocity_n[k - 1] + velocity_n[k]) / 2 * dt
            meridian, transverse = radii(latitude)
            latitude, longitude = (
                latitude + north / (meridian + height),
                longitude + east / ((transverse + height) * math.cos(latitude + north / meridian / 2)),
            )
        position_e.append(ecef(latitude, longitude, height))
        to_n = mat_ne(position_e[-1])
        velocity_e.append(to_n.T @ velocity_n[k])
        mat_eb.append(to_n.T @ matrix_from_euler(0.0, 0.0, float(yaws[k])))
    r, v, c = np.array(position_e), np.array(velocity_e), np.array(mat_eb)
    gravity = np.array([gravity_e(place) for place in r])
    force_e = np.gradient(v, dt, axis=0) + 2 * np.cross(EARTH_RATE_E, v) - gravity
    turning = np.einsum("kji,kjl->kil", c, np.gradient(c, dt, axis=0))  # skew of the rate against the earth
    over_earth = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
    rate_b = over_earth + np.einsum("kji,j->ki", c, EARTH_RATE_E)
    force_b = np.einsum("kji,kj->ki", c, force_e)
    return Drive(seconds, r, v, c, force_b, rate_b, velocity_n, speeds)


def town(duration: float, rate: float = 100.0, start: tuple[float, float, float] = MUNICH) -> Drive:
    """Pulls away after 3 s, weaves, and changes its speed all the time; stands again from second 35 to 40."""

    def speed(t: Array) -> Array:
        going = ramp(t, 3.0, 4.0) - ramp(t, 30.0, 5.0) + ramp(t, 40.0, 4.0)
        return going * (12.0 + 2.0 * np.sin(0.4 * t))

    def yaw(t: Array) -> Array:
        under_way = t - ramped(t, 33.0, 2.0) + ramped(t, 40.0, 2.0)  # it does not turn where it stands
        return 0.7 + 0.8 * np.sin(0.15 * under_way) * ramp(t, 3.0, 6.0)

    return drive(duration, speed, yaw, rate, start)


def measurements(
    truth: Drive,
    wheels: Iterable[str] = WHEELS,
    seed: int | None = 1,
    gnss_hz: float = 5.0,
    wheel_hz: float = 20.0,
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
    accel_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Measurement]:
    """The measurements of a drive by the sensors of `config`, in the order of their stamps; without noise if seed is None.
    At rest the IMU has a tenth of its noise on the road."""
    rng = np.random.default_rng(seed or 0)
    strength = 0.0 if seed is None else 1.0
    step = truth.seconds[1] - truth.seconds[0]
    events: list[Measurement] = []

    def add(source: str, k: int, sequence: int, payload: Payload, offset_ns: int = 0) -> None:
        t_ns = T0 + nanoseconds(float(truth.seconds[k])) + offset_ns
        events.append(Measurement(t_ns, source, sequence, t_ns + 5 * MS, payload))

    def noise(sigma: float, size: int = 3) -> Array:
        return strength * sigma * rng.standard_normal(size)

    for k in range(len(truth.seconds)):
        shaken = 1.0 if abs(truth.speed[k]) > 0.1 else 0.1
        force = truth.force_b[k] + shaken * noise(0.05 / math.sqrt(step)) + accel_bias
        rate = truth.rate_b[k] + shaken * noise(0.002 / math.sqrt(step)) + gyro_bias
        add("imu0", k, k, ImuSample(triple(force), triple(rate)))
    for i, k in enumerate(range(3, len(truth.seconds), round(1 / gnss_hz / step))):
        off = noise(1.0)
        latitude, longitude, height = geodetic(truth.position_e[k] + mat_ne(truth.position_e[k]).T @ off)
        add("gps0.position", k, i, GnssPosition(latitude, longitude, height, 1.0, 1.0))
        north, east, down = triple(truth.velocity_n[k] + noise(0.1))
        add("gps0.velocity", k, i, GnssVelocity(north, east, down, 0.1))
    for place, name in enumerate(wheels):
        for i, k in enumerate(range(place, len(truth.seconds) - 1, round(1 / wheel_hz / step))):
            reading = abs(float(truth.speed[k] + noise(0.05, 1)[0])) if abs(truth.speed[k]) > 0.1 else 0.0
            add(name, k, i, WheelSpeed(reading), nanoseconds(step) // 4 * (place % 3))
    return sorted(events, key=lambda event: event.key)


def triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def fuse(configuration: Config, events: Iterable[Measurement], compiled: bool | None = None) -> Fusion:
    """A fusion that has fused the events in the order given."""
    fusion = Fusion(configuration, compiled)
    for event in events:
        fusion.fuse(event)
    return fusion


def running_state(
    rng: np.random.Generator,
    sources: int = 7,
    start: tuple[float, float, float] = MUNICH,
    size: int = ERROR_SIZE,
) -> FilterState:
    """A running filter state with random values of realistic size, and a full covariance."""
    state = FilterState(sources, size)
    x = state.nominal[: size + 1]
    x[: YAW_RATE_OFFSET.start] = rng.normal(0.0, 0.01, len(x[: YAW_RATE_OFFSET.start]))  # of the car's own sensors nothing
    x[POSITION_E] = ecef(*start) + rng.normal(0.0, 100.0, 3)
    x[VELOCITY_E] = rng.normal(0.0, 10.0, 3)
    x[QUATERNION_EB] = quaternion(matrix_from_euler(*(float(a) for a in rng.uniform(-1.5, 1.5, 3))))
    root = rng.normal(0.0, 1.0, (state.size, state.size)) + 2 * np.eye(state.size)
    sigmas = [1.0, 0.3, 0.03, 1e-3, 0.05, 5e-3, 1.0, 5e-3, 0.1, 0.05, 3.0, 0.05, 0.01, 0.01]
    scale = np.repeat(sigmas, [3, 3, 3, 3, 3, 3, 3, 3, 3, 2, 1, 2, 1, 4])[:size]
    covariance = scale[:, None] * (root @ root.T) * scale / size
    state.covariance[:] = (covariance + covariance.T) / 2
    state.auxiliary[:12] = rng.normal(0.0, 0.3, 12)
    state.auxiliary[[2, 8]] -= 9.8
    state.stamps[PHASE] = RUNNING
    state.stamps[T] = state.stamps[T_POSITION] = state.stamps[T_FIRST_VELOCITY] = T0
    return state


def apply(configuration: Config, state: FilterState, events: Iterable[Measurement], compiled: bool) -> Fusion:
    """Run events through the kernel from a running state, without a history. The result's history has the rows and the
    head."""
    fusion = Fusion(configuration, compiled)
    history, layout = fusion.history, fusion.params
    values = [(event, fusion._values(event)) for event in sorted(events, key=lambda event: event.key)]
    table = np.zeros(len(values) + 1, dtype=ROW)
    numbers, whole = np.zeros((len(values) + 2, len(state.numbers))), np.zeros((len(values) + 2, len(state.whole)), np.int64)
    numbers[0], whole[0] = state.numbers, state.whole
    history.head.copy_from(state)
    history.kernel.attach(history.head, table, history.counts, numbers, whole, np.zeros(len(numbers), np.int64))
    for i, (event, row) in enumerate(values):
        place = layout.sources.index(event.source)
        history.kernel.insert(i, i, event.t_ns, place, event.sequence, event.t_receive_ns, Outcome.WAITING, row)
    applied, _, done = history.kernel.run(0, len(values), 0, values[-1][0].t_ns, 1)
    assert done
    assert applied == len(values)
    history._table, history._end = table, len(values)
    return fusion


def same_bits(a: Fusion, b: Fusion) -> None:
    """Assert that two filters hold the same state, the same rows in common and the same counts, bit for bit."""
    np.testing.assert_array_equal(bits(a.history.head.numbers), bits(b.history.head.numbers))
    np.testing.assert_array_equal(a.history.head.whole, b.history.head.whole)
    np.testing.assert_array_equal(a.history.counts, b.history.counts)
    limit = max(a.history.settled_ns, b.history.settled_ns)
    first, second = (h.rows[h.rows["t_ns"] >= limit] for h in (a.history, b.history))
    for column in ("t_ns", "source", "sequence", "outcome", "values", "innovation", "variance", "ratio"):
        np.testing.assert_array_equal(first[column], second[column], err_msg=column)


def same_state(a: FilterState, b: FilterState) -> None:
    """Assert that two states hold the same bits."""
    np.testing.assert_array_equal(bits(a.numbers), bits(b.numbers))
    np.testing.assert_array_equal(a.whole, b.whole)


def reset_by(fusion: Fusion) -> tuple[int, ResetReason, str]:
    """Number of resets; the last one's reason, and its source."""
    stamps = fusion.history.head.stamps
    return int(stamps[RESETS]), ResetReason(int(stamps[RESET_REASON])), fusion.params.sources[int(stamps[RESET_SOURCE])]


def bits(numbers: Array) -> np.ndarray:
    """The numbers as integers: -0 and 0 differ, and equal NaN compare equal."""
    return np.ascontiguousarray(numbers).view(np.int64)
