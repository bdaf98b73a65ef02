"""The lever arm of a receiver, estimated by the filter in a second pass over the logs, in which it may be wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator

from msgspec.structs import replace

from fusiond.app.diagnosis.finding import Finding
from fusiond.app.diagnosis.fits import SURE
from fusiond.config.schema import Config, calibrated
from fusiond.estimator.fusion import Fusion
from fusiond.filter.calibration import calibrations

OPEN_M = 1.0  # sigma of the lever arm in the second pass, per axis
OPEN_MS = 50.0  # of the delays, which look alike at a steady speed
MODEL_M = 0.2  # what slip and the mount may put into an estimate of it
SAME_M = 0.05  # the same where the question is only whether a sign is wrong
LEAST_M = 0.2  # a shorter arm has no sign to speak of
AXES = ("forward", "right")  # height tells little of the third


def with_open_lever_arm(config: Config) -> Config | None:
    """The configuration with a lever arm and delays that are learnt; None where it has no receiver, or learns them."""
    if not config.gnss or any(calibrated(one) and one.lever_arm_sigma_m for one in config.gnss.values()):
        return None
    name = next((name for name, one in config.gnss.items() if calibrated(one)), next(iter(config.gnss)))
    one = config.gnss[name]
    learnt = replace(
        one,
        lever_arm_sigma_m=OPEN_M,
        delay_sigma_ms=max(one.delay_sigma_ms, OPEN_MS),
        velocity_delay_sigma_ms=max(one.velocity_delay_sigma_ms, OPEN_MS),
    )
    return replace(config, gnss={**config.gnss, name: learnt})


def lever_findings(config: Config, fusion: Fusion) -> Iterator[Finding]:
    """A lever arm that is wrong, by a fusion with an open one. `config` is the one that was asked about."""
    found = calibrations(fusion.params, fusion.history.head)
    name = next(name for name, one in fusion.config.gnss.items() if one.lever_arm_sigma_m)
    arm, wrong, flipped = list(config.gnss[name].lever_arm_m), [], False
    for place, axis in enumerate(AXES):
        off, sigma = found[f"lever_arm_{axis}_m"]
        other_sign = abs(arm[place]) > LEAST_M and abs(2 * arm[place] + off) < abs(arm[place])
        if abs(off) > SURE * math.hypot(sigma, SAME_M if other_sign else MODEL_M):
            wrong.append(f"{abs(arm[place] + off):.2f} +- {sigma:.2f} m {_words(axis, arm[place] + off)}")
            flipped = flipped or other_sign
            arm[place] = round(arm[place] + off, 2)
    if wrong:
        given = ", ".join(f"{value:g}" for value in config.gnss[name].lever_arm_m)
        yield Finding(
            kind="lever_arm",
            text=f"{name}: the antenna is {' and '.join(wrong)} of the IMU, by the fixes, and configured at [{given}]"
            + ("; is a sign wrong?" if flipped else ""),
            key=f"gnss.{name}.lever_arm_m",
            value=f"[{', '.join(f'{value:g}' for value in arm)}]",
        )


def _words(axis: str, value: float) -> str:
    return {"forward": ("forward", "aft"), "right": ("right", "left")}[axis][value < 0]
