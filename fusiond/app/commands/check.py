"""fusiond check: explains a configuration and its warnings."""

from __future__ import annotations

import argparse

from fusiond.app.kernel import slow_kernel
from fusiond.config import load as config
from fusiond.config.explain import description, oddities
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.mavlink.decoder import MavlinkDecoder


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = "example:\n  fusiond check --config car.toml"
    parser.add_argument("--config", metavar="C.toml", required=True, help="configuration file")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    loaded = config.load(arguments.config)
    for link in loaded.mavlink:
        MavlinkDecoder(loaded, link)
    decoders = [CanDecoder(loaded, bus) for bus in loaded.can]
    for line in description(loaded):
        print(line)
    slow = slow_kernel()
    odd = [*oddities(loaded), *([slow] if slow else []), *(warning for decoder in decoders for warning in decoder.warnings)]
    for line in odd:
        print(f"warning: {line}")
    print(f"{arguments.config}: can be used" + (f", with {len(odd)} warning(s)" if odd else ""))
