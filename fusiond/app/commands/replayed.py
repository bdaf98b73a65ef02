"""Arguments of the commands that replay logs: the reference, what is withheld, and the stored state."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from fusiond.app.replay.comparison import Window
from fusiond.app.replay.intervals import parse_interval, parse_withheld
from fusiond.config.schema import Config
from fusiond.errors import UsageError


def add_circumstances(parser: argparse.ArgumentParser) -> None:
    """Define them."""
    add = parser.add_argument
    add("--truth", metavar="TRUTH.csv", type=Path, help="compare with a reference track (.csv or .csv.gz)")
    add("--window", metavar="START-STOP", help="compare these seconds only, counted from the first event")
    add("--stored", metavar="STATE.json", type=Path, help="start with the stored state that the recorded run started with")
    add(
        "--withhold",
        metavar="SOURCE:START-STOP",
        action="append",
        default=[],
        help="withhold a source between these seconds from the first event, such as gps0:12-22; may be repeated",
    )


def circumstances(arguments: argparse.Namespace, config: Config) -> dict[str, Any]:
    """Them as options of a replay. Raises UsageError."""
    if arguments.window and not arguments.truth:
        raise UsageError("--window limits the comparison with a truth: give --truth as well")
    return {
        "truth": arguments.truth,
        "stored": arguments.stored,
        "withheld": tuple(parse_withheld(text, config) for text in arguments.withhold),
        "window": Window(*parse_interval(arguments.window)) if arguments.window else Window(),
    }
