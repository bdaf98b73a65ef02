"""Other traffic of a simulated drive: messages and frames that the filter does not use."""

from __future__ import annotations

from itertools import cycle

# Messages a second, from PX4's streams to an onboard computer (MAVLINK_MODE_ONBOARD in its mavlink_main.cpp).
TELEMETRY_HZ = {
    "ATTITUDE": 100.0,
    "GLOBAL_POSITION_INT": 50.0,
    "LOCAL_POSITION_NED": 30.0,
    "ALTITUDE": 10.0,
    "VFR_HUD": 10.0,
    "SERVO_OUTPUT_RAW": 10.0,
    "SYS_STATUS": 5.0,
}
FIRST_ID = 0x200  # of the further frames
FRAMES_HZ = (80.0, 40.0, 40.0, 30.0, 20.0, 20.0, 10.0, 5.0, 2.0)  # of one id each, over and over: a mixture as cars have


def traffic_rates(total_hz: float) -> list[float]:
    """Frames a second of each further id; `total_hz` is their sum."""
    found: list[float] = []
    left = total_hz
    for rate in cycle(FRAMES_HZ):
        if left <= 0:
            break
        found.append(min(rate, left))
        left -= rate
    return found
