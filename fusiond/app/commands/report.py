"""fusiond report: fuses recorded logs, and writes a report to read in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.argument_types import rate
from fusiond.app.commands.arguments import add_config_and_logs, taken_config
from fusiond.app.commands.replayed import add_circumstances, circumstances
from fusiond.app.diagnosis.finding import exit_code, lines
from fusiond.app.replay.job import Options, replay
from fusiond.config import load as config

ABOUT = """\
Fuse the logs of one drive, and write a report: the track on a map, errors or sigmas, innovations with their gates, health,
latencies, clocks, calibration and events, in plots that share one axis of time. It is one HTML file, which needs no network
and loads nothing. Needs the extra `report`."""
EXAMPLES = """\
examples:
  fusiond report car.toml drive.tlog drive.log -o drive.html
      a report of a drive
  fusiond report car.toml drive.tlog drive.log --truth truth.csv --withhold gps0:60-90 -o tunnel.html
      with its errors against a reference, and 30 s without GNSS
  fusiond report car.toml drive.tlog -o drive.html --tiles 'https://tile.openstreetmap.org/{z}/{x}/{y}.png'
      over a street map, which the browser then loads from that server
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, f"{EXAMPLES}\n{EXIT_CODES}"
    add = parser.add_argument
    add_config_and_logs(parser)
    add("-o", "--out", metavar="DRIVE.html", required=True, type=Path, help="the file to write")
    add_circumstances(parser)
    add("--rate", metavar="HZ", type=rate, help="states per second; default: publish.rate_hz of the config")
    add("--tiles", metavar="URL", type=tiles, help="map tiles from a server; its address has {z}, {x} and {y}")


def tiles(text: str) -> str:
    """The address of a tile server."""
    if not text.startswith(("https://", "http://")) or not all(place in text for place in ("{x}", "{y}", "{z}")):
        raise argparse.ArgumentTypeError(f"'{text}' is not an address with {{z}}, {{x}} and {{y}}")
    return text


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    name = taken_config(arguments)
    loaded = config.load(name)
    options = Options(
        config=loaded,
        config_name=Path(name).name,
        logs=arguments.logs,
        report=arguments.out,
        tiles=arguments.tiles,
        rate_hz=arguments.rate,
        **circumstances(arguments, loaded),
    )
    with config.located(name):
        summary = replay(options)
    print(f"{arguments.out}  {arguments.out.stat().st_size / 1e6:.1f} MB")
    for line in lines(summary.findings):
        print(line)
    return exit_code(summary.findings)
