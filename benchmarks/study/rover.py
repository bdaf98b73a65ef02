"""A slow rover: 1 m/s, skid-steered, an IMU at 30 Hz, wheels at 10 Hz, GNSS without velocity."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.study.recorded import SIGMAS_95, Recorded, Segment, changed, recorded, scenario, watch
from benchmarks.study.report import Section
from benchmarks.study.runs import spread
from benchmarks.study.tampering import later, nothing, outage
from fusiond.events import GnssVelocity

DRIVE_S, LOST_S = 400.0, 280.0  # GNSS ends at the latter in one case
SCALE = 0.026  # the wheels read too high by so much
ROVER: dict[str, dict[str, Any]] = {
    "vehicle": {"wheelbase_m": 0.51, "track_m": 0.57, "steering": "skid", "roll_deg_per_mps2": 0.0},
    "imu": {"rate_hz": 30.0, "position_m": [0.0, 0.0, -0.3], "accel_noise": 0.02, "gyro_noise": 1e-3},
    "gnss": {
        "rate_hz": 2.5, "antenna_m": [0.1, 0.0, -0.8], "sigma_m": 0.4, "drift_sigma_m": 0.8, "correlation_s": 20.0,
        "height_sigma_m": 0.8, "height_drift_sigma_m": 1.6,
    },
    "wheels": {"rate_hz": 10.0, "scale_error": SCALE, "unsigned": False, "resolution_kmh": 0.01},
}  # fmt: skip


class Case(NamedTuple):
    """How much the wheels slide in bends; whether GNSS gives velocity, and whether it ends."""

    skid: float = 1.5
    velocity: bool = False
    ends: bool = False


CASES = {
    "wheels slide, no velocity": Case(),
    "wheels slide, velocity": Case(velocity=True),
    "wheels do not slide, no velocity": Case(skid=1.0),
    "wheels slide, no velocity, no GNSS in the last 120 s": Case(ends=True),
}


class Found(NamedTuple):
    """The first state [s], scale learnt and its sigma at the end; RMSE [m], its claim, share inside the 95 % ellipse, worst
    error; resets."""

    first: float
    scale: float
    sigma: float
    rmse: float
    inside: float
    worst: float
    resets: int


def course(random: np.random.Generator) -> list[Segment]:
    """About 1 m/s, with bends and stops, from standstill on."""
    segments: list[Segment] = [{"duration_s": 5.0}, {"duration_s": 3.0, "speed_mps": 1.0}]
    while sum(segment["duration_s"] for segment in segments) < DRIVE_S:
        side = float(random.choice((-1.0, 1.0)))
        segments += [
            {"duration_s": float(random.uniform(8, 20)), "speed_mps": float(random.uniform(0.7, 1.2))},
            {"duration_s": float(random.uniform(5, 9)), "turn_deg": side * float(random.uniform(30, 120))},
        ]
        if random.random() < 0.15:
            segments += [
                {"duration_s": 3.0, "speed_mps": 0.0}, {"duration_s": 5.0}, {"duration_s": 3.0, "speed_mps": 1.0},
            ]  # fmt: skip
    return segments


def one(name: str, seed: int, run: int) -> Found:
    case, random = CASES[name], np.random.default_rng([seed, run, 5])
    tables = ROVER | {"vehicle": ROVER["vehicle"] | {"skid": case.skid}}
    made = recorded(scenario(random, DRIVE_S, segments=course(random), **tables), int(random.integers(1 << 31)))
    config = changed(made.config, "filter", wheel_scale_sigma=0.01, v_max_mps=3.0)
    events = made.events
    if not case.velocity:
        config = changed(config, "gnss", use_velocity=False)
        events = [event for event in events if not isinstance(event.payload, GnssVelocity)]
    cut = later(LOST_S, outage(DRIVE_S)) if case.ends else nothing
    seen = watch(Recorded(events, made.truth, config), cut(events, made.start_ns, random), DRIVE_S)
    rows = seen.between(0.0, DRIVE_S)
    distance, sigmas = seen.distance()[rows], seen.sigmas()[rows]
    scale, sigma = seen.scales[-1]
    return Found(
        seen.started_s, scale, sigma, float(np.sqrt(np.mean(distance**2))), float((sigmas < SIGMAS_95).mean()),
        float(distance.max()), seen.resets,
    )  # fmt: skip


def rover(runs: int, seed: int) -> Section:
    section = Section("A slow rover")
    section.say(
        f"{runs} drives of the simulator, seed {seed}: about 1 m/s with bends and stops, IMU 30 Hz, four unsteered wheels "
        f"at 10 Hz that read {SCALE:.1%} too high, GNSS 2.5 Hz. In bends the wheels' difference is 1.5 times that of a "
        "vehicle that does not slide. The configuration is the one that the simulator writes, with the default sigma of the "
        "wheel scale (1 %). Off: the learnt scale's worst distance from the truth, in its own sigmas."
    )
    rows = []
    for name in CASES:
        found = spread(one, [(name, seed, run) for run in range(runs)])
        off = max(abs(f.scale - SCALE) / f.sigma for f in found)
        rows.append(
            (name, f"{np.median([f.first for f in found]):.1f} s", f"{max(f.first for f in found):.1f} s",
             f"{np.mean([f.scale for f in found]):+.2%}", f"{np.mean([f.sigma for f in found]):.2%}", f"{off:.1f}",
             f"{np.sqrt(np.mean([f.rmse**2 for f in found])):.2f} m", f"{np.mean([f.inside for f in found]):.0%}",
             f"{max(f.worst for f in found):.1f} m", sum(f.resets for f in found))
        )  # fmt: skip
    head = ("rover", "first state, median", "worst", "scale learnt, mean", "its sigma", "off, in sigmas", "RMSE",
            "inside 95 %", "worst error", "resets")  # fmt: skip
    section.table(head, rows)
    return section
