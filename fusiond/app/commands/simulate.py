"""fusiond simulate: the logs of a drive that never was."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusiond.app.commands.argument_types import seed
from fusiond.simulation import scenario
from fusiond_adapters.logs.write import write_drive


def fill(parser: argparse.ArgumentParser) -> None:
    """The grammar."""
    parser.epilog = "example:\n  fusiond simulate --config configs/simulate-demo.toml --out drive"
    parser.add_argument("--config", metavar="S.toml", required=True, help="scenario file")
    parser.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder to write to; made if need be")
    parser.add_argument("--seed", metavar="N", type=seed, help="in place of the scenario's seed")


def run(arguments: argparse.Namespace) -> None:
    """The action."""
    for path in write_drive(scenario.load(arguments.config), arguments.out, arguments.seed):
        print(f"{path}  {path.stat().st_size / 1e3:.0f} kB")
