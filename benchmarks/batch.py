"""`fusiond batch` at its size: a thousand drives with bad ones among them, killed; who is called worse; memory.

    python -m benchmarks.batch thousand [--drives 1000] [--workers 2] [--kills 5]
    python -m benchmarks.batch significance [--drives 120] [--repetitions 100]
    python -m benchmarks.batch memory

`thousand`: simulated drives of 60 s, of which 10 are broken, 3 never end, and 1 eats memory. They are measured by the local
pool; by a Dask cluster of which a worker is killed (SIGKILL); and by a batch that is killed so often at random points, and
one of whose processes is killed too. All must give the same bytes, and for each drive the right reason.

`significance`: of a pool of drives forty are drawn for each repetition. The same configuration on the same courses with
other noise must not be called worse; three times the noise, and a delay that is 50 ms off, must.

`memory`: of the driver, for 1,000 and for 10,000 drives whose rows are given at once.
"""

from __future__ import annotations

import argparse
import io
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec.structs import replace

from fusiond.app.batch.batch import ROWS, Order, run
from fusiond.app.batch.engines import Engine, LocalPool, Numbered
from fusiond.app.batch.job import Answer, Options
from fusiond.app.batch.row import Row
from fusiond.app.batch.significance import Pairs
from fusiond.app.batch.store import NAME
from fusiond.app.batch.table import read_rows
from tests.helpers import fleet

SECONDS, MEMORY_MB, RATE_HZ = 3.0, 300.0, 2.0  # limits of a drive; states compared a second
DRAWN = 40  # drives of a repetition
BROKEN = ((fleet.empty, "failed", "is empty"), (fleet.garbage, "failed", "no MAVLink frame"),
          (fleet.lost_imu, "failed", "no state"))  # fmt: skip
ENDLESS = (fleet.endless, "timed out", "more than 3 s of processor time")
HUNGRY = (fleet.hungry, "out of memory", "more than 300 MB")


# --- A thousand drives


def spoilt(drives: Sequence[Path], seed: int) -> dict[str, tuple[str, str]]:
    """Spoil some drives; returns status and reason of each."""
    ways = [*(BROKEN[number % len(BROKEN)] for number in range(10)), *[ENDLESS] * 3, HUNGRY]
    found = {}
    for drive, (spoil, status, reason) in zip(random.Random(seed).sample(drives, len(ways)), ways, strict=True):
        spoil(drive)
        found[str(drive)] = status, reason
    return found


def command(folder: Path, out: Path, *more: object) -> list[str]:
    words = ["batch", folder, "-o", out, "--rate", RATE_HZ, "--seconds", SECONDS, "--memory", MEMORY_MB, "--reports", 0]
    return [sys.executable, "-m", "fusiond", *map(str, [*words, *more])]


def descendants(pid: int) -> Iterator[int]:
    """The processes below one."""
    with suppress(OSError):
        for children in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in children.read_text().split():
                yield int(child)
                yield from descendants(int(child))


def words_of(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return ""


def rows_done(out: Path) -> int:
    with suppress(sqlite3.Error):
        base = sqlite3.connect(f"file:{out / NAME}?mode=ro", uri=True)
        try:
            return int(base.execute("select count(*) from rows").fetchone()[0])
        finally:
            base.close()
    return 0


def disturbed(words: list[str], out: Path, rows: int, victim: str) -> bool:
    """Run a command; when it has made so many rows, kill it, or a process below it whose command line has a text. Whether
    that was in time."""
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and rows_done(out) < rows:
            time.sleep(0.02)
        in_time = process.poll() is None
        if victim:
            below = [pid for pid in descendants(process.pid) if victim in words_of(pid)]
            if below:
                os.kill(below[0], signal.SIGKILL)
            in_time = in_time and bool(below)
        else:
            process.kill()
    return in_time


def judged(out: Path, expected: dict[str, tuple[str, str]], drives: int) -> Counter[str]:
    """The statuses of the rows; each must be what is expected."""
    statuses: Counter[str] = Counter()
    for drive, _, row in read_rows(out / ROWS):
        status, reason = expected.get(drive, ("ok", ""))
        assert row.status == status and reason in row.reason, f"{drive}: {row.status}: {row.reason}; expected {status}"
        statuses[status] += 1
    assert statuses.total() == drives
    return statuses


def thousand(folder: Path, count: int, workers: int, kills: int) -> None:
    made = fleet.drives(folder / "fleet", range(count), 60.0)
    expected, dice = spoilt(made, 1), random.Random(2)
    print(f"{count} drives of 60 s", flush=True)
    local, dask, killed = (folder / name for name in ("local", "dask", "killed"))
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(command(folder / "fleet", local, "--workers", workers), check=True, stdout=subprocess.DEVNULL)
    took, after = time.monotonic() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    base = sqlite3.connect(local / NAME)
    (alone,) = base.execute("select total(cpu_s) from rows").fetchone()
    base.close()
    print(f"local pool, {workers} workers: {dict(judged(local, expected, count))}")
    print(f"  {used:.0f} s of processor time for replays of {alone:.0f} s: {used / alone:.3f}; {took:.0f} s on the clock"
          f" ({took * workers / alone:.2f} / workers)", flush=True)  # fmt: skip
    content = (local / ROWS).read_bytes()

    words = command(folder / "fleet", dask, "--engine", "dask", "--workers", workers)
    in_time = disturbed(words, dask, count // 2, "multiprocessing.spawn")
    same = (dask / ROWS).is_file() and (dask / ROWS).read_bytes() == content
    print(f"Dask cluster, a worker killed in the middle: {in_time}; the same bytes: {same}", flush=True)

    words = command(folder / "fleet", killed, "--workers", workers)
    points = sorted(dice.sample(range(1, count - 10), kills))
    in_times = [disturbed(words, killed, point, "") for point in points]
    after_kills = rows_done(killed)
    kept = disturbed(words, killed, min(count - 5, after_kills + 5), "batch.keeper")
    same_again = (killed / ROWS).read_bytes() == content
    print(f"killed after {', '.join(map(str, points))} rows: {sum(in_times)} times, and one of its processes: {kept};"
          f" the same bytes: {same_again}", flush=True)  # fmt: skip
    assert same and same_again


# --- Significance


def significance(folder: Path, count: int, repetitions: int) -> None:
    fleet.drives(folder / "a", range(count), 60.0)
    fleet.drives(folder / "b", range(count, 2 * count), 60.0)
    base = fleet.configuration(folder, "base.toml")
    worse = {
        "noise x 3": fleet.configuration(folder, "noise.toml", ("position_sigma_m = 0.539", "position_sigma_m = 1.617"),
                                         ("accel_noise = 0.003", "accel_noise = 0.009"),
                                         ("gyro_noise = 0.0002", "gyro_noise = 0.0006")),
        "delay 50 ms off": fleet.configuration(folder, "delay.toml", ("delay_ms = 0  # how", "delay_ms = 50  # how")),
    }  # fmt: skip
    first, again = (rows(folder / name, base, folder / f"out-{name}") for name in ("a", "b"))
    print(f"{count} drives of 60 s twice; {repetitions} repetitions of {DRAWN}")
    for name, others in {"the same, other noise": again, "the very same": first}.items():
        calls = called(first, others, repetitions, swapped=True)
        print(f"{name}: called worse {calls['worse']}, better {calls['better']} times", flush=True)
    for name, config in worse.items():
        calls = called(first, rows(folder / "a", config, folder / f"out-{config.stem}"), repetitions, swapped=False)
        print(f"{name}: called worse {calls['worse']}, better {calls['better']} times", flush=True)


def rows(drives: Path, config: Path, out: Path) -> list[Row]:
    with LocalPool(2) as engine:
        run(Order([str(drives)], out, str(config), options=Options(rate_hz=RATE_HZ)), engine, io.StringIO())
    return [row for _, _, row in read_rows(out / ROWS)]


def called(old: Sequence[Row], new: Sequence[Row], repetitions: int, *, swapped: bool) -> Counter[str]:
    """How often which verdict is given; `swapped`: the two sides of each pair are chosen at random."""
    verdicts: Counter[str] = Counter()
    for repetition in range(repetitions):
        dice, pairs = random.Random(repetition), Pairs()
        for number in dice.sample(range(len(old)), DRAWN):
            one, other = old[number], new[number]
            pairs.add(*((other, one) if swapped and dice.random() < 0.5 else (one, other)))
        verdicts[pairs.compared().verdict] += 1
    return verdicts


# --- Memory


class Dry(Engine):
    """Gives a row at once, without a replay."""

    def __init__(self, row: Row) -> None:
        self._row = row

    def answers(self, jobs: Iterable[Numbered]) -> Iterator[tuple[str, Answer]]:
        for key, job in jobs:
            yield key, Answer(row=replace(self._row, **job.known()))

    def close(self) -> None:
        """Nothing runs."""


def memory(folder: Path) -> None:
    (pattern,) = fleet.drives(folder / "pattern", range(1), 60.0)
    (row,) = rows(pattern, pattern / "fusiond.toml", folder / "row")
    for count in (1_000, 10_000):
        for number in range(count):
            drive = folder / f"of{count}" / f"drive{number:05d}"
            drive.mkdir(parents=True)
            (drive / "drive.tlog").write_text(f"{number}")
        child = os.fork()
        if child == 0:
            order = Order([str(folder / f"of{count}")], folder / f"out{count}", str(pattern / "fusiond.toml"))
            run(order, Dry(row), io.StringIO())
            os._exit(0)
        _, status, used = os.wait4(child, 0)
        assert status == 0
        print(f"{count} drives: peak of {used.ru_maxrss / 1024:.0f} MB", flush=True)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.batch", description=__doc__)
    parser.add_argument("what", choices=("thousand", "significance", "memory"))
    parser.add_argument("--drives", type=int)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--repetitions", type=int, default=100)
    options = parser.parse_args(arguments)
    with TemporaryDirectory(prefix="fusiond-batch-") as folder:
        if options.what == "thousand":
            thousand(Path(folder), options.drives or 1000, options.workers, options.kills)
        elif options.what == "significance":
            significance(Path(folder), options.drives or 120, options.repetitions)
        else:
            memory(Path(folder))


if __name__ == "__main__":
    main(sys.argv[1:])
