"""Keepers: limits of time and memory, a process that is killed, and what is told of each."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from threading import Thread

import pytest

from fusiond.app.batch.drives import find
from fusiond.app.batch.job import Answer, Job, Limits, Options
from fusiond.app.batch.keeper import ATTEMPTS, Keeper, _judged
from tests.helpers import fleet

LIMITS = Limits(seconds=1.0, memory_mb=300.0)


def job(drive: Path, limits: Limits = LIMITS) -> Job:
    (found,) = find([str(drive)])
    return Job(drive=found, config="", options=Options(), limits=limits)


def child_of(pid: int) -> int | None:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(children[0]) if children else None


def killed_at_work(keeper: Keeper, wanted: Job, whom: str, times: int) -> Answer:
    """The answer of a keeper that is killed, or whose child is, as often as said while it works."""
    answers: list[Answer] = []
    thread = Thread(target=lambda: answers.append(keeper.run(wanted)))
    thread.start()
    victims: set[int] = set()
    while thread.is_alive() and len(victims) < times:
        pid = keeper.pid
        try:
            child = child_of(pid) if pid and pid not in victims else None
        except OSError:  # it has just gone
            child = None
        victim = pid if whom == "keeper" else child
        if child and victim and victim not in victims:
            victims.add(victim)
            os.kill(victim, signal.SIGKILL)
        time.sleep(0.005)
    thread.join()
    assert len(victims) == times
    return answers[0]


def test_a_bad_drive_costs_only_itself(tmp_path: Path) -> None:
    good, slow, hungry = fleet.drives(tmp_path, range(3))
    fleet.endless(slow)
    fleet.hungry(hungry)
    with Keeper() as keeper:
        answers = [keeper.run(job(drive)) for drive in (slow, hungry, good)]
        assert [answer.status for answer in answers] == ["timed out", "out of memory", "ok"]
        assert [answer.reason for answer in answers] == ["more than 1 s of processor time", "more than 300 MB", ""]
        assert answers[2].row is not None and answers[2].row.status == "ok"
        assert 0.5 < answers[0].cpu_s < 3.0 and 50 < answers[2].peak_mb < 300
        assert keeper.pid is not None and child_of(keeper.pid) is None


@pytest.mark.parametrize("whom", ["keeper", "child"])
def test_what_was_killed_is_run_again(tmp_path: Path, whom: str) -> None:
    (drive,) = fleet.drives(tmp_path, range(1), 60.0)
    with Keeper() as keeper:
        undisturbed = keeper.run(job(drive)).row
        answer = killed_at_work(keeper, job(drive), whom, 1)
    assert answer.row == undisturbed and answer.row is not None


def test_what_is_always_killed_is_told(tmp_path: Path) -> None:
    (drive,) = fleet.drives(tmp_path, range(1))
    fleet.endless(drive)
    with Keeper() as keeper:
        answer = killed_at_work(keeper, job(drive, Limits(seconds=60.0)), "child", ATTEMPTS)
    assert (answer.status, answer.reason) == ("crashed", f"its process was killed by SIGKILL, {ATTEMPTS} times")


def test_a_child_ends_with_its_keeper(tmp_path: Path) -> None:
    (drive,) = fleet.drives(tmp_path, range(1))
    fleet.endless(drive)
    with Keeper() as keeper:
        thread = Thread(target=lambda: keeper.run(job(drive, Limits(seconds=60.0))))
        thread.start()
        child = None
        while child is None:
            time.sleep(0.01)
            child = child_of(keeper.pid) if keeper.pid else None
        keeper.stop()
        thread.join(10.0)
        assert not thread.is_alive()
        for _ in range(500):
            if not _runs(child):
                break
            time.sleep(0.01)
        assert not _runs(child)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(
    ("code", "over", "status", "reason"),
    [
        (-signal.SIGPROF, False, "timed out", "more than 1 s of processor time"),
        (-signal.SIGSEGV, False, "crashed", "its process was killed by SIGSEGV"),
        (70, False, "crashed", "its process ended with status 70"),
        (0, False, "crashed", "its process ended with status 0"),  # and told nothing
        (-signal.SIGKILL, True, "timed out", "not ended after 10 s, mostly waiting"),
    ],
)
def test_how_a_child_ended_is_told(code: int, over: bool, status: str, reason: str) -> None:
    answer = _judged(b"", code, over, LIMITS)
    assert (answer.row, answer.status, answer.reason) == (None, status, reason)
