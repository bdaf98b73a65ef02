"""Small fleets of simulated drives, for the tests and the benchmark of `fusiond batch`."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

from fusiond.simulation.scenario import Scenario, parse
from fusiond_adapters.logs.write import write_drive

SCENARIO = """
[[segment]]
duration_s = {rest}
[[segment]]
duration_s = {pull}
speed_mps = 14
[[segment]]
duration_s = {bend}
turn_deg = 90
[[segment]]
duration_s = {straight}
[[segment]]
duration_s = {bend}
turn_deg = -70
speed_mps = 9
[imu]
rate_hz = {imu_hz}
[gnss]
rate_hz = 2
sigma_m = 0.5
drift_sigma_m = 0.2
[wheels]
rate_hz = 5
chatter = false
"""
SHARES = {"rest": 0.07, "pull": 0.15, "bend": 0.2, "straight": 0.38}  # of the drive
BLOCK = bytes(1 << 20)


def scenario(seconds: float, imu_hz: float = 20.0) -> Scenario:
    """A cheap drive."""
    return parse(SCENARIO.format(imu_hz=imu_hz, **{name: share * seconds for name, share in SHARES.items()}))


def drives(folder: Path, seeds: range, seconds: float = 12.0) -> list[Path]:
    """A folder for each seed, with logs, truth and configuration."""
    made, drive = [folder / f"drive{seed:04d}" for seed in seeds], scenario(seconds)
    for path, seed in zip(made, seeds, strict=True):
        write_drive(drive, path, seed)
    return made


def configuration(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    """The configuration of such drives with some of its text replaced, and its DBC file beside it."""
    (made,) = drives(folder / "pattern", range(1), 5.0)
    text = (made / "fusiond.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "wheels.dbc").write_bytes((made / "wheels.dbc").read_bytes())
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


# --- Bad drives


def empty(drive: Path) -> None:
    """A log without a byte."""
    (drive / "drive.log").write_bytes(b"")


def garbage(drive: Path) -> None:
    """A log of another kind under the name of one."""
    (drive / "drive.tlog").write_bytes(b"this is no log\n" * 1000)


def lost_imu(drive: Path) -> None:
    """A log that was cut after a second."""
    with (drive / "drive.tlog").open("r+b") as file:
        file.truncate(2000)


def endless(drive: Path, gigabytes: int = 10) -> None:
    """A packed log that is small on the disk, and hours of work: a preallocated file that was packed as a whole."""
    block = gzip.compress(BLOCK * 64)
    with (drive / "drive.tlog.gz").open("wb") as file:
        for _ in range(gigabytes * 16):
            file.write(block)
    (drive / "drive.tlog").unlink()


def hungry(drive: Path, megabytes: int = 300) -> None:
    """A DBC file that was preallocated, and never written: it is read as a whole."""
    os.truncate(drive / "wheels.dbc", megabytes << 20)
