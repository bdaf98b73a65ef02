"""The demonstration: plays a bundled drive into a running daemon, and explains the result to a newcomer.

The daemon receives it on its live inputs, MAVLink over UDP and a virtual CAN bus, with a clock that may run faster than
real time. Its recording is then replayed, which gives the published states, byte for byte, and the explanation.
"""

from __future__ import annotations

import asyncio
import importlib.util
import math
import socket
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import can
import msgspec

from fusiond.app.live.daemon import Daemon
from fusiond.app.progress import shown
from fusiond.app.replay.comparison import TruthReport
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.summary import Stretch, Summary
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.errors import OutputError
from fusiond.messages import StateMessage, csv_row
from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.can.bus import CanBus
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.logs.play import PlayedClock, Player

DRIVE = Path(__file__).parent / "data"  # made by `make demo-data` from configs/simulate-demo.toml
LOGS = ("drive.tlog.gz", "drive.log.gz")
LENGTH_NS = 150 * SECOND  # of the drive
CHANNEL = "fusiond-demo"  # of the virtual CAN bus
SETTLE_S = 0.5  # a socket that received nothing for this long has nothing more to receive
OPEN_S = 10.0  # for the inputs to open
LEAD_NS = 300 * MILLISECOND  # from the start of the clock to the start of the drive
POLL_S = 0.01
WIDTH = 96  # characters of the explanation


def run(out: Path, speed: float, *, publish: bool = False) -> None:
    """Play the bundled drive at `speed` times real time into a daemon, write track.csv, summary.json and track.png to a
    folder, and explain them on stdout. With `publish` the daemon publishes over Zenoh.

    Raises OutputError.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be created: {error.strerror}") from error
    drawing = importlib.util.find_spec("matplotlib") is not None
    print(_paragraph(INTRODUCTION.format(speed=f"{speed:g}")), flush=True)
    if publish:
        print("\n" + _paragraph(PUBLISHED), flush=True)
    with TemporaryDirectory(prefix="fusiond-demo-") as folder:
        settings = _settings(folder)
        played = _play(settings, speed, publish=publish)
        summary = replay(
            Options(
                config=settings,
                config_name="fusiond.toml",
                logs=[str(path) for path in sorted(Path(folder).glob("*log"))],
                csv=out / "track.csv",
                json=out / "summary.json",
                truth=DRIVE / "truth.csv.gz",
                plot=out / "track.png" if drawing else None,
            )
        )
    track = (out / "track.csv").read_text(encoding="ascii").splitlines()[1:]
    print("\nLIVE\n" + _paragraph(_live(played, track)))
    for paragraph in explanation(summary):
        print(f"\n{paragraph}")
    print(f"\nWritten to {out}: track.csv (the track), summary.json (all figures), ", end="")
    print("track.png (look at it)" if drawing else "no picture: pip install 'fusiond[plot]' for that")
    print("With your own drive: fusiond replay --help")


INTRODUCTION = """\
A car drives through a town for two and a half minutes: bends, a hill, a stop. Its autopilot sends an inertial sensor
and a GNSS receiver over MAVLink; its wheel speeds come over CAN. The drive was made by fusiond's simulator in the real
wire formats, so the truth is known. It is now played to a running fusiond, over UDP and a virtual CAN bus,
up to {speed} times as fast as real time."""
PUBLISHED = """\
Meanwhile it is published over Zenoh as the vehicle "demo": run `fusiond top` in another terminal of this machine.
With --speed 1 the drive lasts two and a half minutes."""


@dataclass
class Played:
    """The live run of the drive."""

    rows: list[str]  # every state published, as a row of CSV
    sent: int  # frames with data for the daemon
    missing: int  # of these, not received
    dropped: int  # received, but lost in a full queue
    speed: float  # times real time
    late_ms: float  # largest delay of the player, in the time of the drive
    overtaken_ms: float  # largest time by which a frame was overtaken by others, in the time of the drive


def _settings(folder: str) -> Config:
    """The drive's configuration, with live inputs of this machine and a black box in a folder."""
    settings = config.load(DRIVE / "fusiond.toml")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        connection = f"udpin:127.0.0.1:{probe.getsockname()[1]}"
    change = msgspec.structs.replace
    return change(
        settings,
        mavlink={name: change(link, connection=connection) for name, link in settings.mavlink.items()},
        can={name: change(bus, interface="virtual", channel=CHANNEL) for name, bus in settings.can.items()},
        record=change(settings.record, folder=folder),
    )


def _play(settings: Config, speed: float, *, publish: bool) -> Played:
    """Run a daemon while the drive is played to it. Raises OutputError if its inputs or outputs do not open."""
    states: list[StateMessage] = []
    port = int(next(iter(settings.mavlink.values())).connection.rpartition(":")[2])
    with (
        can.Bus(interface="virtual", channel=CHANNEL) as bus,
        Player(DRIVE / LOGS[0], DRIVE / LOGS[1], port, bus) as player,
    ):
        real_time = speed == 1
        clock = HostClock(player.begin_ns - LEAD_NS) if real_time else PlayedClock(player.begin_ns, speed)
        daemon = Daemon(settings, sinks=[states.append], zenoh=publish, clock=clock)
        asyncio.run(_run_while_played(daemon, player))
    received = _received(daemon)
    decoders = [one.decoder for one in daemon.inputs.values() if isinstance(one, CanBus)]
    wanted = {key for decoder in decoders if decoder for key in decoder.keys}
    sent = player.sent_mavlink + sum(count for number, count in player.sent_can.items() if number in wanted)
    return Played(
        rows=[csv_row(state) for state in states],
        sent=sent,
        missing=sent - received,
        dropped=sum(one.inbox.dropped for one in daemon.inputs.values()),
        speed=LENGTH_NS / SECOND / player.seconds,
        late_ms=player.late_ns / MILLISECOND,
        overtaken_ms=daemon.live.max_moved_ns / MILLISECOND,
    )


def _received(daemon: Daemon) -> int:
    return sum(one.inbox.received for one in daemon.inputs.values())


async def _run_while_played(daemon: Daemon, player: Player) -> None:
    """Raises OutputError."""
    halt, obstacle = Event(), ""

    def play() -> None:
        played = player.play(daemon.clock, lambda: daemon.live.engine.now_ns, halt)
        for _ in shown(played, lambda: player.since_ns / LENGTH_NS, lambda: player.since_ns, sys.stderr):
            pass

    async with asyncio.TaskGroup() as group:
        group.create_task(daemon.run())
        try:
            obstacle = await _obstacle(daemon)
            if not obstacle:
                await asyncio.to_thread(play)
                received = -1
                while received != (received := _received(daemon)):
                    await asyncio.sleep(SETTLE_S)
        finally:
            halt.set()
            daemon.stop()
    if obstacle:
        raise OutputError(obstacle)


async def _obstacle(daemon: Daemon) -> str:
    """Wait until inputs and outputs are open. Returns why they cannot be opened; empty if they can."""
    try:
        async with asyncio.timeout(OPEN_S):
            await daemon.up.wait()
            while not all(one.counts()["sessions"] for one in daemon.inputs.values()):
                await asyncio.sleep(POLL_S)
    except TimeoutError:
        return "the demonstration's own inputs do not open"
    return "; ".join(daemon.outputs.failures.values())


def _live(played: Played, track: list[str]) -> str:
    """The live run in a paragraph; `track` is the replay's."""
    same = sum(ours == theirs for ours, theirs in zip(played.rows, track, strict=False))
    return (
        f"The drive took {LENGTH_NS / SECOND / played.speed:.0f} s: this machine reached {played.speed:.1f} times real time."
        f" {played.sent} frames were sent, {played.missing} not received, {played.dropped} dropped from full queues;"
        f" they were up to {played.late_ms:.0f} ms late, and overtook each other by up to {played.overtaken_ms:.0f} ms."
        f" {len(played.rows)} states were published."
        f" A replay of the recording gives {same} of {len(track)} identical states."
    )


def explanation(summary: Summary) -> Iterator[str]:
    """The result in paragraphs, for a newcomer."""
    yield "WHAT WENT IN\n" + "\n".join(_inputs(summary))
    fixes = [source for name, source in summary.sources.items() if name.endswith(".position")]
    late = fixes[0].latency_ms if fixes else None
    if late:
        yield "HOW LATE IT CAME\n" + _paragraph(
            f"A GNSS fix is measured {late.p50:.0f} ms (median) before it arrives, at most {late.max:.0f} ms."
            " Each was fused at the instant of its measurement: the filter went back to that instant and ran forward again,"
            f" over {summary.rerun} measurements in all. At 20 m/s a fix fused on arrival would be wrong by"
            f" {20 * late.p50 / 1e3:.1f} m."
        )
    if summary.truth:
        yield "HOW GOOD THE RESULT IS\n" + _paragraph(_quality(summary.truth))
    if summary.dead_reckoning and summary.dead_reckoning.stretches:
        outages = (_paragraph(_outage(stretch)) for stretch in summary.dead_reckoning.stretches)
        yield "WITHOUT GNSS\n" + "\n".join(outages)
    rejected = sum(source.rejected for source in fixes)
    if rejected:
        yield "WITH BAD GNSS\n" + _paragraph(
            f"{rejected} GNSS positions were rejected: they contradicted everything else by far more than their stated"
            " errors allow, as reflections from buildings cause."
        )


def _inputs(summary: Summary) -> Iterator[str]:
    for name, source in summary.sources.items():
        others = source.events - source.fused - source.gathered
        start = f", {source.gathered} taken to find the start" if source.gathered else ""
        rest = f", {others} not used" if others else ""
        yield f"  {name:<16} {source.events:>6} measurements, {source.fused} fused{start}{rest}"


def _quality(truth: TruthReport) -> str:
    position, heading = truth.position, truth.heading
    return (
        f"Over {truth.distance_m:.0f} m the error of the track is {position.rmse_m:.2f} m (root mean square),"
        f" for 95 % of it below {position.p95_m:.2f} m; the error of the speed is {truth.velocity_rmse_mps:.3f} m/s,"
        f" of the heading {math.hypot(heading.rmse_deg, heading.offset_deg):.2f} deg. The published uncertainty is honest:"
        f" {100 * position.inside_95:.0f} % of the time the truth is inside the published 95 % ellipse."
    )


def _outage(stretch: Stretch) -> str:
    text = (
        f"From second {stretch.start_s:.0f} to {stretch.stop_s:.0f} no usable GNSS position was received. Inertial sensor"
        f" and wheels continued the track for {stretch.distance_m:.0f} m. At the end"
    )
    if stretch.error_m is not None:
        text += f" its error was {stretch.error_m:.2f} m, and"
    return text + f" its published sigma {stretch.sigma_m:.2f} m."


def _paragraph(text: str) -> str:
    return textwrap.fill(" ".join(text.split()), WIDTH, initial_indent="  ", subsequent_indent="  ")
