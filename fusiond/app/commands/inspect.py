"""fusiond inspect: what is in logs, and a configuration to start from."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import msgspec

from fusiond.app.commands import EXIT_CODES
from fusiond.app.inspection.job import inspect
from fusiond.app.inspection.report import text
from fusiond.errors import OutputError, UsageError

ABOUT = """\
Tell what is in the logs of a vehicle, without a configuration: who sends which messages how regularly, what the sensors
measured, the clocks, and which CAN frames look like speeds. With --write-config, write a configuration to start from."""
EXAMPLES = """\
examples:
  fusiond inspect flight.bin
      what is in it, and whether it can be fused
  fusiond inspect drive.tlog drive.log --write-config car.toml
      the same of the two logs of a drive, and a configuration
  fusiond inspect drive.mf4 sensors.dbc --json - | jq .sources
      a CAN log whose sensors a DBC file describes; without one, those beside the log are used
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    parser.add_argument("files", metavar="FILE", nargs="+", help="logs of one vehicle (also .gz, .zst), and DBC files")
    parser.add_argument("--json", metavar="FACTS.json", type=Path, help="write the facts; - prints them in place of text")
    parser.add_argument("--write-config", metavar="C.toml", type=Path, help="write a configuration to start from")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    dbcs = [Path(name) for name in arguments.files if name.lower().endswith(".dbc")]
    logs = [name for name in arguments.files if not name.lower().endswith(".dbc")]
    if not logs:
        raise UsageError("give a log as well as its DBC files")
    target: Path | None = arguments.write_config
    if target is not None and target.exists():
        raise UsageError(f"{target} is there already; choose another name")
    found = inspect(logs, dbcs, target.parent if target else Path())
    facts = msgspec.json.format(msgspec.json.encode(found), indent=2)
    if arguments.json == Path("-"):
        print(facts.decode())
    else:
        print(text(found))
        if arguments.json is not None:
            write(arguments.json, facts.decode() + "\n")
    if target is not None:
        if found.config is None:
            raise UsageError(f"{target} is not written: {found.notes[0]}")
        write(target, found.config)
        copied = copy_beside(target, [Path(path) for path in found.copied])
        if arguments.json != Path("-"):
            print(f"\nwritten: {', '.join(map(str, (target, *copied)))}; next: fusiond check {target}")


def write(path: Path, content: str) -> None:
    """Write a file. Raises OutputError."""
    try:
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def copy_beside(target: Path, files: list[Path]) -> list[Path]:
    """Copy files into the folder of another, unless they are there; returns the copies. Raises OutputError."""
    copies = [target.parent / file.name for file in files]
    for file, copy in zip(files, copies, strict=True):
        try:
            if not copy.exists():
                shutil.copyfile(file, copy)
        except OSError as error:
            raise OutputError(f"{copy}: cannot be written: {error.strerror}") from error
    return copies
