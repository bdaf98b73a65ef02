"""State messages from an estimate, in the units of the message and with finite numbers only."""

from __future__ import annotations

import math
from typing import TypeVar

import msgspec

from fusiond.estimator.solution import ATTITUDE, POSITION, VELOCITY, Mode, Solution, SolutionState
from fusiond.messages.types import (
    Block,
    OutcomeCounts,
    Quaternion,
    SettledMessage,
    State,
    StateAtInstant,
    StateMessage,
    Triple,
)
from fusiond.units import MILLISECOND

AnyState = TypeVar("AnyState", bound=StateAtInstant)


def state_message(estimate: Solution, vehicle: str, outcomes: OutcomeCounts) -> StateMessage:
    """The message of an estimate.

    A state with a number that is not finite or with a negative variance is withheld: the message then has mode `lost` and
    no state, and `fault` names the number. Publication continues, so a reader sees the reason.
    """
    return _message(StateMessage, estimate, vehicle, outcomes)


def settled_message(estimate: Solution, vehicle: str, outcomes: OutcomeCounts) -> SettledMessage:
    """The message of an estimate at the horizon."""
    return _message(SettledMessage, estimate, vehicle, outcomes)


def _message(kind: type[AnyState], estimate: Solution, vehicle: str, outcomes: OutcomeCounts) -> AnyState:
    state, fault = _checked(estimate.state) if estimate.state is not None else (None, None)
    return kind(
        vehicle=vehicle,
        t_ns=estimate.t_ns,
        mode=Mode.LOST if fault else estimate.mode,
        age_ms=None if estimate.age_ns is None else estimate.age_ns / MILLISECOND,
        resets=estimate.resets,
        fault=fault,
        heading_confirmed=estimate.heading_confirmed,
        state=state,
        outcomes=outcomes,
    )


def _checked(estimate: SolutionState) -> tuple[State | None, str | None]:
    """The state to publish, or None and its fault."""
    if not all(variance >= 0 for variance in estimate.covariance.diagonal().tolist()):
        return None, "covariance: a variance is negative or not a number"
    state = _published(estimate)
    values = [value if isinstance(value, tuple) else (value,) for value in msgspec.structs.astuple(state)]
    if math.isfinite(sum(map(sum, values))):
        return state, None
    for name, value in zip(state.__struct_fields__, values, strict=True):
        if not all(map(math.isfinite, value)):
            return None, f"{name}: not finite"
    return state, None


def _published(estimate: SolutionState) -> State:
    """The state in the units of the message. Raises ValueError on a negative variance."""
    roll, pitch, yaw = estimate.euler()
    return State(
        lat_deg=math.degrees(estimate.latitude),
        lon_deg=math.degrees(estimate.longitude),
        height_m=float(estimate.height),
        velocity_ned_mps=_triple(estimate.velocity_n),
        quaternion_nb=_quaternion(estimate.quaternion_nb),
        roll_deg=math.degrees(roll),
        pitch_deg=math.degrees(pitch),
        yaw_deg=math.degrees(yaw),
        angular_rate_b_rps=_triple(estimate.angular_rate_b),
        acceleration_b_mps2=_triple(estimate.acceleration_b),
        gyro_bias_rps=_triple(estimate.gyro_bias),
        accel_bias_mps2=_triple(estimate.accel_bias),
        wheel_scale=float(estimate.wheel_scale),
        mount_deg=_degrees(estimate.mount),
        covariance_position_m2=_block(estimate, POSITION),
        covariance_velocity_m2ps2=_block(estimate, VELOCITY),
        covariance_attitude_rad2=_block(estimate, ATTITUDE),
        sigma_position_ned_m=estimate.sigma_position_n(),
        sigma_velocity_mps=estimate.sigma_velocity(),
        sigma_yaw_deg=math.degrees(estimate.sigma_yaw()),
        sigma_gyro_bias_rps=_triple(estimate.sigma_gyro_bias),
        sigma_accel_bias_mps2=_triple(estimate.sigma_accel_bias),
        sigma_wheel_scale=float(estimate.sigma_wheel_scale),
        sigma_mount_deg=_degrees(estimate.sigma_mount),
    )


# NumPy's scalars are floats, but msgspec refuses them and their repr is not a plain number: hence float() below.


def _triple(vector: Triple) -> Triple:
    x, y, z = vector
    return float(x), float(y), float(z)


def _quaternion(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    return float(w), float(x), float(y), float(z)


def _degrees(angles: tuple[float, float]) -> tuple[float, float]:
    return math.degrees(angles[0]), math.degrees(angles[1])


def _block(estimate: SolutionState, block: slice) -> Block:
    """A block of the covariance, made symmetric to the last bit: the rotation into n leaves it asymmetric by rounding."""
    a, b, c, d, e, f, g, h, i = estimate.covariance[block, block].ravel().tolist()
    b, c, f = (b + d) / 2, (c + g) / 2, (f + h) / 2
    return a, b, c, b, e, f, c, f, i
