"""Parts of the study: its world matches the filter's model, and its bound is right for a filter with a known covariance."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.study import nominal
from benchmarks.study.bound import Bound
from benchmarks.study.runs import Ledger, drive, error, started
from benchmarks.study.world import GNSS_NAME, Fault, Sensors, World
from fusiond.estimator.fusion import Fusion
from fusiond.filter.state import ATTITUDE, POSITION, VELOCITY
from fusiond.maths.typed import Array
from tests.conftest import needs_compiled

SMALL = 1e-6
COURSE = [(6.0, 12.0, 60.0, 2.0), (6.0, 9.0, -90.0, -2.0)]
QUIET = {
    "filter": {"mount_sigma_deg": 1.0, "wheel_scale_sigma": 0.01, "heading_sigma_deg": 1e-4, "level_sigma_deg": 1e-4},
    "imu": dict.fromkeys(("accel_noise", "gyro_noise", "accel_bias_sigma", "gyro_bias_sigma"), SMALL),
    "gnss": dict.fromkeys(("position_sigma_m", "height_sigma_m", "velocity_sigma_mps"), 1e-3),
    "wheel": {"sigma_mps": 5e-3},  # less is below what scale and velocity, both off at the start, make as a product
}


def errors(fusion: Fusion, world: World, sensors: Sensors, looks: list[float]) -> tuple[Array, Array]:
    """Errors (looks, n) and covariances (looks, n, n)."""
    found: list[Array] = []
    claimed: list[Array] = []

    def look(_: float, k: int) -> None:
        found.append(error(fusion.history.head, world, k))
        claimed.append(fusion.history.head.covariance.copy())

    drive(fusion, sensors.measurements(), looks, look)
    return np.array(found), np.array(claimed)


@needs_compiled
def test_without_noise_the_filter_follows_the_world() -> None:
    """Positions, velocities, rates and forces of the world agree with each other, slip and random mount included."""
    random = np.random.default_rng(1)
    config = nominal.config(**QUIET)
    world, fusion = World(nominal.scenario(course=COURSE), config, random), Fusion(config, True)
    started(fusion, world, random)
    off, _ = errors(fusion, world, Sensors(world), [5.0, 11.0])
    assert np.abs(world.slip(world.t)[0]).max() > 0.2
    assert np.abs(off[:, POSITION]).max() < 5e-3
    assert np.abs(off[:, VELOCITY]).max() < 2e-3
    assert np.abs(off[:, ATTITUDE]).max() < 1e-3


@needs_compiled
def test_the_bound_is_what_a_filter_near_the_truth_claims() -> None:
    """Two ways to the same number: the study's own transition and noise, and the compiled kernel's."""
    random = np.random.default_rng(2)
    config = nominal.config(
        filter={"heading_sigma_deg": 0.1, "level_sigma_deg": 0.1, "mount_sigma_deg": 0.1, "gate_probability": 1 - 1e-12},
        imu={"gyro_noise": 1e-4},
    )
    world, fusion = World(nominal.scenario(course=COURSE, imu_hz=100.0), config, random), Fusion(config, True)
    started(fusion, world, random)
    looks = [2.19, 8.19]
    _, claimed = errors(fusion, world, Sensors(world), looks)
    bound = Bound(world, 50.0).run(looks)
    for block in (POSITION, VELOCITY, ATTITUDE):
        sigma, least = (np.sqrt(np.trace(p[:, block, block], axis1=1, axis2=2)) for p in (claimed, bound))
        assert sigma == pytest.approx(least, rel=0.02)


@needs_compiled
def test_faults_reach_the_filter() -> None:
    random = np.random.default_rng(3)
    config = nominal.config()
    world, fusion = World(nominal.scenario(course=COURSE), config, random), Fusion(config, True)
    started(fusion, world, random)
    ledger = Ledger(fusion)
    faults = (Fault("rear_left", "scale", 6.0, 8.0, 1.3), Fault(GNSS_NAME, "absent", 8.0, 10.0))
    drive(fusion, Sensors(world, faults=faults).measurements(), [], lambda t, k: None, ledger)
    t, rejected = ledger.rejected("rear_left")
    assert rejected[(t > 6.1) & (t < 8)].mean() > 0.9
    assert rejected[t < 6].mean() < 0.02
    t, _ = ledger.rejected(f"{GNSS_NAME}.position")
    assert not ((t >= 8) & (t < 10)).any()
    assert len(t) == 51  # of 61
