"""The command line: run, top, replay, check, mount, simulate, demo."""

from __future__ import annotations

import argparse
import gc
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

from fusiond import __version__
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.errors import UnusableError, UsageError
from fusiond_adapters.host import journal

SUCCESS, UNUSABLE, USAGE, INTERRUPTED = 0, 1, 2, 130  # exit codes

EXIT_CODES = "exit codes: 0 success, 1 unusable input or unwritable output, 2 wrong usage or configuration, 130 interrupted"
RUN = """\
Take the live inputs of a configuration and publish the state over Zenoh, until SIGTERM or SIGINT. An input that is away
is waited for. SIGHUP reloads the configuration: connections, message rates and [record] change while running; with
anything else changed the reload is refused as a whole, and the log says why."""
TOP = """\
Show the state of a running vehicle, what becomes of the measurements of each source, latencies, inputs, outputs and the
latest events, as published over Zenoh. Yellow: look at it; red: out of order. q ends it. Without a terminal: one screen."""
REPLAY = """\
Fuse the logs of one drive as if they arrived now, in their order of receipt: late measurements are put where they
belong in time. Prints a summary; the same inputs always give the same files, byte for byte."""
MOUNT = """\
Find how the IMU is turned against forward-right-down, from the logs of a drive, and print the rotation_deg to configure:
any rotation, upside down included. Run again with that configured, it tells what is left. The drive needs a minute or
more, mostly forward, with pulling away, braking, and bends both ways. The configuration is not changed."""
REPLAY_EXAMPLES = """\
examples:
  fusiond replay --config car.toml drive.tlog drive.log --csv track.csv
      fuse a MAVLink log and a candump log into a track
  fusiond replay --config car.toml drive.tlog drive.log --truth truth.csv --window 10-30 --plot errors.png
      compare seconds 10 to 30 with a reference, and draw the errors
  fusiond replay --config car.toml drive.tlog drive.log --truth truth.csv --withhold gps0:12-22 --window 12-22
      how far off is it after ten seconds without GNSS?
  fusiond replay --config car.toml drive.tlog drive.log --speed 1 --publish
      publish over Zenoh, in real time
"""


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The command line's grammar; where a command is given, of the others their names alone: to fill them in takes longer
    than the daemon can spare."""
    top = argparse.ArgumentParser(
        prog="fusiond",
        description="Fuse a vehicle's IMU, GNSS (MAVLink) and wheel speeds (CAN) into one state that knows its errors.",
        epilog=f"Try `fusiond demo` first. {EXIT_CODES}",
    )
    top.add_argument("--version", action="version", version=f"fusiond {__version__}")
    top.set_defaults(run=run_command)
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (about, fill) in GRAMMAR.items():
        one = commands.add_parser(
            name, help=about, description=f"{about.capitalize()}.", formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if command in (None, name):
            fill(one)
    return top


def _fill_run(run: argparse.ArgumentParser) -> None:
    run.description, run.epilog = RUN, f"example:\n  fusiond run --config car.toml\n\n{EXIT_CODES}"
    run.add_argument("--config", metavar="C.toml", required=True, help="configuration of the vehicle")
    run.set_defaults(run=run_daemon)


def _fill_top(watch: argparse.ArgumentParser) -> None:
    watch.description, watch.epilog = TOP, f"example:\n  fusiond top --connect tcp/192.168.1.5:7447\n\n{EXIT_CODES}"
    watch.add_argument("--vehicle", metavar="NAME", help="which one; default: the only one that is there")
    watch.add_argument(
        "--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447", help="fusiond or router; default: %(default)s"
    )
    watch.add_argument("--zenoh", metavar="FILE", help="Zenoh's own configuration file, for TLS and the like")
    watch.add_argument("--once", action="store_true", help="print one screen as text, and end")


def _fill_check(check: argparse.ArgumentParser) -> None:
    check.epilog = "example:\n  fusiond check --config car.toml"
    check.add_argument("--config", metavar="C.toml", required=True, help="configuration file")


def _fill_mount(mount: argparse.ArgumentParser) -> None:
    mount.description, mount.epilog = MOUNT, "example:\n  fusiond mount --config car.toml drive.tlog drive.log"
    mount.add_argument("logs", metavar="LOG", nargs="+", help="as for replay")
    mount.add_argument("--config", metavar="C.toml", required=True, help="configuration of the vehicle")


def _fill_simulate(simulate: argparse.ArgumentParser) -> None:
    simulate.epilog = "example:\n  fusiond simulate --config configs/simulate-demo.toml --out drive"
    simulate.add_argument("--config", metavar="S.toml", required=True, help="scenario file")
    simulate.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder to write to; made if need be")
    simulate.add_argument("--seed", metavar="N", type=_seed, help="in place of the scenario's seed")


def _fill_demo(show: argparse.ArgumentParser) -> None:
    show.epilog = "example:\n  fusiond demo --out out/demo"
    show.add_argument("--out", metavar="DIR", type=Path, default=Path("out/demo"), help="default: out/demo")
    show.add_argument("--speed", metavar="X", type=_positive, default=15.0, help="X times real time; default: 15")


def _fill_replay(command: argparse.ArgumentParser) -> None:
    command.description, command.epilog = REPLAY, f"{REPLAY_EXAMPLES}\n{EXIT_CODES}"
    add = command.add_argument
    add("logs", metavar="LOG", nargs="+", help=".tlog, .log (candump -L), .asc, .blf, .trc, ..., also .gz; or NAME=LOG")
    add("--config", metavar="C.toml", required=True, help="configuration of the vehicle (see `fusiond check`)")
    add("--csv", metavar="OUT.csv", type=Path, help="write the track: one row per publication")
    add("--json", metavar="SUMMARY.json", type=Path, help="write the summary")
    add("--truth", metavar="TRUTH.csv", type=Path, help="compare with a reference track (.csv or .csv.gz)")
    add("--window", metavar="START-STOP", help="compare these seconds only, counted from the first event")
    add("--stored", metavar="STATE.json", type=Path, help="begin with the stored state that the recorded run began with")
    add("--mcap", metavar="OUT.mcap", type=Path, help="write everything published, for Foxglove (extra `mcap`)")
    add("--plot", metavar="OUT.png", type=Path, help="draw the track and, with --truth, its errors (extra `plot`)")
    add(
        "--withhold",
        metavar="SOURCE:START-STOP",
        action="append",
        default=[],
        help="keep a source out between these seconds from the first event, such as gps0:12-22; may be repeated",
    )
    add("--rate", metavar="HZ", type=_rate, help="publications per second; default: publish.rate_hz of the config")
    add("--speed", metavar="X", type=_positive, help="replay at X times real time; default: as fast as possible")
    add("--publish", action="store_true", help="also publish every state over Zenoh, as configured")


def _positive(text: str) -> float:
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be above 0, not {text}")
    return value


def _rate(text: str) -> float:
    value = _number(text)
    if not 0.001 <= value <= 1000:
        raise argparse.ArgumentTypeError(f"must lie between 0.001 and 1000 Hz, not {text}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0")
    return int(text)


GRAMMAR: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "run": ("fuse the live inputs, and publish the state", _fill_run),
    "replay": ("fuse recorded logs into a track", _fill_replay),
    "top": ("show a running vehicle's state, sources, latencies and health in the terminal", _fill_top),
    "check": ("say what a configuration is going to do, or what is wrong with it", _fill_check),
    "mount": ("find how the IMU is turned in the vehicle, from logs", _fill_mount),
    "simulate": ("write the logs of a simulated drive, and the truth about it", _fill_simulate),
    "demo": ("play a bundled drive to a running fusiond, and explain what comes out", _fill_demo),
}


def run_daemon(arguments: argparse.Namespace) -> None:
    """fusiond run"""
    gc.disable()  # what is imported never becomes garbage: to look for it would take a tenth of the start
    asyncio = _asyncio()
    import numpy  # noqa: F401, PLC0415 - here, not from deep within: there Python maps and unmaps its stack at every call

    from fusiond.app.live.daemon import Daemon, serve  # noqa: PLC0415 - the other commands need none of its drivers

    gc.freeze()
    gc.enable()
    journal.set_up()

    def load() -> Config:
        return config.load(arguments.config)

    asyncio.run(serve(Daemon(load(), load)))


def _asyncio() -> ModuleType:
    """asyncio, which takes a third longer to import where it finds TLS, of which nothing here makes use."""
    without_tls = not {"asyncio", "ssl"} & sys.modules.keys()
    if without_tls:
        sys.modules["ssl"] = None  # type: ignore[assignment]
    import asyncio  # noqa: PLC0415

    if without_tls:
        del sys.modules["ssl"]  # for whoever else wants it
    return asyncio


def run_command(arguments: argparse.Namespace) -> None:
    """Any other command."""
    from fusiond.app.commands import COMMANDS  # noqa: PLC0415 - the daemon is up sooner without what only they need

    COMMANDS[arguments.command](arguments)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. A wrong command line ends with SystemExit(2), as argparse does."""
    words = sys.argv[1:] if argv is None else argv
    arguments = parser(words[0] if words else None).parse_args(words)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except UsageError as error:
        return _failed(str(error), USAGE)
    except UnusableError as error:
        return _failed(str(error), UNUSABLE)
    except BrokenPipeError:  # whoever read our output has gone; keep the interpreter from flushing into it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNUSABLE
    except OSError as error:
        return _failed(f"{error.filename or 'input or output'}: {error.strerror or error}", UNUSABLE)
    except KeyboardInterrupt:
        return _failed("interrupted", INTERRUPTED)
    return SUCCESS


def _failed(message: str, code: int) -> int:
    print(f"fusiond: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
