"""The autopilot reboots during the drive: no IMU and no GNSS for some seconds, while wheel speeds continue."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import begun, drive, error, spread
from benchmarks.study.world import GNSS_NAME, IMU_NAME, Fault, Sensors
from fusiond.filter.state import ATTITUDE, PHASE, POSITION, RESETS, RUNNING, VELOCITY

IMU_HZ, WHEEL_HZ = 100.0, 20.0
SILENT_S = (1.0, 3.0, 8.0)
FIRST_S, LAST_S = 10.0, 70.0  # the reboot begins at random between these
AFTER_S = 20.0  # after the return, when the errors are taken
LOOK_S = 0.1


class Reboot(NamedTuple):
    """Seconds until the filter runs again; errors AFTER_S after the return: horizontal [m], velocity [m/s], heading [deg];
    resets."""

    running: float
    position: float
    velocity: float
    heading: float
    resets: int


def one(seconds: float, seed: list[int]) -> Reboot:
    random, config = np.random.default_rng(seed), nominal.config()
    begin = float(random.uniform(FIRST_S, LAST_S))
    end = begin + seconds
    world, fusion = begun(nominal.scenario(2, imu_hz=IMU_HZ), config, random)
    running: list[float] = []
    errors = (np.inf, np.inf, np.inf)

    def look(t: float, k: int) -> None:
        nonlocal errors
        head = fusion.history.head
        if head.stamps[PHASE] != RUNNING:
            running.clear()
            return
        running.append(t)
        off, to_n = error(head, world, k), world.mat_ne[k]
        horizontal = float(np.hypot(*(to_n @ off[POSITION])[:2]))
        errors = horizontal, float(np.linalg.norm(off[VELOCITY])), float(np.degrees(abs((to_n @ off[ATTITUDE])[2])))

    faults = tuple(Fault(name, "absent", begin, end) for name in (IMU_NAME, GNSS_NAME))
    looks = np.arange(end, end + AFTER_S, LOOK_S).tolist()
    drive(fusion, Sensors(world, WHEEL_HZ, faults=faults).measurements(), looks, look)
    return Reboot(running[0] - end if running else np.inf, *errors, int(fusion.history.head.stamps[RESETS]))


def reboot(runs: int, seed: int) -> Section:
    section = Section("The autopilot reboots")
    section.say(
        f"{runs} runs of each length in the nominal drive, seed {seed}: neither IMU nor GNSS, from a random instant; four "
        f"wheels at {WHEEL_HZ:.0f} Hz go on. Errors {AFTER_S:.0f} s after the return."
    )
    rows = []
    for seconds in SILENT_S:
        found = spread(one, [(seconds, [seed, run, int(seconds)]) for run in range(runs)])
        worst = [max(values) for values in zip(*found, strict=True)]
        back = sum(r.position < 5 and r.velocity < 1 and r.heading < 5 for r in found)
        rows.append((f"{seconds:.0f} s", f"{back} of {runs}", sum(r.resets > 0 for r in found), f"{worst[0]:.1f} s",
                     f"{worst[1]:.2f} m", f"{worst[2]:.2f} m/s", f"{worst[3]:.1f} deg"))  # fmt: skip
    head = ("silent for", "recovered (5 m, 1 m/s, 5 deg)", "aligned again", "runs again after, worst", "position, worst",
            "velocity, worst", "heading, worst")  # fmt: skip
    section.table(head, rows)
    return section
