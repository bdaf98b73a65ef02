"""A keeper: a process that has everything imported, and forks a child with limits of its own for each drive.

A bad drive costs only its child: what takes too long or too much memory is ended, and the answer says so. The keeper has
one thread, so that forking is safe; whoever uses it, a thread of the local pool or a worker of a cluster, talks to it over
its standard input and output. When these close, or the keeper is killed, the child ends too.

    python -m fusiond.app.batch.keeper

A job and an answer are each one line of JSON.
"""

from __future__ import annotations

import ctypes
import os
import resource
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from types import TracebackType

import msgspec

from fusiond.app.batch.job import Answer, Job, Limits
from fusiond.app.batch.row import Status

WAITING = 10.0  # times the processor time that may pass on the clock
ATTEMPTS = 3  # of a job whose process was killed from outside
MEGABYTE = 1 << 20
PR_SET_PDEATHSIG = 1
NOT_READY = b""


class KeeperError(Exception):
    """The keeper has ended in the middle of a job."""


# --- For those who use one


class Keeper:
    """A keeper's process, started with the first job, and again when it has been killed. A context manager."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False

    @property
    def pid(self) -> int | None:
        """Of its process; None before the first job."""
        return self._process.pid if self._process else None

    def run(self, job: Job) -> Answer:
        """The answer to a job. One whose process was killed from outside is run again, ATTEMPTS times in all."""
        killed = ""
        for _ in range(ATTEMPTS):
            if self._stopped:
                return Answer(status="crashed", reason="stopped")
            try:
                answer = self._run(job)
            except KeeperError as error:
                killed = str(error)
                self.close()
                continue
            if answer.status != "crashed":
                return answer
            killed = answer.reason
        return Answer(status="crashed", reason=f"{killed}, {ATTEMPTS} times")

    def _run(self, job: Job) -> Answer:
        process = self._process = self._process or _start()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(msgspec.json.encode(job) + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:
            line = NOT_READY
        if not line.endswith(b"\n"):
            raise KeeperError("the process that kept it was killed")
        return msgspec.json.decode(line, type=Answer)

    def stop(self) -> None:
        """End it and its child, from any thread: the job that runs is not run again."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """End it, and its child. Not while a job runs."""
        if self._process is not None:
            process, self._process = self._process, None
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with suppress(OSError):
                        pipe.close()
            process.kill()
            process.wait()

    def __enter__(self) -> Keeper:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _start() -> subprocess.Popen[bytes]:
    """In a session of its own, so that Ctrl-C reaches only the driver; with one thread for linear algebra, so that the child
    may be forked and gives the same bits everywhere."""
    return subprocess.Popen(
        [sys.executable, "-m", "fusiond.app.batch.keeper"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )


# --- The process itself


def main() -> None:
    """Answer jobs until the standard input ends."""
    import fusiond.app.batch.measure  # noqa: F401, PLC0415 - imported once, for all children
    import fusiond_adapters.logs.candump  # noqa: PLC0415
    import fusiond_adapters.logs.tlog  # noqa: F401, PLC0415

    jobs, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    while line := jobs.readline():
        answer = _in_child(msgspec.json.decode(line, type=Job))
        answers.write(msgspec.json.encode(answer) + b"\n")
        answers.flush()


def _in_child(job: Job) -> Answer:
    receiver, sender = os.pipe()
    child = os.fork()
    if child == 0:
        _work(job, receiver, sender)
    os.close(sender)
    try:
        told, over = _gathered(receiver, child, time.monotonic() + WAITING * job.limits.seconds)
    finally:
        os.close(receiver)
    _, status, used = os.wait4(child, 0)
    answer = _judged(told, os.waitstatus_to_exitcode(status), over, job.limits)
    return msgspec.structs.replace(answer, cpu_s=used.ru_utime + used.ru_stime, peak_mb=used.ru_maxrss / 1024)


def _gathered(receiver: int, child: int, until_s: float) -> tuple[bytes, bool]:
    """What the child tells, and whether it was ended because it waited for too long. Where nobody waits for an answer any
    more, the keeper ends, and its child with it."""
    told = bytearray()
    poll = select.poll()
    poll.register(receiver, select.POLLIN)
    poll.register(0, 0)  # the end of the standard input only
    while True:
        left_s = until_s - time.monotonic()
        ready = dict(poll.poll(max(0.0, left_s) * 1e3))
        if 0 in ready:
            os.kill(child, signal.SIGKILL)
            sys.exit(1)
        if receiver in ready:
            some = os.read(receiver, 1 << 16)
            if not some:
                return bytes(told), False
            told += some
        elif left_s <= 0:
            os.kill(child, signal.SIGKILL)
            return bytes(told), True


def _judged(told: bytes, code: int, over: bool, limits: Limits) -> Answer:
    """The answer, or from how the child ended why there is none."""
    if over:
        return Answer(status="timed out", reason=f"not ended after {WAITING * limits.seconds:g} s, mostly waiting")
    if code == 0:
        with suppress(msgspec.DecodeError):
            return msgspec.json.decode(told, type=Answer)
    if code == -signal.SIGPROF:
        return Answer(status="timed out", reason=f"more than {limits.seconds:g} s of processor time")
    how = f"its process was killed by {signal.Signals(-code).name}" if code < 0 else f"its process ended with status {code}"
    return Answer(status="crashed", reason=how)


def _work(job: Job, receiver: int, sender: int) -> None:
    """The child: measure, tell, end. It never returns."""
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        os.close(receiver)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, job.limits.seconds)
        most = int(job.limits.memory_mb * MEGABYTE)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        with os.fdopen(sender, "wb") as pipe:
            pipe.write(msgspec.json.encode(_measured(job)))
        os._exit(0)
    finally:  # an exception here is a fault of the program, or memory for the answer is missing
        os._exit(70)


def _measured(job: Job) -> Answer:
    from fusiond.app.batch.measure import measure, tell  # noqa: PLC0415 - imported already

    try:
        if job.tune:
            return Answer(told=tell(job))
        return Answer(row=measure(job))
    except MemoryError:
        return _ended("out of memory", f"more than {job.limits.memory_mb:g} MB")
    except Exception as fault:  # the others go on; the row says what happened
        return _ended("failed", f"a fault of fusiond: {type(fault).__name__}: {fault}")


def _ended(status: Status, reason: str) -> Answer:
    return Answer(status=status, reason=reason)


if __name__ == "__main__":
    main()
