"""The runner of the system tests: its tools find each other, it tells the first error, and what fails twice has failed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system import __main__ as runner
from tests.system import guest


def test_an_unpacked_tool_finds_the_one_beside_it(tmp_path: Path) -> None:
    programs = tmp_path / "usr" / "bin"
    programs.mkdir(parents=True)
    for name, script in (("mmdebstrap", "exec mmtarfilter"), ("mmtarfilter", f"touch {tmp_path}/filtered")):
        (programs / name).write_text(f"#!/bin/sh\n{script}\n")
        (programs / name).chmod(0o755)
    guest._call(["mmdebstrap"], tools=tmp_path)
    assert (tmp_path / "filtered").exists()


def test_the_first_error_is_told_and_not_its_consequences(tmp_path: Path) -> None:
    lines = ["W: skipped a key", "", "Can't exec \"mmtarfilter\"", "E: mmdebstrap failed to run"]
    program = tmp_path / "usr" / "bin" / "fails"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\ncat >&2 <<'END'\n" + "\n".join(lines) + "\nEND\nexit 1\n")
    program.chmod(0o755)
    with pytest.raises(guest.BuildError, match=r'^fails: Can\'t exec "mmtarfilter"$'):
        guest._call(["fails"], tools=tmp_path)


@pytest.mark.parametrize(
    ("runs", "expected"),
    [([set()], set()), ([{"hang"}, set()], set()), ([{"hang"}, {"disk"}], set()), ([{"hang", "disk"}, {"hang"}], {"hang"})],
)
def test_only_a_check_that_fails_twice_fails(
    runs: list[set[str]], expected: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = iter(runs)
    monkeypatch.setattr(runner, "build", lambda here: Path("fusiond.deb"))
    monkeypatch.setattr(runner, "run", lambda here, package: next(results))
    assert runner.judge(here=False, twice=True) == expected
    assert next(results, None) is None


def test_what_cannot_be_built_is_a_failure_and_what_cannot_run_here_is_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(error: Exception) -> int:
        def build(here: bool) -> Path:
            raise error

        monkeypatch.setattr(runner, "build", build)
        monkeypatch.setattr("sys.argv", ["tests.system"])
        return runner.main()

    assert fail(guest.Unavailable("no root")) == runner.SKIPPED
    assert fail(guest.BuildError("no mmtarfilter")) == 1
    assert "no mmtarfilter" in capsys.readouterr().out
