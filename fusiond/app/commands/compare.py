"""fusiond compare: two tracks of one drive."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec

from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.argument_types import rate
from fusiond.app.compare.differences import differences, text
from fusiond.app.compare.series import Series, of_autopilot, of_csv, of_replay
from fusiond.app.replay.files import delivering
from fusiond.config import load as config
from fusiond.errors import UsageError

ABOUT = """\
Compare two tracks of one drive: what differs, when, and by how much against the sigmas of both. A configuration stands
for its replay of the logs, a .csv for a track that was written by `fusiond replay --csv` (of another version, say, or by
`fusiond smooth`). With one of them, the other track is the autopilot's own in the first log (.tlog, .bin, .ulg)."""
EXAMPLES = """\
examples:
  fusiond compare car.toml tuned.toml drive.tlog drive.log
      what does the other configuration change?
  fusiond compare before.csv after.csv
      what does the other version change?
  fusiond compare car.toml drive.tlog drive.log
      how far apart are fusiond and the autopilot's own filter?
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    add = parser.add_argument
    add("files", metavar="FILE", nargs="+", help="A.toml or A.csv, B.toml or B.csv, and the logs of the drive")
    add("--json", metavar="OUT.json", type=Path, help="write the differences")
    add("--rate", metavar="HZ", type=rate, help="states per second of a replay; default: publish.rate_hz of its config")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    names = [name for name in arguments.files if Path(name).suffix in (".toml", ".csv")]
    logs = [name for name in arguments.files if name not in names]
    if not 1 <= len(names) <= 2:
        raise UsageError(f"give one or two configurations or tracks (.toml, .csv), not {len(names)}")
    if not logs and (len(names) == 1 or any(Path(name).suffix == ".toml" for name in names)):
        raise UsageError("give the logs of the drive as well")
    tracks = [_track(name, logs, arguments.rate) for name in names]
    if len(tracks) == 1:
        tracks.append(of_autopilot(logs[0].rpartition("=")[2]))
    found = differences(tracks[0], tracks[1])
    if arguments.json:
        with delivering(arguments.json):
            arguments.json.write_bytes(msgspec.json.format(msgspec.json.encode(found), indent=2) + b"\n")
    print(text(found))


def _track(name: str, logs: list[str], rate_hz: float | None) -> Series:
    if Path(name).suffix == ".csv":
        return of_csv(Path(name))
    loaded = config.load(name)
    with config.located(name):
        return of_replay(name, loaded, logs, rate_hz)
