"""What the commands do, but for `run`: top, replay, check, mount, simulate, demo. Each takes the parsed command line."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from fusiond.app import mounting
from fusiond.app.demo import demo
from fusiond.app.progress import shown
from fusiond.app.replay import summary as report
from fusiond.app.replay.comparison import Window
from fusiond.app.replay.replay import Options, OutputError, parse_interval, parse_withheld, replay
from fusiond.config import load as config
from fusiond.config.explain import description, oddities
from fusiond.errors import UsageError
from fusiond.simulation import scenario
from fusiond.timeline.clock import Clock
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.host import journal
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive
from fusiond_adapters.mavlink.decoder import MavlinkDecoder


def run_top(arguments: argparse.Namespace) -> None:
    """fusiond top"""
    from fusiond.app.client import ClientError  # noqa: PLC0415 - Zenoh is slow to import
    from fusiond.app.top.terminal import run  # noqa: PLC0415

    try:
        run(arguments.connect, arguments.vehicle, arguments.zenoh, just_once=arguments.once)
    except ClientError as error:
        raise OutputError(str(error)) from error


def run_replay(arguments: argparse.Namespace) -> None:
    """fusiond replay"""
    loaded = config.load(arguments.config)
    if arguments.window and not arguments.truth:
        raise UsageError("--window limits the comparison with a truth: give --truth as well")
    options = Options(
        config=loaded,
        config_name=Path(arguments.config).name,
        logs=arguments.logs,
        csv=arguments.csv,
        json=arguments.json,
        truth=arguments.truth,
        plot=arguments.plot,
        mcap=arguments.mcap,
        stored=arguments.stored,
        withheld=tuple(parse_withheld(text, loaded) for text in arguments.withhold),
        window=Window(*parse_interval(arguments.window)) if arguments.window else Window(),
        rate_hz=arguments.rate,
        speed=arguments.speed,
        publish=arguments.publish,
    )
    print(report.text(replay(options)))


def run_check(arguments: argparse.Namespace) -> None:
    """fusiond check"""
    loaded = config.load(arguments.config)
    for link in loaded.mavlink:
        MavlinkDecoder(loaded, link)
    decoders = [CanDecoder(loaded, bus) for bus in loaded.can]
    for line in description(loaded):
        print(line)
    odd = [*oddities(loaded), *(warning for decoder in decoders for warning in decoder.warnings)]
    for line in odd:
        print(f"warning: {line}")
    print(f"{arguments.config}: can be used" + (f", with {len(odd)} warning(s)" if odd else ""))


def run_mount(arguments: argparse.Namespace) -> None:
    """fusiond mount"""
    loaded = config.load(arguments.config)
    ((source, imu),) = loaded.imu.items()
    logs, clock, gathering = open_logs(arguments.logs, loaded), Clock(loaded), mounting.Gathering(loaded)
    progress = shown(logs, lambda: logs.bytes_read / logs.bytes_total, lambda: gathering.elapsed_ns, sys.stderr)
    for received in progress:
        measurement = clock.align(received)
        if measurement is not None:
            gathering.add(measurement)
    print(mounting.text(mounting.find(gathering.windows(), imu.rotation_deg), source))


def run_simulate(arguments: argparse.Namespace) -> None:
    """fusiond simulate"""
    for path in write_drive(scenario.load(arguments.config), arguments.out, arguments.seed):
        print(f"{path}  {path.stat().st_size / 1e3:.0f} kB")


def run_demo(arguments: argparse.Namespace) -> None:
    """fusiond demo"""
    journal.set_up(logging.ERROR)  # what the daemon would log on the way is explained at the end
    demo.run(arguments.out, arguments.speed)


COMMANDS = {
    "top": run_top,
    "replay": run_replay,
    "check": run_check,
    "mount": run_mount,
    "simulate": run_simulate,
    "demo": run_demo,
}
