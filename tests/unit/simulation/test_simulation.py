"""The simulator: exact physics, honest noise, faults that do what they say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.maths import wgs84 as earth
from fusiond.maths.rotation import matrix, quaternion_exp
from fusiond.maths.typed import Array
from fusiond.simulation import wgs84, wheels
from fusiond.simulation.drive import Drive, simulate
from fusiond.simulation.scenario import Scenario, parse
from fusiond.simulation.trajectory import Trajectory, blend, blend_integral
from fusiond.simulation.truth import Truth

DRIVE = """
[[segment]]
duration_s = 3
[[segment]]
duration_s = 9
speed_mps = 14.0
[[segment]]
duration_s = 10
turn_deg = 100.0
grade_deg = 4.0
[[segment]]
duration_s = 10
turn_deg = -80.0
grade_deg = -3.0
[[segment]]
duration_s = 8
speed_mps = 0.0
grade_deg = 0.0
[[segment]]
duration_s = 4
[[segment]]
duration_s = 8
speed_mps = -3.0
turn_deg = 20.0
[[segment]]
duration_s = 8
speed_mps = 0.0
"""
CRUISE = "[start]\nspeed_mps = 10.0\n[[segment]]\nduration_s = {}\n"
REST = "[[segment]]\nduration_s = {}\n"
CLEAN = {  # no sensor noise at all
    "imu": "accel_noise = 0\ngyro_noise = 0\naccel_bias = [0, 0, 0]\ngyro_bias = [0, 0, 0]\n"
    "accel_bias_walk = 0\ngyro_bias_walk = 0\n",
    "gnss": "sigma_m = 0\nheight_sigma_m = 0\ndrift_sigma_m = 0\nheight_drift_sigma_m = 0\nvelocity_sigma_mps = 0\n",
    "wheels": "sigma_mps = 0\n",
}


def scenario(drive: str = DRIVE, clean: bool = True, **tables: str) -> Scenario:
    """A scenario of a drive and of lines for some tables, without noise unless asked for."""
    text = dict(tables)
    for name, lines in CLEAN.items() if clean else ():
        given = {line.split(" = ")[0] for line in tables.get(name, "").splitlines()}
        unsaid = [line for line in lines.splitlines() if line.split(" = ")[0] not in given]
        text[name] = "\n".join([*unsaid, tables.get(name, "")])
    return parse(drive + "".join(f"[{name}]\n{lines}\n" for name, lines in text.items()))


def ecef(latitude: Array, longitude: Array, height: Array) -> Array:
    return np.array([earth.ecef(*place) for place in zip(latitude, longitude, height, strict=True)])


def mats_nb(truth: Truth) -> Array:
    return np.array([matrix(quaternion) for quaternion in truth.quaternion_nb])


def seconds(drive: Drive, stamps_us: Array) -> Array:
    """Receive stamps as seconds from the start of the drive."""
    return (stamps_us - drive.scenario.start_ns // 1000) / 1e6


# physics


def test_blend_is_smooth_and_its_derivatives_and_integral_agree() -> None:
    u = np.linspace(0.0, 1.0, 20001)
    value, first, second, third = blend(u)
    step = u[1] - u[0]
    for function, derivative in ((blend_integral(u), value), (value, first), (first, second), (second, third)):
        assert np.allclose(np.gradient(function, step)[1:-1], derivative[1:-1], atol=2e-3 * np.abs(derivative).max())
    assert (value[0], value[-1]) == pytest.approx((0, 1), abs=1e-12)
    assert blend_integral(np.ones(1))[0] == pytest.approx(0.5)
    for ends in (first, second, third):
        assert np.allclose(ends[[0, -1]], 0, atol=1e-9)


def test_vector_earth_agrees_with_the_filters() -> None:
    latitude, height = np.radians([-80.0, -30.0, 0.0, 48.0, 89.0]), np.array([0.0, 100.0, 9000.0, -50.0, 560.0])
    meridian, transverse = wgs84.radii(latitude)
    for k, (lat, h) in enumerate(zip(latitude.tolist(), height.tolist(), strict=True)):
        assert (meridian[k], transverse[k]) == pytest.approx(earth.radii(lat), rel=1e-14)
        assert wgs84.gravity(latitude, height)[k] == pytest.approx(earth.gravity(lat, h), rel=1e-14)
        assert wgs84.earth_rate_n(latitude)[k] == pytest.approx(earth.earth_rate_n(lat), abs=1e-18)


@pytest.mark.parametrize(
    "start",
    [
        "latitude_deg = 48.1\nlongitude_deg = 11.6\nheading_deg = 30.0\n",
        "latitude_deg = -77.8\nlongitude_deg = 179.9995\nheight_m = 3000.0\nheading_deg = 95.0\n",
    ],
)
def test_noiseless_imu_integrates_back_to_the_truth(start: str) -> None:
    """An integration of its own: earth-fixed axes, samples interpolated linearly, one minute with bends and hills."""
    truth = simulate(scenario(start=start, imu="mount_deg = [1.0, -2.0, 3.0]\nrate_hz = 200.0\n")).truth
    place = ecef(truth.latitude, truth.longitude, truth.height)
    mat_ne = earth.mat_ne(place[0])
    position, velocity = place[0], mat_ne.T @ truth.velocity_n[0]
    mat_eb = mat_ne.T @ matrix(truth.quaternion_nb[0])
    dt, earth_rate = 1 / 200, np.array([0.0, 0.0, earth.EARTH_RATE])
    earth_turn = matrix(quaternion_exp(-earth_rate * dt))
    worst = 0.0
    for k in range(len(truth.t_ns) - 1):
        rate = (truth.angular_rate_b[k] + truth.angular_rate_b[k + 1]) / 2
        turned = earth_turn @ mat_eb @ matrix(quaternion_exp(rate * dt))
        force = (mat_eb @ truth.specific_force_b[k] + turned @ truth.specific_force_b[k + 1]) / 2
        free = force + earth.gravity_e(position + velocity * dt / 2)
        free -= 2 * np.cross(earth_rate, velocity + free * dt / 2)
        position = position + velocity * dt + free * dt * dt / 2
        velocity, mat_eb = velocity + free * dt, turned
        worst = max(worst, float(np.linalg.norm(position - place[k + 1])))
    assert worst < 5e-3
    mat_ne = earth.mat_ne(place[-1])
    assert mat_ne @ velocity == pytest.approx(truth.velocity_n[-1], abs=1e-3)
    assert mat_ne @ mat_eb == pytest.approx(matrix(truth.quaternion_nb[-1]), abs=1e-5)


def test_rates_and_forces_have_no_steps() -> None:
    truth = simulate(scenario(imu="rate_hz = 200.0\n")).truth
    assert np.abs(np.diff(truth.angular_rate_b, axis=0)).max() < 0.01
    assert np.abs(np.diff(truth.specific_force_b, axis=0)).max() < 0.15


def test_rear_axle_does_not_slip_sideways() -> None:
    imu = "position_m = [1.2, 0.3, -0.6]\nmount_deg = [0.0, 2.0, -3.0]\n"
    made = scenario(imu=imu)
    trajectory, truth = Trajectory(made), simulate(made).truth
    mats = mats_nb(truth)
    rate_b = truth.angular_rate_b - np.einsum("nji,nj->ni", mats, wgs84.earth_rate_n(truth.latitude))
    velocity_b = np.einsum("nji,nj->ni", mats, truth.velocity_n) + np.cross(rate_b, trajectory.lever_b((0, 0, 0)))
    velocity_v = velocity_b @ trajectory.mat_vb.T
    assert np.abs(velocity_v[:, 1:]).max() < 1e-4
    assert velocity_v[:, 0] == pytest.approx(truth.speed, abs=1e-4)
    assert truth.speed.max() == pytest.approx(14) and truth.speed.min() == pytest.approx(-3)


def test_wheels_measure_the_motion_of_their_contact_points() -> None:
    flat = "\n".join(line for line in DRIVE.splitlines() if "grade" not in line) + "\n"
    made = scenario(flat, vehicle="roll_deg_per_mps2 = 0.0\n", imu="rate_hz = 200.0\n")
    trajectory, truth = Trajectory(made), simulate(made).truth
    speeds = wheels.true_speeds(made, trajectory.kinematics(trajectory.t))
    mats, place = mats_nb(truth), (truth.latitude, truth.longitude, truth.height)
    for column, point in enumerate(wheels.positions_v(made)):
        path = ecef(*wgs84.shifted(*place, mats @ trajectory.lever_b(tuple(point))))
        moved = np.linalg.norm(path[2:] - path[:-2], axis=1) * 100.0
        assert moved == pytest.approx(np.abs(speeds[1:-1, column]), abs=3e-3)
    bend = 17 * 200  # to the right: the left wheels are faster, the front ones roll farther than the rear ones
    front_left, front_right, rear_left, rear_right = speeds[bend]
    assert front_left > rear_left > rear_right and front_right > rear_right


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


# noise


def test_imu_noise_and_bias_have_the_stated_densities() -> None:
    imu = "accel_noise = 0.01\ngyro_noise = 1e-3\naccel_bias_walk = 0.02\ngyro_bias_walk = 1e-3\n"
    drive = simulate(scenario(REST.format(200), clean=False, imu=imu, wheels="chatter = false\n"))
    for read, bias, true, density in (
        (drive.imu.specific_force_b, drive.truth.accel_bias_b, drive.truth.specific_force_b, 0.01),
        (drive.imu.angular_rate_b, drive.truth.gyro_bias_b, drive.truth.angular_rate_b, 1e-3),
    ):
        white = (read - bias - true)[:20000]
        assert white.std(axis=0) == pytest.approx(density * 10, rel=0.03)
        means = white.reshape(-1, 100, 3).mean(axis=1)  # Allan deviation at 1 s is the density
        allan = np.sqrt((np.diff(means, axis=0) ** 2).mean(axis=0) / 2)
        assert allan == pytest.approx(density, rel=0.25)
        assert np.diff(bias, axis=0).std(axis=0) == pytest.approx(density * (2 if density > 5e-3 else 1) / 10, rel=0.03)


def test_vibration_grows_with_speed_and_keeps_to_its_band() -> None:
    imu = "vibration_hz = [20.0]\nvibration_mps2 = 0.5\n"
    moving = simulate(scenario(CRUISE.format(40), imu=imu))
    shake = moving.imu.specific_force_b - moving.truth.specific_force_b
    assert shake.std(axis=0) == pytest.approx(0.5 / math.sqrt(2), rel=0.1)
    power = np.abs(np.fft.rfft(shake, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(shake), 0.01)
    assert power[np.abs(frequency - 20) < 5].sum() > 0.9 * power.sum()
    resting = simulate(scenario(REST.format(5), imu=imu))
    assert resting.imu.specific_force_b == pytest.approx(resting.truth.specific_force_b, abs=1e-5)


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
    assert (fixes.h_acc, fixes.vel_acc) == (1118, 100)


def test_velocity_lags_by_the_stated_time() -> None:
    sharp, lagging = (
        simulate(scenario(gnss=f"rate_hz = 10.0\nvelocity_lag_ms = {lag}\n")).gnss.fixes.vel / 100 for lag in (0, 200)
    )
    speeding_up = slice(60, 100)
    assert lagging[speeding_up] == pytest.approx(sharp[58:98], abs=0.05)
    assert np.abs(lagging[speeding_up] - sharp[speeding_up]).max() > 0.2


def test_wheel_noise_scale_and_resolution() -> None:
    spec = "sigma_mps = 0.05\nscale_error = 0.02\nscale_errors = [0.0, 0.0, 0.01, -0.01]\nresolution_kmh = 0.02\n"
    drive = simulate(scenario(CRUISE.format(100), wheels=spec))
    speeds = drive.wheels.raw * 0.02 / 3.6
    assert speeds.mean(axis=0) == pytest.approx([10.2, 10.2, 10.302, 10.098], abs=0.003)
    assert speeds.std(axis=0) == pytest.approx(0.05, rel=0.04)
    assert drive.truth.wheel_scale == pytest.approx((0.02, 0.02, 0.0302, 0.0098))


# faults


def test_seeds_and_faults_leave_the_other_noise_alone() -> None:
    plain = simulate(scenario(clean=False))
    faulty = simulate(
        scenario(
            clean=False,
            gnss="outage_s = [[20, 30]]\n[[gnss.jump]]\nstart_s = 40\nstop_s = 45\noffset_m = [9, 9, 9]\n",
            wheels='[[wheels.slip]]\nwheel = "rear_left"\nstart_s = 10\nstop_s = 12\nfactor = 1.3\n',
        )
    )
    other = simulate(scenario(clean=False), seed=2)
    assert np.array_equal(plain.imu.specific_force_b, faulty.imu.specific_force_b)
    assert np.array_equal(plain.imu.t_receive_us, faulty.imu.t_receive_us)
    assert np.array_equal(plain.wheels.raw[:, [0, 1, 3]], faulty.wheels.raw[:, [0, 1, 3]])
    late = faulty.gnss.time_us > plain.gnss.time_us[0] + 46_000_000
    assert np.array_equal(faulty.gnss.fixes.lat[late], plain.gnss.fixes.lat[-late.sum() :])
    assert not np.array_equal(plain.imu.specific_force_b, other.imu.specific_force_b)
    assert not np.array_equal(plain.wheels.raw, other.wheels.raw)


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


def test_wheel_faults() -> None:
    spec = """
fault_s = [[2, 3]]
silent_s = [[4, 5]]
[[wheels.slip]]
wheel = "front_left"
start_s = 6
stop_s = 7
factor = 1.3
[[wheels.stuck]]
wheel = "rear_right"
start_s = 8
stop_s = 12
"""
    drive = simulate(scenario(wheels=spec))
    plain = simulate(scenario())
    t = seconds(drive, drive.wheels.t_receive_us)
    same = np.isin(plain.wheels.t_receive_us, drive.wheels.t_receive_us)
    raw, clean = drive.wheels.raw, plain.wheels.raw[same]
    assert drive.wheels.fault.sum() == 100 and drive.wheels.fault[(t > 2.01) & (t < 2.99)].all()
    assert not ((t > 4.01) & (t < 4.99)).any()
    slip = (t > 6.01) & (t < 6.99)
    assert raw[slip, 0] == pytest.approx(clean[slip, 0] * 1.3, abs=1) and np.array_equal(raw[slip, 1:], clean[slip, 1:])
    stuck = (t > 8.01) & (t < 11.99)
    assert len(set(raw[stuck, 3])) == 1 and len(set(clean[stuck, 3])) > 100
    assert np.array_equal(raw[t > 12.1], clean[t > 12.1])


def test_standing_wheels_read_zero_and_unsigned_ones_hide_the_direction() -> None:
    spec = "sigma_mps = 0.05\nleast_mps = 0.2\nunsigned = {}\n"
    signed, unsigned = (simulate(scenario(wheels=spec.format(word))).wheels.raw for word in ("false", "true"))
    assert (unsigned[:290] == 0).all()
    assert unsigned.min() == 0 and signed[-800:].min() * 0.01 / 3.6 == pytest.approx(-3.2, abs=0.4)
    assert np.array_equal(np.abs(signed), unsigned)


def test_reboot_restarts_the_boot_clock_after_a_silence() -> None:
    drive = simulate(
        scenario(autopilot="boot_s = 100.0\ndrift_ppm = 200.0\n[[autopilot.reboot]]\nat_s = 20\nsilence_s = 2\n")
    )
    t, boot = seconds(drive, drive.imu.t_receive_us) - 0.002, drive.imu.time_us / 1e6
    before = t < 20
    assert boot[before] == pytest.approx((100 + t[before]) * 1.0002, abs=1e-4)
    assert boot[~before] == pytest.approx((t[~before] - 20) * 1.0002, abs=1e-4)
    assert t[~before][0] == pytest.approx(22) and drive.imu.counter[~before][0] < 4
    pairs = drive.time.unix_us / 1e6 - drive.scenario.start.time_unix_s
    assert ((pairs < 20) | (pairs >= 22)).all()
    assert drive.time.boot_ms[pairs < 20] == pytest.approx((100 + pairs[pairs < 20]) * 1000.2, abs=1)


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


# transport


def test_loss_jitter_and_reordering() -> None:
    link = "[imu.transport]\nlatency_ms = 5.0\njitter_ms = 8.0\nloss = 0.1\nreorder = {}\n"
    mixed, ordered = (simulate(scenario(imu=link.format(word))) for word in ("true", "false"))
    for drive in (mixed, ordered):
        assert (np.diff(drive.imu.t_receive_us) >= 0).all()
        assert len(drive.imu.time_us) == pytest.approx(6001 * 0.9, rel=0.02)
    assert (np.diff(mixed.imu.time_us) < 0).mean() > 0.05 and (np.diff(ordered.imu.time_us) > 0).all()
    late_ms = (mixed.imu.t_receive_us - (mixed.imu.time_us + mixed.scenario.start_ns // 1000 - 60_000_000)) / 1e3
    assert late_ms.min() == pytest.approx(5, abs=0.1) and late_ms.mean() == pytest.approx(13, rel=0.05)
    missing = (np.diff(ordered.imu.counter) - 1) % 256
    assert (missing > 0).sum() > 400  # the link's frame counter shows the gaps


def test_host_clock_offset_moves_receipts_and_truth() -> None:
    plain, ahead = simulate(scenario()), simulate(scenario(host="offset_s = 1.5\n"))
    for name in ("imu", "gnss", "wheels"):
        assert set(getattr(ahead, name).t_receive_us - getattr(plain, name).t_receive_us) == {1_500_000}
    assert set(ahead.truth.t_ns - plain.truth.t_ns) == {1_500_000_000}
    assert np.array_equal(ahead.gnss.time_us, plain.gnss.time_us)


def test_a_drive_of_which_nothing_arrives() -> None:
    nothing = "silent_s = [[0, 99]]\n"
    made = scenario(REST.format(1), imu=nothing, wheels=nothing, gnss="outage_s = [[0, 99]]\n")
    assert {event.source for event in simulate(made).events()} == {"fcu.time"}
