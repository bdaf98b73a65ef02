"""A guest with real vcan and real systemd, for machines without: Debian 12 as user-mode Linux, built from its packages.

Nothing is installed on this machine: tools it lacks are unpacked from their packages under the cache folder. The guest's
disk is a throwaway copy, its network loopback only. It sees the job's folder of this machine as /job, and nothing else.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

SUITE, PYTHON = "bookworm", (3, 11)  # the suite's own Python: packages are compiled for it
INCLUDE = "systemd-sysv,kmod,iproute2,procps,python3"
MODULES = ("net/can/can.ko", "net/can/can-raw.ko", "drivers/net/can/dev/can-dev.ko", "drivers/net/can/vcan.ko",
           "net/ipv6/ipv6.ko")
MEMORY = "1536M"
IDLE_UNITS = (
    "apt-daily.timer", "apt-daily-upgrade.timer", "dpkg-db-backup.timer", "e2scrub_all.timer", "e2scrub_reap.service",
    "fstrim.timer", "getty.target", "systemd-networkd.service", "systemd-networkd.socket", "systemd-tmpfiles-clean.timer",
)  # fmt: skip
JOB = """\
#!/bin/sh
# Mounts the job's folder of the host, runs its `run`, and ends the guest.
mkdir -p /job && mount -t hostfs none /job && cd /job && ./run > out/log 2>&1 < /dev/null
echo $? > /job/out/status
sync
systemctl poweroff --force --force
"""
JOB_UNIT = """\
[Unit]
Description=The job
After=multi-user.target
[Service]
ExecStart=/usr/local/sbin/job
KillMode=process
"""


NO_ERROR = re.compile(r"(?i)(?:W|N|I|warning|notice|note|info)\s*:")  # lines that begin like this


class Unavailable(Exception):
    """No guest can run on this machine; the message says why."""


class BuildError(Exception):
    """What this machine should be able to build cannot be built; the message says why."""


def build(cache: Path) -> None:
    """Create the guest's kernel and disk in a folder, once. Raises Unavailable, BuildError."""
    if (cache / "root.img").is_file():
        return
    if sys.version_info[:2] != PYTHON:
        wanted, have = (".".join(map(str, version)) for version in (PYTHON, sys.version_info[:2]))
        raise Unavailable(f"the guest's Python is {wanted}, this is {have}")
    if os.geteuid() != 0 or os.uname().machine != "x86_64":
        raise Unavailable("building the guest takes root on x86-64")
    if shutil.which("apt-get") is None:
        raise Unavailable("building the guest takes Debian's apt-get")
    cache.mkdir(parents=True, exist_ok=True)
    tools = _tools(cache / "tools")
    root = cache / "root"
    shutil.rmtree(root, ignore_errors=True)
    paths = [f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in ("man", "doc", "locale")]
    _call(["mmdebstrap", "--quiet", "--variant=minbase", f"--include={INCLUDE}", *paths,
           '--aptopt=APT::Install-Recommends "false"', SUITE, str(root)], tools=tools)  # fmt: skip
    _furnish(root, tools)
    size = sum(path.lstat().st_size for path in root.rglob("*")) // 1_000_000 + 900  # room for what is installed
    image = cache / "root.tmp"
    image.unlink(missing_ok=True)
    _call(["mke2fs", "-q", "-t", "ext4", "-O", "^has_journal", "-m", "0", "-E", "root_owner=0:0",
           "-d", str(root), str(image), f"{size}M"], tools=tools)  # fmt: skip
    shutil.copy2(tools / "usr/bin/linux.uml", cache / "linux")
    image.rename(cache / "root.img")
    shutil.rmtree(root)


def _tools(folder: Path) -> Path:
    """The packages that build and boot the guest, unpacked. Raises Unavailable where they cannot be fetched."""
    if (folder / "done").is_file():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    packages = ["user-mode-linux", *(() if shutil.which("mmdebstrap") else ("mmdebstrap",))]
    packages += () if shutil.which("mke2fs", path=_path()) else ("e2fsprogs", "libext2fs2", "libss2", "libcom-err2")
    try:
        _call(["apt-get", "-q", "download", *packages], folder)
    except BuildError:
        try:
            _call(["apt-get", "-q", "update"])
            _call(["apt-get", "-q", "download", *packages], folder)
        except BuildError as error:
            raise Unavailable(f"Debian's packages cannot be fetched: {error}") from error
    for package in folder.glob("*.deb"):
        _call(["dpkg-deb", "-x", str(package), str(folder)])
    (folder / "done").touch()
    return folder


def _path(tools: Path | None = None) -> str:
    """Where programs are looked for: those unpacked first, as they call each other."""
    unpacked = [str(tools / folder) for folder in ("usr/bin", "sbin", "usr/sbin")] if tools else []
    return os.pathsep.join([*unpacked, os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"])


def _furnish(root: Path, tools: Path) -> None:
    """Kernel modules, names, and the unit that runs the job."""
    (release,) = (tools / "usr/lib/uml/modules").iterdir()
    target = root / "lib/modules" / release.name
    for name in ("modules.order", "modules.builtin", *(f"kernel/{module}" for module in MODULES)):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(release / name, target / name)
    crc = release / "kernel/lib/crc-ccitt.ko"
    if crc.exists():
        (target / "kernel/lib").mkdir(exist_ok=True)
        shutil.copy2(crc, target / "kernel/lib")
    _call(["chroot", str(root), "/sbin/depmod", release.name])
    (root / "etc/modules-load.d/job.conf").write_text("can\ncan-raw\nvcan\nipv6\n")
    (root / "etc/hostname").write_text("guest\n")
    (root / "etc/hosts").write_text("127.0.0.1 localhost guest\n")
    (root / "etc/fstab").write_text("")
    (root / "etc/dpkg/dpkg.cfg.d/fast").write_text("force-unsafe-io\n")  # the disk is thrown away
    (root / "usr/local/sbin/job").write_text(JOB)
    (root / "usr/local/sbin/job").chmod(0o755)
    units = root / "etc/systemd/system"
    (units / "job.service").write_text(JOB_UNIT)
    (units / "graphical.target.wants").mkdir(exist_ok=True)
    (units / "graphical.target.wants/job.service").symlink_to("../job.service")
    for name in IDLE_UNITS:
        (units / name).symlink_to("/dev/null")


def _call(command: Sequence[str], folder: Path | None = None, tools: Path | None = None) -> None:
    """Run a command, with the unpacked tools if given. Raises BuildError."""
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C", "PATH": _path(tools)}
    if tools is not None and (tools / "lib/x86_64-linux-gnu").is_dir():
        environment["LD_LIBRARY_PATH"] = f"{tools}/lib/x86_64-linux-gnu:{tools}/usr/lib/x86_64-linux-gnu"
    program = shutil.which(command[0], path=environment["PATH"])
    if program is None:
        raise BuildError(f"there is no {command[0]}")
    try:
        done = subprocess.run([program, *command[1:]], cwd=folder, env=environment, capture_output=True, text=True,
                              timeout=600, check=False)  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"{command[0]}: {error}") from error
    if done.returncode:
        raise BuildError(f"{command[0]}: {first_error(done.stderr) or first_error(done.stdout) or 'failed'}")


def first_error(output: str) -> str:
    """The first line of a program's messages that is no warning or remark: those after it are mostly consequences."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return next((line for line in lines if not NO_ERROR.match(line)), "")


def run(cache: Path, job: Path, limit_s: float) -> int:
    """Boot the guest, run `job/run` in it, and show its output as it comes. Returns its status; 124 after the time limit,
    125 if the guest died. Raises Unavailable."""
    out = job / "out"
    out.mkdir(exist_ok=True)
    log = out / "log"
    log.touch()
    memory = Path("/dev/shm") if Path("/dev/shm").is_dir() else None  # a slow disk must not be what is measured
    with tempfile.TemporaryDirectory(prefix="guest-", dir=memory) as scratch, (out / "console").open("wb") as console:
        command = [
            str(cache / "linux"), f"mem={MEMORY}", f"ubd0={scratch}/cow,{cache / 'root.img'}", "root=/dev/ubda", "rw",
            "rootfstype=ext4", "quiet", "con=null", "con0=null,fd:2", "ssl=null", f"uml_dir={scratch}/", f"hostfs={job}",
            "systemd.show_status=0", "systemd.unified_cgroup_hierarchy=1",
        ]  # fmt: skip
        if os.geteuid() == 0:
            command = ["nice", "-n", "-10", *command]  # it measures times, whatever else this machine does
        command = ["taskset", "--cpu-list", str(max(os.sched_getaffinity(0))), *command]  # twice as fast as on several
        environment = os.environ | {"TMPDIR": scratch}
        try:
            guest = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=console, stderr=console, env=environment,
                                     start_new_session=True)  # fmt: skip
        except OSError as error:
            raise Unavailable(f"the guest does not start: {error}") from error
        group = Path(f"/proc/{guest.pid}/autogroup")  # where the kernel groups by session, `nice` counts in a session only
        if os.geteuid() == 0 and group.exists():
            group.write_text("-10")
        ends = time.monotonic() + limit_s
        with log.open() as output:
            while guest.poll() is None and time.monotonic() < ends:
                sys.stdout.write(output.read())
                sys.stdout.flush()
                time.sleep(0.2)
            timed_out = guest.poll() is None
            if timed_out:
                os.killpg(guest.pid, 9)
            guest.wait()
            sys.stdout.write(output.read())
    if timed_out:
        return 124
    status = out / "status"
    return int(status.read_text()) if status.is_file() else 125
