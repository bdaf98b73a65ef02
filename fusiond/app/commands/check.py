"""fusiond check: explains a configuration and its warnings."""

from __future__ import annotations

import argparse
import sys

from fusiond.app.colours import painted
from fusiond.app.commands.arguments import add_config, add_verbosity, taken_config
from fusiond.app.kernel import slow_kernel
from fusiond.config import load as config
from fusiond.config.explain import description, oddities, values
from fusiond.config.schema import Config
from fusiond.config.toml import all_made
from fusiond.ports.inputs import InputContext
from fusiond.ports.outputs import OutputContext
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.registry import make_inputs, make_outputs


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = "example:\n  fusiond check car.toml"
    add_config(parser, "configuration file")
    add_verbosity(parser, quiet="print warnings only", verbose="print every key with its value too, given or default")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    name = taken_config(arguments)
    loaded = config.load(name)
    with config.located(name):
        _make(loaded)
        odd = warnings(loaded)
    if not arguments.quiet:
        for line in description(loaded):
            print(line)
    if arguments.verbose:
        for key, value in values(loaded):
            print(f"{key} = {value!r}")
    slow = slow_kernel()
    odd += [slow] if slow else []
    for line in odd:
        print(painted(f"warning: {line}", "yellow", sys.stdout))
    if not arguments.quiet:
        print(f"{name}: can be used" + (f", with {len(odd)} warning(s)" if odd else ""))


def warnings(loaded: Config) -> list[str]:
    """What is odd about a configuration and its DBC files. Raises ConfigError where they do not fit."""
    decoders = [CanDecoder(loaded, bus) for bus in loaded.can]
    return [*oddities(loaded), *(warning for decoder in decoders for warning in decoder.warnings)]


def _make(loaded: Config) -> None:
    """Make and prepare all that `run` would, and open nothing. Raises ConfigError."""
    clock = HostClock()
    inputs = make_inputs(loaded, InputContext(clock, lambda: None, lambda: True))
    all_made(one.prepare for one in inputs.values())
    make_outputs(loaded, OutputContext(clock, inputs))
