"""The scripts that complete the command line: each names all commands and options, and bash completes with its own."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from fusiond.__main__ import SUCCESS, USAGE, main
from fusiond.app.commands import COMMANDS
from fusiond.app.commands.completion import SCRIPTS

OPTIONS = {"replay": ("--withhold", "--csv", "--config"), "top": ("--vehicle", "--once"), "simulate": ("--seed",)}


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main(["completion", shell]) == SUCCESS
    return capsys.readouterr().out


@pytest.mark.parametrize("shell", SCRIPTS)
def test_every_command_and_option_is_in_it(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = script(shell, capsys)
    assert all(name in text for name in COMMANDS)
    for options in OPTIONS.values():
        assert all((f"-l {option[2:]}" if shell == "fish" else option) in text for option in options)


@pytest.mark.parametrize("shell", SCRIPTS)
def test_the_shell_itself_reads_it(shell: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    file = tmp_path / "script"
    file.write_text(script(shell, capsys))
    subprocess.run([shell, "-n", str(file)], check=True)


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("repl", {"replay"}),
        ("re", {"replay"} | {name for name in COMMANDS if name.startswith("re")}),
        ("replay --with", {"--withhold"}),
        ("top --on", {"--once"}),
        ("completion f", {"fish"}),
        ("check car", {"car.toml"}),
        ("replay --config car.toml dri", {"drive.tlog", "drive.log"}),
    ],
)
def test_bash_completes(typed: str, expected: set[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name in ("car.toml", "drive.tlog", "drive.log"):
        (tmp_path / name).touch()
    (tmp_path / "script").write_text(script("bash", capsys))
    words = ["fusiond", *typed.split()]
    quoted = " ".join(f"'{word}'" for word in words)
    place = f"COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}"
    code = f"source ./script; {place}; _fusiond; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == expected


def test_other_shells_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["completion", "tcsh"])
    assert ended.value.code == USAGE
    assert "invalid choice: 'tcsh'" in capsys.readouterr().err
