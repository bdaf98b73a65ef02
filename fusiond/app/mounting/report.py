"""The mounting angles as text, for the person who installs the sensor."""

from __future__ import annotations

import math

from fusiond.app.mounting.rotation import MEANING, Mounting

MAX_LISTED_SIGMA = math.radians(20.0)  # a direction less certain than this is not listed


def text(mounting: Mounting, imu: str) -> str:
    """The result for the person who installs the sensor, with the line for the configuration."""
    roll, pitch, yaw = (_tenth(angle) for angle in mounting.rotation)
    lines = [
        f"[imu.{imu}]",
        f"rotation_deg = [{roll}, {pitch}, {yaw}]",
        "",
        f"{_deg(mounting.turned)} deg from the configured rotation; sigma {_deg(mounting.sigma[0])} deg about the forward "
        f"axis, {_deg(mounting.sigma[1])} about right, {_deg(mounting.sigma[2])} about down",
        f"from {mounting.seconds:.0f} s of driving ({mounting.standing:.0f} s of it at rest), with the speed of the "
        f"{mounting.speed_from}; root mean square: {mounting.acceleration:.2f} m/s^2 change of speed, "
        f"{_deg(mounting.turning)} deg/s turn rate:",
    ]
    lines += [
        f"  {MEANING[name]}: sigma {_deg(sigma)} deg, {_deg(off)} deg from the rotation found"
        for name, off, sigma in mounting.directions
        if sigma < MAX_LISTED_SIGMA
    ]
    return "\n".join(lines)


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f}"


def _tenth(angle: float) -> float:
    """Degrees, rounded; no negative zero."""
    return round(math.degrees(angle), 1) + 0.0
