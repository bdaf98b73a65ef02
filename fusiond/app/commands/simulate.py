"""fusiond simulate: writes the logs of a simulated drive."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusiond.app.commands.argument_types import seed
from fusiond.app.commands.arguments import add_config, taken_config
from fusiond.simulation import scenario
from fusiond_adapters.logs.write import write_drive


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = "example:\n  fusiond simulate configs/simulate-demo.toml --out drive"
    add_config(parser, "scenario file", metavar="S.toml")
    parser.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder to write to; created if missing")
    parser.add_argument("--seed", metavar="N", type=seed, help="instead of the scenario's seed")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    for path in write_drive(scenario.load(taken_config(arguments)), arguments.out, arguments.seed):
        print(f"{path}  {path.stat().st_size / 1e3:.0f} kB")
