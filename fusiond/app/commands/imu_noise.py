"""fusiond imu_noise: the noise densities of the inertial sensor in logs."""

from __future__ import annotations

import argparse

from fusiond.app.commands.arguments import add_config_and_logs, taken_config
from fusiond.app.inspection.drive import Drive, imu_noise
from fusiond.app.replay.intervals import parse_interval
from fusiond.config import load as config
from fusiond.errors import UnusableError
from fusiond_adapters.logs.merge import open_logs

ABOUT = """\
Measure the noise densities of the inertial sensor in the logs of a drive, vibration included, from the differences of
successive samples: slow changes, such as driving, cancel. Configure the largest of each line, rounded up."""
LEAST_SAMPLES = 10


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, "example:\n  fusiond imu_noise car.toml drive.tlog --window 25-30"
    add_config_and_logs(parser, "as for replay")
    parser.add_argument("--window", metavar="START-STOP", help="these seconds only, counted from the first sample")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    loaded = config.load(taken_config(arguments))
    rows = Drive(loaded, open_logs(arguments.logs, loaded)).rows(next(iter(loaded.imu)))
    if arguments.window and len(rows):
        start_s, stop_s = parse_interval(arguments.window)
        since_s = rows[:, 0] - rows[0, 0]
        rows = rows[(since_s >= start_s) & (since_s < stop_s)]
    if len(rows) < LEAST_SAMPLES:
        raise UnusableError(f"{len(rows)} valid samples of the inertial sensor are too few")
    accel, gyro = imu_noise(rows)
    elapsed_s = rows[-1, 0] - rows[0, 0]
    print(f"{len(rows)} samples at {(len(rows) - 1) / elapsed_s:.1f} Hz; forward, right, down:")
    print("accel_noise [m/s^2/sqrt(Hz)]", *(f"{value:.2g}" for value in accel))
    print("gyro_noise  [rad/s/sqrt(Hz)]", *(f"{value:.2g}" for value in gyro))
