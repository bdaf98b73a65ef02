"""The simulated GNSS receiver: lever arm, noise, lag, faults, stamps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.events import GnssPosition
from fusiond.maths import wgs84 as earth
from fusiond.simulation import wgs84
from fusiond.simulation.drive import simulate
from fusiond.simulation.trajectory import Trajectory
from tests.helpers.simulated import CRUISE, REST, ecef, mats_nb, scenario, seconds


def test_antenna_moves_on_its_lever_arm() -> None:
    made = scenario(gnss="antenna_m = [2.0, 0.5, -1.5]\nrate_hz = 10.0\n", imu="mount_deg = [0.0, 1.0, 2.0]\n")
    trajectory, drive = Trajectory(made), simulate(made)
    fixes, rows = drive.gnss.fixes, slice(None, None, 10)  # the IMU runs at 100 Hz
    truth = drive.truth
    lever_n = mats_nb(truth) @ trajectory.lever_b(made.gnss.antenna_m)
    expected = ecef(*wgs84.shifted(truth.latitude, truth.longitude, truth.height, lever_n))
    found = ecef(np.radians(fixes.lat / 1e7), np.radians(fixes.lon / 1e7), fixes.alt_ellipsoid / 1e3)
    assert np.linalg.norm(found - expected[rows], axis=1).max() < 0.012
    velocity_e = np.gradient(expected, 0.01, axis=0)
    speed = [np.hypot(*(earth.mat_ne(p) @ v)[:2]) for p, v in zip(expected[rows], velocity_e[rows], strict=True)]
    assert fixes.vel / 100 == pytest.approx(speed, abs=0.012)


def test_gnss_noise_is_white_plus_drifting() -> None:
    gnss = "rate_hz = 5.0\nsigma_m = 0.5\ndrift_sigma_m = 1.0\ncorrelation_s = 10.0\nvelocity_sigma_mps = 0.1\n"
    drive = simulate(scenario(REST.format(3000), clean=False, gnss=gnss, imu="rate_hz = 10.0\n"))
    fixes = drive.gnss.fixes
    north = np.radians(fixes.lat / 1e7 - 48.137) * 6.38e6
    assert north.std() == pytest.approx(math.hypot(0.5, 1.0), rel=0.15)
    assert np.diff(north).std() == pytest.approx(math.sqrt(2 * (0.25 + 1 - math.exp(-0.02))), rel=0.03)
    later = np.corrcoef(north[:-50], north[50:])[0, 1]  # 10 s
    assert later == pytest.approx(math.exp(-1) / 1.25, abs=0.12)
    assert (fixes.vel / 100).mean() == pytest.approx(0.1 * math.sqrt(math.pi / 2), rel=0.03)
    assert set(fixes.h_acc) == {1118} and fixes.vel_acc == 100


def test_velocity_lags_by_the_stated_time() -> None:
    sharp, lagging = (
        simulate(scenario(gnss=f"rate_hz = 10.0\nvelocity_lag_ms = {lag}\n")).gnss.fixes.vel / 100 for lag in (0, 200)
    )
    speeding_up = slice(60, 100)
    assert lagging[speeding_up] == pytest.approx(sharp[58:98], abs=0.05)
    assert np.abs(lagging[speeding_up] - sharp[speeding_up]).max() > 0.2


def test_gnss_faults() -> None:
    gnss = """
outage_s = [[3, 4]]
no_fix_s = [[5, 6]]
frozen_s = [[7, 8]]
rate_hz = 10.0
[[gnss.jump]]
start_s = 10
stop_s = 11
offset_m = [20.0, 0.0, -5.0]
[[gnss.spoof]]
start_s = 12
rate_mps = [1.0, 0.0, 0.0]
"""
    plain, faulty = (simulate(scenario(CRUISE.format(20), gnss=lines)) for lines in ("rate_hz = 10.0\n", gnss))
    t = (faulty.gnss.time_us - faulty.scenario.start_ns // 1000) / 1e6
    fixes = faulty.gnss.fixes
    assert not ((t >= 3) & (t < 4)).any() and len(t) == 201 - 10
    assert set(fixes.fix_type[(t >= 5) & (t < 6)]) == {1} and set(fixes.lat[(t >= 5) & (t < 6)]) == {0}
    frozen = (t >= 6.9) & (t < 8)
    assert len(set(fixes.lat[frozen])) == 1 and frozen.sum() == 11
    same = np.isin(plain.gnss.time_us, faulty.gnss.time_us)
    north = np.radians((fixes.lat - plain.gnss.fixes.lat[same]) / 1e7) * 6.367e6
    up = (fixes.alt - plain.gnss.fixes.alt[same]) / 1e3
    jump, spoof = (t >= 10) & (t < 11), t >= 12
    assert north[jump] == pytest.approx(20, abs=0.1) and up[jump] == pytest.approx(5, abs=0.01)
    assert north[spoof] == pytest.approx(t[spoof] - 12, abs=0.1)
    assert (fixes.vel - plain.gnss.fixes.vel[same])[spoof] == pytest.approx(100, abs=1)
    assert north[t < 3] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("stamp", "offset_us"), [("unix", 0), ("boot-arrival", 60_100_000), ("none", None)])
def test_stamps_of_fixes(stamp: str, offset_us: int | None) -> None:
    drive = simulate(scenario(gnss=f'stamp = "{stamp}"\ndelay_ms = 100.0\n'))
    t_us = np.arange(len(drive.gnss.time_us)) * 200_000
    start_us = drive.scenario.start_ns // 1000 if stamp == "unix" else 0
    expected = np.zeros_like(t_us) if offset_us is None else t_us + start_us + offset_us
    assert np.abs(drive.gnss.time_us - expected).max() <= 1
    assert seconds(drive, drive.gnss.t_receive_us) == pytest.approx(t_us / 1e6 + 0.102, abs=1e-6)
    stamps = {(event.clock, event.t_sensor_ns is None) for event in drive.events() if event.source == "gps0.position"}
    assert stamps == {{"unix": ("unix", False), "boot-arrival": ("fcu/1/boot", False), "none": ("", True)}[stamp]}


def test_fix_types_have_errors_and_accuracies_of_their_own() -> None:
    gnss = """
[[gnss.quality]]
start_s = 0
fix = "fixed"
sigma_m = 0.02
[[gnss.quality]]
start_s = 1000
fix = "float"
sigma_m = 0.1
bias_sigma_m = 0.5
[[gnss.quality]]
start_s = 2000
fix = "fixed"
sigma_m = 0.02
bias_sigma_m = 0.03
"""
    drive = simulate(scenario(REST.format(3000), clean=False, gnss=gnss, imu="rate_hz = 10.0\n"))
    t, fixes = np.arange(len(drive.gnss.time_us)) / 5, drive.gnss.fixes
    north, up = np.radians(fixes.lat / 1e7 - 48.137) * 6.38e6, fixes.alt_ellipsoid / 1e3 - 560.0
    biases = []
    for start, kind, sigma, accuracy in ((0, 6, 0.02, 20), (1000, 5, 0.1, 510), (2000, 6, 0.02, 36)):
        rows = (t >= start) & (t < start + 1000)
        assert set(fixes.fix_type[rows]) == {kind} and set(fixes.h_acc[rows]) == {accuracy}
        assert north[rows].std() == pytest.approx(sigma, rel=0.03) and up[rows].std() == pytest.approx(2 * sigma, rel=0.03)
        biases.append(north[rows].mean() - north[t < 1000].mean())
    told = {event.payload.fix_type for event in drive.events() if isinstance(event.payload, GnssPosition)}
    assert told == {5, 6}
    assert biases[0] == 0 and abs(biases[1]) > 0.05 and 0.005 < abs(biases[2]) < 0.1


def test_errors_of_the_velocity_last() -> None:
    drive = simulate(scenario(CRUISE.format(3000), gnss="velocity_sigma_mps = 0.1\nvelocity_correlation_s = 2.0\n"))
    speed = drive.gnss.fixes.vel / 100 - 10
    assert speed.std() == pytest.approx(0.1, rel=0.1)
    assert np.corrcoef(speed[:-10], speed[10:])[0, 1] == pytest.approx(math.exp(-1), abs=0.1)
