"""Runs the system tests: in a guest with real vcan and real systemd, or, with `--here`, on this machine itself.

    python -m tests.system [--here] [--twice]

Builds the Debian package, a drive, and (once) the guest under build/; prints a table of the checks. Exit status: 0 all
passed, 1 a check failed or the guest or package could not be built, 77 this machine cannot run it, with the reason.
`--here` is for a machine that may be harmed: it installs the package, stops and starts it, and steps the clock. It takes
root, vcan, and systemd as PID 1. `--twice` is for a busy machine, which may fail a check that measures time: after a
failure all is run again, and only a check that failed both times is a failure.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.system import guest

ROOT = Path(__file__).parents[2]
CACHE = ROOT / "build" / "guest"
DATA = ROOT.parent / "shared" / "data" / "comma2k19-rav4"
SKIPPED = 77  # exit status: nothing was tested
LIMIT_S = 420.0  # for the checks
ENDED = "the run came to its end"
SCENARIO = """\
seed = 5
truth_rate_hz = 10
[start]
heading_deg = 60.0
[vehicle]
name = "bench"
[imu]
rate_hz = 100.0
[gnss]
rate_hz = 10.0
delay_ms = 120.0
[wheels]
rate_hz = 50.0
"""
AWAY, ROUND = [(2, 0, 0), (6, 10, 0)], [(8, 14, 90), (8, 14, 0), (8, 9, 90), (8, 11, 0)]  # s, m/s, deg
RUN = """\
#!/bin/sh
# The job: install the package as a user would, and run the checks with its own Python.
set -e
dpkg --install fusiond.deb
PYTHONDONTWRITEBYTECODE=1 exec /opt/fusiond/bin/python checks.py "$PWD"
"""


def unfit() -> str | None:
    """Why `--here` is impossible; None if it is possible."""
    if os.geteuid() != 0:
        return "it takes root"
    if Path("/proc/1/comm").read_text().strip() != "systemd":
        return "PID 1 is not systemd"
    made = subprocess.run(["ip", "link", "add", "dev", "vcan99", "type", "vcan"], capture_output=True, check=False)
    if made.returncode:
        return "there is no vcan"
    subprocess.run(["ip", "link", "delete", "vcan99"], check=True)
    return None


def make_package() -> Path:
    """The Debian package of these sources. Raises BuildError."""
    done = subprocess.run(["packaging/deb.sh"], cwd=ROOT, env=os.environ | {"PYTHON": sys.executable},
                          capture_output=True, text=True, check=False)  # fmt: skip
    if done.returncode:
        raise guest.BuildError(f"the package: {guest.first_error(done.stderr) or 'failed'}")
    return max((ROOT / "dist").glob("fusiond_*.deb"), key=lambda path: path.stat().st_mtime)


def make_drive(folder: Path) -> None:
    """A simulated drive of seven minutes in circles."""
    folder.mkdir()
    segments = (f"[[segment]]\nduration_s = {s}\nspeed_mps = {v}.0\nturn_deg = {t}.0\n" for s, v, t in AWAY + ROUND * 13)
    (folder / "scenario.toml").write_text(SCENARIO + "".join(segments))
    command = [sys.executable, "-m", "fusiond", "simulate", "--config", str(folder / "scenario.toml"), "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def make_job(job: Path, package: Path) -> None:
    """Everything that the checks need, in a folder."""
    make_drive(job / "drive")
    for name in ("checks.py", "bench.py", "faults.py", "reader.py", "vehicle.py"):
        shutil.copy2(Path(__file__).parent / name, job)
    if DATA.is_dir():
        (job / "rav4").mkdir()
        for name in ("drive.tlog", "drive.candump.log", "truth.csv"):
            shutil.copyfile(DATA / name, job / "rav4" / name)
        for name in ("rav4.toml", "rav4.dbc"):
            shutil.copy2(ROOT / "configs" / name, job / "rav4")
    shutil.copy2(package, job / "fusiond.deb")
    (job / "out").mkdir()
    (job / "run").write_text(RUN)
    (job / "run").chmod(0o755)


def table(checks: list[dict[str, Any]]) -> str:
    """The checks as a table."""
    width = max(len(check["name"]) for check in checks)
    lines = [f"{check['name']:<{width}}  {'ok' if check['passed'] else 'FAILED':<6}  {check['found']}" for check in checks]
    rule = "-" * max(map(len, lines))
    passed = sum(check["passed"] for check in checks)
    return "\n".join([rule, f"{'check':<{width}}  {'':<6}  found", rule, *lines, rule, f"{passed} of {len(checks)} passed"])


def build(here: bool) -> Path:
    """The guest, if one is needed, and the package, which is returned. Raises Unavailable, BuildError."""
    if here and (reason := unfit()):
        raise guest.Unavailable(f"not on this machine: {reason}")
    began = time.monotonic()
    with ThreadPoolExecutor() as pool:
        built = pool.submit(lambda: None if here else guest.build(CACHE))
        package = pool.submit(make_package)
        built.result()
        made = package.result()
    print(f"built in {time.monotonic() - began:.0f} s", flush=True)
    return made


def run(here: bool, package: Path) -> set[str]:
    """Run all checks, and show them. Returns what failed: the checks, and the run where it did not end by itself. Raises
    Unavailable."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fusiond-system-") as folder:
        job = Path(folder)
        make_job(job, package)
        status = subprocess.run([job / "run"], cwd=job, check=False).returncode if here else guest.run(CACHE, job, LIMIT_S)
        kept = ROOT / "out" / "system"
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(job / "out", kept)
    found = kept / "checks.json"
    checks = json.loads(found.read_text()) if found.is_file() else []
    if checks:
        print(table(checks))
    print(f"{time.monotonic() - began:.0f} s; journal and log in {kept.relative_to(ROOT)}/")
    failed = {check["name"] for check in checks if not check["passed"]}
    if status != bool(failed):
        print(f"{ENDED}: no, status {status}")
        failed.add(ENDED)
    return failed


def judge(here: bool, twice: bool) -> set[str]:
    """Build what is needed and run all checks; with `twice`, once more if one failed. Returns what failed each time. Raises
    Unavailable, BuildError."""
    package = build(here)
    failed = run(here, package)
    if failed and twice:
        print(f"once more, for: {', '.join(sorted(failed))}", flush=True)
        failed &= run(here, package)
    return failed


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.system", description=__doc__.split("\n\n")[0])
    parser.add_argument("--here", action="store_true", help="on this machine itself, which may be harmed")
    parser.add_argument("--twice", action="store_true", help="run again after a failure; only what fails twice has failed")
    options = parser.parse_args()
    try:
        failed = judge(options.here, options.twice)
    except guest.Unavailable as reason:
        print(f"system tests SKIPPED: {reason}")
        return SKIPPED
    except guest.BuildError as error:
        print(f"system tests FAILED, not built: {error}")
        return 1
    if failed:
        print(f"system tests FAILED: {', '.join(sorted(failed))}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
