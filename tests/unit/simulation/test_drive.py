"""A whole drive: seeds, a reboot, the host's clock, and nothing that arrives."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.simulation.drive import simulate
from tests.helpers.simulated import REST, scenario, seconds


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
