"""The DBC file and the fusiond configuration that go with a simulated drive, as text."""

from __future__ import annotations

import math

import numpy as np

from fusiond.maths.typed import Array
from fusiond.simulation import wheels
from fusiond.simulation.scenario import WHEELS, Barometer, Gnss, Imu, Scenario
from fusiond.simulation.trajectory import euler_matrix
from fusiond.simulation.wire import BAROMETER, BUS, GNSS, IMU, LINK

MIN_WHITE = 0.01  # share of a fix's variance
MIN_NOISE = 1e-5  # a noiseless sensor still needs a sigma
OWN_SCALE_SPEED = 10.0  # m/s, at which a wheel's own scale error is counted as noise
OWN_SCALE_CORRELATION_S = 60.0  # such an error lasts while the vehicle keeps about its speed
MOUNT_SIGMA_FLOOR_DEG = 0.5
SIGNALS = ("SPEED_FL", "SPEED_FR", "SPEED_RL", "SPEED_RR")
FAULT_SIGNAL, COUNTER_SIGNAL = "FAULT", "COUNTER"


def dbc(scenario: Scenario) -> str:
    """The DBC text that describes the wheels' frame."""
    resolution = scenario.wheels.resolution_kmh
    sign, low, high = ("+", 0, 32767) if scenario.wheels.unsigned else ("-", -16384, 16383)
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: BRAKES", ""]
    lines.append(f"BO_ {wheels.FRAME_ID} {wheels.FRAME_NAME}: 8 BRAKES")
    for index, signal in enumerate(SIGNALS):
        at = _dbc_start(index * wheels.SPEED_BITS)
        scale = f'({resolution:g},0) [{low * resolution:g}|{high * resolution:g}] "km/h"'
        lines.append(f" SG_ {signal} : {at}|{wheels.SPEED_BITS}@0{sign} {scale} Vector__XXX")
    lines.append(f' SG_ {FAULT_SIGNAL} : {wheels.FAULT_BIT + 56}|1@0+ (1,0) [0|1] "" Vector__XXX')
    lines.append(f' SG_ {COUNTER_SIGNAL} : 58|{wheels.COUNTER_BITS}@0+ (1,0) [0|7] "" Vector__XXX')
    return "\n".join(lines) + "\n"


def _dbc_start(bit: int) -> int:
    """DBC's number of a big-endian signal's first bit, which is the frame's `bit`-th from the front."""
    return bit // 8 * 8 + 7 - bit % 8


def configuration(scenario: Scenario, dbc_name: str) -> str:
    """The text of a fusiond configuration that fits the drive: an installer's measurements and data-sheet noise, and
    nothing of the drawn errors (biases, mount, wheel scale) that the filter has to find."""
    tables = [_head(scenario, dbc_name), _imu(scenario.imu), _gnss(scenario), *_wheels(scenario)]
    return "\n".join(tables + ([_barometer(scenario.barometer)] if scenario.barometer.rate_hz else [])) + "\n"


def _from_imu(scenario: Scenario, point_m: Array) -> str:
    """A point from the IMU in the IMU's axes, as a TOML array [m]."""
    mat_vb = euler_matrix(*(np.radians(np.array([angle])) for angle in scenario.imu.mount_deg))[0]
    lever = (np.asarray(point_m) - scenario.imu.position_m) @ mat_vb
    return "[" + ", ".join(f"{value + 0.0:.4f}" for value in lever) + "]"


def _head(scenario: Scenario, dbc_name: str) -> str:
    mount = max(MOUNT_SIGMA_FLOOR_DEG, *(abs(angle) for angle in scenario.imu.mount_deg))
    return f"""\
# A fusiond configuration for the simulated drive beside it. Lengths in m, forward, right, down from the IMU.

[vehicle]
name = "{scenario.vehicle.name}"  # names the vehicle in every published key

[filter]
mount_sigma_deg = {mount:g}  # initial sigma of the IMU's pitch and yaw against the vehicle [deg]
wheel_scale_sigma = {max(0.01, abs(scenario.wheels.scale_error)):g}  # initial sigma of the common wheel scale (1 = 100 %)

[motion]
point_m = {_from_imu(scenario, np.zeros(3))}  # the middle of the unsteered axle, on the road

[mavlink.{LINK}]
dialect = "common"  # of the messages in drive.tlog

[can.{BUS}]
log_channel = "can0"  # the bus's name in drive.log
dbc = ["{dbc_name}"]  # relative to this file
delay_ms = {scenario.wheels.transport.latency_ms + scenario.wheels.transport.jitter_ms:g}  # age of a frame on receipt
"""


def _imu(imu: Imu) -> str:
    shake = len(imu.vibration_hz) / 2 / imu.rate_hz  # mean square of a sinusoid, as a density over the sampling rate
    accel = math.sqrt(imu.accel_noise**2 + shake * imu.vibration_mps2**2)
    gyro = math.sqrt(imu.gyro_noise**2 + shake * math.radians(imu.vibration_deg_s) ** 2)
    return f"""\
[imu.{IMU}]
link = "{LINK}"
message = "HIGHRES_IMU"
accel_noise = {max(accel, MIN_NOISE):.3g}  # noise density, vibration at 10 m/s included [m/s^2/sqrt(Hz)]
gyro_noise = {max(gyro, MIN_NOISE):.3g}  # [rad/s/sqrt(Hz)]
accel_bias_sigma = {_sigma(imu.accel_bias, imu.accel_bias_sigma):.3g}  # initial sigma of the bias [m/s^2]
gyro_bias_sigma = {_sigma(imu.gyro_bias, imu.gyro_bias_sigma):.3g}  # [rad/s]
accel_bias_walk = {imu.accel_bias_walk:.3g}  # random walk of the bias [m/s^2/sqrt(s)]
gyro_bias_walk = {imu.gyro_bias_walk:.3g}  # [rad/s/sqrt(s)]
"""


def _sigma(given: tuple[float, float, float] | None, sigma: float) -> float:
    return sigma if given is None else max(sigma, *(abs(value) for value in given))


def _barometer(barometer: Barometer) -> str:
    return f"""\
[barometer.{BAROMETER}]
link = "{LINK}"
sigma_m = {max(barometer.sigma_m, MIN_NOISE):.3g}  # noise of one reading, as a height
correlation_s = 0.0  # correlation time of its errors
offset_walk_m = {barometer.offset_walk_m:.3g}  # random walk of its offset [m/sqrt(s)]
"""


def _gnss(scenario: Scenario) -> str:
    gnss = scenario.gnss
    horizontal = math.hypot(gnss.sigma_m, gnss.drift_sigma_m)
    vertical = math.hypot(gnss.height_sigma_m, gnss.height_drift_sigma_m)
    white = max((gnss.sigma_m / horizontal) ** 2, MIN_WHITE) if gnss.drift_sigma_m else 1.0
    jitter_ms = 0.0 if gnss.stamp == "unix" else gnss.transport.jitter_ms
    return f"""\
[gnss.{GNSS}]
link = "{LINK}"
message = "GPS_RAW_INT"
lever_arm_m = {_from_imu(scenario, np.array(gnss.antenna_m))}  # the antenna
delay_ms = {_stamp_delay_ms(gnss):g}  # how long before its stamp the position was measured
velocity_delay_ms = {gnss.velocity_lag_ms:g}  # how much longer before it the velocity was measured
position_sigma_m = {max(horizontal, MIN_NOISE):.3g}  # horizontal, per axis
height_sigma_m = {max(vertical, MIN_NOISE):.3g}
velocity_sigma_mps = {max(gnss.velocity_sigma_mps, MIN_NOISE):.3g}  # per axis
position_correlation_s = {gnss.correlation_s if gnss.drift_sigma_m else 0.0:.3g}  # correlation time of their slow part [s]
position_white_share = {white:.3g}  # share of their variance that is not slow
velocity_correlation_s = {gnss.velocity_correlation_s:g}  # correlation time of velocity errors [s]
stamp_sigma_ms = {jitter_ms:g}  # of the fix's stamp
interval_s = {1 / gnss.rate_hz:.6g}  # spacing of the fixes [s]
"""


def _stamp_delay_ms(gnss: Gnss) -> float:
    """The delay before the stamp: none, that to the autopilot, or that to the host."""
    link_ms = gnss.transport.latency_ms + gnss.transport.jitter_ms
    return {"unix": 0.0, "boot-arrival": gnss.delay_ms, "none": gnss.delay_ms + link_ms}[gnss.stamp]


def _wheels(scenario: Scenario) -> list[str]:
    spec = scenario.wheels
    own = OWN_SCALE_SPEED * max(abs(error) for error in spec.scale_errors)  # m/s, lasting
    sigma = max(math.hypot(spec.sigma_mps, own), MIN_NOISE)
    tables = []
    for name, signal, place in zip(WHEELS, SIGNALS, wheels.positions_v(scenario), strict=True):
        tables.append(f"""\
[wheel.{name}]
bus = "{BUS}"
message = "{wheels.FRAME_NAME}"
signal = "{signal}"
unit = "km/h"
unsigned = {str(spec.unsigned).lower()}  # amount only, no direction
valid_signal = "{FAULT_SIGNAL}"  # must be valid_value, 0
counter_signal = "{COUNTER_SIGNAL}"  # a repeated value marks a stale frame
position_m = {_from_imu(scenario, place)}  # its contact point
steered = {str(name.startswith(scenario.vehicle.steering)).lower()}  # it measures the speed along its own track
sigma_mps = {sigma:.3g}  # of a reading
correlation_s = {(own / sigma) ** 2 * OWN_SCALE_CORRELATION_S:.3g}  # correlation time of its errors [s]
quantum_mps = {spec.resolution_kmh / 3.6:.3g}  # step of the signal
""")
    return tables
