"""Solution how much GNSS speed lags behind wheel speed: python gnss_lag.py car.toml drive.tlog drive.log"""

import sys

import numpy as np

from fusiond.config import load as config
from fusiond.events import GnssVelocity, WheelSpeed
from fusiond.timeline.clock import Clock
from fusiond.units import SECOND
from fusiond_adapters.logs.merge import open_logs

settings = config.load(sys.argv[1])
clock, gnss, wheels = Clock(settings), [], []
for event in open_logs(sys.argv[2:], settings):
    measurement = clock.align(event)
    if measurement is None:
        continue
    payload = measurement.payload
    if isinstance(payload, GnssVelocity):
        gnss.append((measurement.t_ns / SECOND, np.hypot(payload.north, payload.east)))
    elif isinstance(payload, WheelSpeed):
        wheels.append((measurement.t_ns / SECOND, abs(payload.speed)))
t_gnss, gnss_speed = np.array(gnss).T
t_wheel, wheel_speed = np.array(sorted(wheels)).T
inside = (t_gnss > t_wheel[0] + 1) & (t_gnss < t_wheel[-1] - 1)


def misfit(lag_s: float) -> float:
    wheel = np.interp(t_gnss[inside] - lag_s, t_wheel, wheel_speed)
    scale = wheel @ gnss_speed[inside] / (wheel @ wheel)  # the wheels' own scale is unknown
    return float(np.std(gnss_speed[inside] - scale * wheel))


lags = np.arange(-0.3, 0.51, 0.005)
best = min(lags, key=misfit)
print(f"GNSS speed lags by {1e3 * best:.0f} ms beyond the configured delays; misfit {misfit(best):.3f} m/s")
