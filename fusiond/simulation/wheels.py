"""The simulated wheels: the speed of each contact point, its errors and faults, and the CAN frames that carry it.

The frame holds, most significant bit first, four speeds of 15 bits, a fault bit and a counter of 3 bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.typed import Array
from fusiond.simulation.scenario import RAW_MAX_SIGNED, RAW_MAX_UNSIGNED, WHEELS, Scenario, Wheels
from fusiond.simulation.trajectory import Kinematics
from fusiond.simulation.transport import Mask, within

Integers = NDArray[np.int64]
FRAME_ID, FRAME_NAME = 0x1D0, "WHEEL_SPEEDS"
SPEED_BITS, FAULT_BIT, COUNTER_BITS = 15, 3, 3
INVALID_RAW = 0x7FFF  # what the speeds read while the fault bit is set
STEERING_ID, STEERING_HZ = 0x025, 80.0
SPEED_ID, SPEED_HZ = 0x0B4, 40.0
STEERING_RATIO = 15.0  # steering wheel over front wheels


def positions_v(scenario: Scenario) -> Array:
    """Contact points (4, 3) [m] in vehicle axes from the point below the middle of the rear axle; of a skid-steered vehicle
    from that below the middle of all wheels."""
    base, half = scenario.vehicle.wheelbase_m, scenario.vehicle.track_m / 2
    front, rear = (base / 2, -base / 2) if scenario.vehicle.steering == "skid" else (base, 0.0)
    return np.array([(front, -half, 0.0), (front, half, 0.0), (rear, -half, 0.0), (rear, half, 0.0)])


def true_speeds(scenario: Scenario, kinematics: Kinematics) -> Array:
    """Speed (N, 4) [m/s] of each contact point along its rolling direction: rear wheels roll straight ahead, front
    wheels along the track of their contact point. Those of a skid-steered vehicle all roll straight ahead, and faster on
    the outside of a bend than the road passes, slower on the inside."""
    place, body = positions_v(scenario), scenario.vehicle
    if body.steering == "skid":
        return np.asarray(kinematics.speed[:, None] - kinematics.yaw_rate[:, None] * place[:, 1] * body.skid)
    forward = kinematics.speed[:, None] - kinematics.yaw_rate[:, None] * place[:, 1]
    slip = -np.radians(body.slip_deg_per_mps2) * kinematics.speed**2 * kinematics.yaw_rate
    sideways = np.where(place[:, 0] > 0, kinematics.yaw_rate[:, None] * place[:, 0] + slip[:, None], 0.0)
    return np.copysign(np.hypot(forward, sideways), forward)


def scales(wheels: Wheels) -> tuple[float, float, float, float]:
    """The relative error of each wheel, common and own error together."""
    first, second, third, fourth = ((1 + wheels.scale_error) * (1 + own) - 1 for own in wheels.scale_errors)
    return first, second, third, fourth


def measure(
    scenario: Scenario, t: Array, kinematics: Kinematics, randoms: Sequence[np.random.Generator]
) -> tuple[Integers, Mask]:
    """Raw speeds (N, 4) of the frames at the times `t` (N,) [s], and which frames carry the fault bit; one generator
    for each wheel."""
    wheels = scenario.wheels
    true = true_speeds(scenario, kinematics)
    noise = np.stack([random.standard_normal(len(t)) for random in randoms], -1) * wheels.sigma_mps
    speeds = true * (1 + np.array(scales(wheels)))
    for slip in wheels.slip:
        speeds[within(t, [(slip.start_s, slip.stop_s)]), WHEELS.index(slip.wheel)] *= slip.factor
    speeds = np.where((true == 0) | (np.abs(true) < wheels.least_mps), 0.0, speeds + noise)
    for stuck in wheels.stuck:
        column = speeds[:, WHEELS.index(stuck.wheel)]
        held = np.flatnonzero(within(t, [(stuck.start_s, stuck.stop_s)]))
        column[held] = column[held[:1]]
    low, high = (0, RAW_MAX_UNSIGNED) if wheels.unsigned else (-RAW_MAX_SIGNED, RAW_MAX_SIGNED)
    signal = np.abs(speeds) if wheels.unsigned else speeds
    raw = np.clip(np.rint(signal * 3.6 / wheels.resolution_kmh), low, high).astype(np.int64)
    fault = within(t, wheels.fault_s)
    raw[fault] = INVALID_RAW if wheels.unsigned else RAW_MAX_SIGNED
    return raw, fault


def frames(raw: Integers, fault: Mask, counter: Integers) -> NDArray[np.uint64]:
    """The eight bytes of each frame (N,), as big-endian numbers."""
    word = np.zeros(len(raw), np.uint64)
    for column in range(4):
        word = (word << np.uint64(SPEED_BITS)) | (raw[:, column] & INVALID_RAW).astype(np.uint64)
    status = (fault.astype(np.uint64) << np.uint64(FAULT_BIT)) | counter.astype(np.uint64)
    return (word << np.uint64(FAULT_BIT + 1)) | status


def steering_frames(scenario: Scenario, kinematics: Kinematics) -> NDArray[np.uint64]:
    """Steering wheel angle, 12 bits of 1.5 deg, with a checksum."""
    angle = np.degrees(np.arctan(kinematics.curvature * scenario.vehicle.wheelbase_m)) * STEERING_RATIO
    raw = np.rint(angle / 1.5).astype(np.int64) & 0xFFF
    return _with_checksum(raw.astype(np.uint64) << np.uint64(48), STEERING_ID)


def speed_frames(kinematics: Kinematics) -> NDArray[np.uint64]:
    """Speed in 0.01 km/h and a counter, with a checksum."""
    speed = np.rint(np.abs(kinematics.speed) * 360).astype(np.uint64)
    counter = np.arange(len(speed), dtype=np.uint64) & np.uint64(0xFF)
    return _with_checksum((counter << np.uint64(24)) | (speed << np.uint64(8)), SPEED_ID)


def _with_checksum(word: NDArray[np.uint64], identifier: int) -> NDArray[np.uint64]:
    total = np.full(len(word), 8 + (identifier >> 8) + (identifier & 0xFF), np.uint64)
    for shift in range(8, 64, 8):
        total += (word >> np.uint64(shift)) & np.uint64(0xFF)
    return word | (total & np.uint64(0xFF))
