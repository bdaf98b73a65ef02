"""Noise densities of the inertial sensor in a log, vibration included: python imu_noise.py car.toml drive.tlog [START-STOP]

It uses the differences of successive samples in the seconds START to STOP, so slow changes, such as driving, cancel.
"""

import sys

import numpy as np

from fusiond.app.replay.intervals import parse_interval
from fusiond.config import load as config
from fusiond.events import ImuSample
from fusiond.timeline.clock import Clock
from fusiond.units import SECOND
from fusiond_adapters.logs.merge import open_logs

settings = config.load(sys.argv[1])
start_s, stop_s = parse_interval(sys.argv[3]) if len(sys.argv) > 3 else (0.0, float("inf"))
clock, rows = Clock(settings), []
for event in open_logs(sys.argv[2:3], settings):
    measurement = clock.align(event)
    if measurement and isinstance(measurement.payload, ImuSample):
        sample = measurement.payload
        rows.append((measurement.t_ns, *sample.specific_force_b, *sample.angular_rate_b))
t = (np.array([row[0] for row in rows]) - rows[0][0]) / SECOND
samples = np.array([row[1:] for row in rows])[(t >= start_s) & (t < stop_s)]
interval_s = float(np.median(np.diff(t)))
white = np.diff(samples, axis=0).std(axis=0) / np.sqrt(2) * np.sqrt(interval_s)
print(f"{len(samples)} samples at {1 / interval_s:.1f} Hz; forward, right, down:")
print("accel_noise [m/s^2/sqrt(Hz)]", *(f"{value:.2g}" for value in white[:3]))
print("gyro_noise  [rad/s/sqrt(Hz)]", *(f"{value:.2g}" for value in white[3:]))
