"""Notifications to systemd, and the units: valid, confined, identical except for the instance's name."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from fusiond_adapters.host.systemd import Notifier, watchdog_s
from tests.helpers.paths import ROOT

SYSTEMD = ROOT / "systemd"
UNITS = ("fusiond.service", "fusiond@.service")
EXPOSURE = 1.9  # the most that systemd may find
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze")


def analyze(*arguments: str) -> tuple[int, str]:
    done = subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, check=False, timeout=60)
    return done.returncode, done.stdout + done.stderr


@needs_systemd
@pytest.mark.parametrize("unit", UNITS)
def test_verified(unit: str, tmp_path: Path) -> None:
    copy = tmp_path / unit.replace("@.", "@car.")  # a template is verified by an instance
    copy.write_text((SYSTEMD / unit).read_text().replace("/opt/fusiond/bin/fusiond", "/bin/true"))
    code, said = analyze("verify", "--man=no", str(copy))
    ours = [line for line in said.splitlines() if "fusiond" in line]
    assert (code, ours) == (0, [])


@needs_systemd
@pytest.mark.parametrize("unit", UNITS)
def test_exposure(unit: str) -> None:
    code, said = analyze("security", "--offline=true", f"--threshold={round(10 * EXPOSURE)}", str(SYSTEMD / unit))
    found = re.search(r"Overall exposure level for .*: ([\d.]+)", said)
    assert code == 0 and found is not None and float(found[1]) <= EXPOSURE


def test_the_template_differs_by_the_instance_only() -> None:
    single, template = ((SYSTEMD / unit).read_text() for unit in UNITS)
    named = template.replace("/etc/fusiond/%i.toml", "/etc/fusiond/fusiond.toml").replace("fusiond/%i", "fusiond")

    def settings(text: str) -> list[str]:
        return [line for line in text.splitlines() if not line.startswith(("#", "Description="))]

    assert settings(single) == settings(named)


def test_the_watchdog_and_the_exit_codes_agree_with_the_daemon() -> None:
    text = (SYSTEMD / UNITS[0]).read_text()
    for line in ("Type=notify", "WatchdogSec=5", "Restart=on-failure", "RestartPreventExitStatus=2"):
        assert f"\n{line}\n" in text


def test_a_fault_in_it_cannot_take_the_whole_machine() -> None:
    text = (SYSTEMD / UNITS[0]).read_text()
    for line in ("MemoryMax=512M", "TasksMax=256", "LimitNOFILE=1024"):
        assert f"\n{line}\n" in text


def test_notifications(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.settimeout(10)
        manager.bind(str(tmp_path / "notify"))
        notifier = Notifier(str(tmp_path / "notify"))
        notifier.ready("well")
        notifier.ready("refused: a text\nof two lines")
        notifier.reloading()
        assert manager.recv(100) == b"READY=1\nSTATUS=well"
        assert manager.recv(100) == b"READY=1\nSTATUS=refused: a text of two lines"
        assert manager.recv(100).startswith(b"RELOADING=1\nMONOTONIC_USEC=")
    notifier.stopping()
    assert notifier.lost == 1
    notifier.close()
    monkeypatch.setenv("WATCHDOG_USEC", "5000000")
    assert watchdog_s() == 2.5
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_s() is None
