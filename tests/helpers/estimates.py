"""Estimates of the filter and the messages made from them."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from fusiond.estimator.solution import Mode, Solution, SolutionState
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import OutcomeCounts, State, StateMessage

T_NS = 1_700_000_000_123_456_789
COUNTS = OutcomeCounts(fused=7, rejected=1)
SCALARS = ("latitude", "longitude", "height", "wheel_scale", "sigma_wheel_scale")
VECTORS = {
    "velocity_n": 3,
    "quaternion_nb": 4,
    "angular_rate_b": 3,
    "acceleration_b": 3,
    "gyro_bias": 3,
    "accel_bias": 3,
    "mount": 2,
    "sigma_gyro_bias": 3,
    "sigma_accel_bias": 3,
    "sigma_mount": 2,
}


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """The quaternion of Rz(yaw) Ry(pitch) Rx(roll), by multiplying the three."""
    product = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        w, v = product[0], product[1:]
        turn = np.eye(3)[axis] * math.sin(angle / 2)
        c = math.cos(angle / 2)
        product = np.array([w * c - v @ turn, *(w * turn + c * v + np.cross(v, turn))])
    w, x, y, z = product.tolist()
    return w, x, y, z


def state(**changes: Any) -> SolutionState:
    """A plausible state, with changes."""
    root = np.random.default_rng(3).normal(size=(9, 9)) * 0.1
    values: dict[str, Any] = {
        "latitude": 0.8401,
        "longitude": -2.1,
        "height": 112.3,
        "velocity_n": (1 / 3, -2.5, 0.01),
        "quaternion_nb": quaternion(0.02, -0.03, 3.0),
        "angular_rate_b": (0.01, -0.02, 0.1),
        "acceleration_b": (0.1, 0.2, -9.8),
        "gyro_bias": (1e-3, -2e-4, 1e-7),
        "accel_bias": (0.05, 0.0, -0.1),
        "wheel_scale": 0.012,
        "mount": (0.01, -0.02),
        "covariance": root @ root.T,
        "sigma_gyro_bias": (1e-4, 1e-4, 2e-4),
        "sigma_accel_bias": (1e-2, 1e-2, 2e-2),
        "sigma_wheel_scale": 1e-3,
        "sigma_mount": (1e-3, 2e-3),
    }
    return SolutionState(**{**values, **changes})


def message(inner: SolutionState | None, mode: Mode = Mode.NOMINAL) -> StateMessage:
    """The message of an estimate with a state, or without one."""
    return state_message(Solution(T_NS, mode, age_ns=2_500_000, resets=1, state=inner), "rover", COUNTS)


def numbers(published: State) -> list[float]:
    """Every number of a published state."""
    values = msgspec.structs.astuple(published)
    return [number for value in values for number in (value if isinstance(value, tuple) else (value,))]


def random_state(seed: int = 3, **given: Any) -> State:
    """A random state as published, some kilometres from 48.1 N, 11.6 E."""
    random = np.random.default_rng(seed)

    def triple() -> tuple[float, ...]:
        return tuple(random.normal(size=3).tolist())

    def covariance() -> tuple[float, ...]:
        root = random.normal(size=(3, 3))
        product = root @ root.T
        return tuple(((product + product.T) / 2).ravel().tolist())

    turned = random.normal(size=4)
    values: dict[str, Any] = {
        "lat_deg": 48.1 + 0.1 * random.normal(),
        "lon_deg": 11.6 + 0.1 * random.normal(),
        "height_m": 500.0 + random.normal(),
        "velocity_ned_mps": triple(),
        "quaternion_nb": tuple((turned / np.linalg.norm(turned)).tolist()),
        **dict.fromkeys(("roll_deg", "pitch_deg", "yaw_deg", "wheel_scale", "sigma_wheel_scale"), 0.0),
        **dict.fromkeys(("sigma_velocity_mps", "sigma_yaw_deg"), 1.0),
        **{name: covariance() for name in State.__struct_fields__ if name.startswith("covariance")},
        "mount_deg": (0.0, 0.0),
        "sigma_mount_deg": (0.0, 0.0),
        "sigma_gyro_bias_rps": tuple(abs(x) for x in triple()),
    }
    rest = [name for name in State.__struct_fields__ if name not in values]
    return State(**{**values, **{name: triple() for name in rest}, **given})


def random_messages(count: int) -> list[StateMessage]:
    """The first is aligning, the rest have random states."""
    random = np.random.default_rng(11)

    def state() -> SolutionState:
        root = random.normal(size=(9, 9))
        values: dict[str, Any] = {name: random.normal() for name in SCALARS}
        values |= {name: tuple(random.normal(size=size).tolist()) for name, size in VECTORS.items()}
        return SolutionState(covariance=root @ root.T, **values)

    def published(number: int) -> Solution:
        t_ns = 1_700_000_000_000_000_001 + number * 20_000_000
        mode = Mode.NOMINAL if number else Mode.ALIGNING
        return Solution(t_ns, mode, 3_000_001, 0, state() if number else None)

    return [state_message(published(number), "rover", OutcomeCounts(fused=number)) for number in range(count)]
