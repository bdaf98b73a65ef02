"""Public drives of others, converted to logs that fusiond reads: one module for each form, one line in the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

FORMS = {  # name: what it is
    "comma2k19": "comma.ai's comma2k19, a segment of a minute: IMU, GNSS, all CAN frames, reference (MIT licence)",
    "kitti": "KITTI's raw data, a drive's oxts folder: an INS of a car in Karlsruhe (CC BY-NC-SA 3.0)",
}


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be converted, and how."""

    folder: Path
    out: Path
    start_s: float  # seconds from the first sample of the inertial sensor
    stop_s: float
    at_arrival: bool = False  # stamp fixes with the boot time of their arrival, as most autopilots do


def converter(form: str) -> Callable[[Wanted], list[Path]]:
    """The function that converts a form and returns the files; it raises LogError, UsageError, OSError."""
    made: Callable[[Wanted], list[Path]] = import_module(f"fusiond.app.convert.{form}").convert
    return made
