"""The demonstration: plays a bundled drive into a running daemon, and explains to a newcomer what came out.

The daemon takes it by its live inputs, MAVLink over UDP and a virtual CAN bus, on a clock that may run faster than time.
What it recorded is then replayed, which gives the states that it published, byte for byte, and the explanation.
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
from fusiond_adapters.can.bus import CanBus
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.logs.play import PlayedClock, Player

DRIVE = Path(__file__).parent / "data"  # made by `make demo-data` from configs/simulate-demo.toml
LOGS = ("drive.tlog.gz", "drive.log.gz")
LENGTH_NS = 150_000_000_000  # of the drive
CHANNEL = "fusiond-demo"  # of the virtual CAN bus
SETTLE_S = 0.5  # nothing more comes from a socket that has been quiet for so long
OPEN_S = 10.0  # for the inputs to open
LEAD_NS = 300_000_000  # from the beginning of the clock to that of the drive
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
        raise OutputError(f"{out}: cannot be made: {error.strerror}") from error
    drawing = importlib.util.find_spec("matplotlib") is not None
    print(_paragraph(INTRODUCTION.format(speed=f"{speed:g}")), flush=True)
    if publish:
        print("\n" + _paragraph(PUBLISHED), flush=True)
    with TemporaryDirectory(prefix="fusiond-demo-") as box:
        settings = _settings(box)
        played = _play(settings, speed, publish=publish)
        summary = replay(
            Options(
                config=settings,
                config_name="fusiond.toml",
                logs=[str(path) for path in sorted(Path(box).iterdir())],
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
    print(f"\nWritten to {out}: track.csv (the track), summary.json (every figure), ", end="")
    print("track.png (look at it)" if drawing else "no picture: pip install 'fusiond[plot]' for that")
    print("With your own drive: fusiond replay --help")


INTRODUCTION = """\
A car drives through a town for two and a half minutes: bends, a hill, a stop. Its autopilot sends an inertial sensor
and a GNSS receiver over MAVLink, its wheel speeds come over CAN. The drive was made by fusiond's simulator in the true
wire formats, so what really happened is known. It is now played to a running fusiond, over UDP and a virtual CAN bus,
up to {speed} times as fast as it happened."""
PUBLISHED = """\
Meanwhile it is published over Zenoh, as of the vehicle "demo": run `fusiond top` in another terminal of this machine.
With --speed 1 the drive lasts two and a half minutes."""


@dataclass
class Played:
    """What a daemon made of the drive."""

    rows: list[str]  # every state published, as a row of CSV
    sent: int  # frames that carry something for it
    missing: int  # of these, never received
    dropped: int  # received, but lost in a full queue
    speed: float  # times real time
    late_ms: float  # how far the player was behind at the most, in the time of the drive
    overtaken_ms: float  # how far a frame was overtaken on its way at the most, likewise


def _settings(box: str) -> Config:
    """The drive's configuration, with live inputs of this machine and a black box."""
    settings = config.load(DRIVE / "fusiond.toml")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        connection = f"udpin:127.0.0.1:{probe.getsockname()[1]}"
    change = msgspec.structs.replace
    return change(
        settings,
        mavlink={name: change(link, connection=connection) for name, link in settings.mavlink.items()},
        can={name: change(bus, interface="virtual", channel=CHANNEL) for name, bus in settings.can.items()},
        record=change(settings.record, folder=box),
    )


def _play(settings: Config, speed: float, *, publish: bool) -> Played:
    """Run a daemon while the drive is played to it. Raises OutputError where its inputs or outputs do not open."""
    states: list[StateMessage] = []
    port = int(next(iter(settings.mavlink.values())).connection.rpartition(":")[2])
    with (
        can.Bus(interface="virtual", channel=CHANNEL) as bus,
        Player(DRIVE / LOGS[0], DRIVE / LOGS[1], port, bus) as player,
    ):
        is_true = speed == 1
        clock = HostClock(player.begin_ns - LEAD_NS) if is_true else PlayedClock(player.begin_ns, speed)
        daemon = Daemon(settings, sinks=[states.append], zenoh=publish, clock=clock)
        asyncio.run(_run_while_played(daemon, player))
    received = sum(source.inbox.received for source in daemon.inputs.values())
    decoders = [source.decoder for source in daemon.inputs.values() if isinstance(source, CanBus)]
    wanted = {key for decoder in decoders if decoder for key in decoder.keys}
    sent = player.sent_mavlink + sum(count for number, count in player.sent_can.items() if number in wanted)
    return Played(
        rows=[csv_row(state) for state in states],
        sent=sent,
        missing=sent - received,
        dropped=sum(source.inbox.dropped for source in daemon.inputs.values()),
        speed=LENGTH_NS / 1e9 / player.seconds,
        late_ms=player.late_ns / 1e6,
        overtaken_ms=daemon.live.max_moved_ns / 1e6,
    )


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
                while received != (received := sum(source.inbox.received for source in daemon.inputs.values())):
                    await asyncio.sleep(SETTLE_S)
        finally:
            halt.set()
            daemon.stop()
    if obstacle:
        raise OutputError(obstacle)


async def _obstacle(daemon: Daemon) -> str:
    """Wait until inputs and outputs are open. What keeps them from it; empty where nothing does."""
    try:
        async with asyncio.timeout(OPEN_S):
            await daemon.up.wait()
            while not all(source.counts()["sessions"] for source in daemon.inputs.values()):
                await asyncio.sleep(POLL_S)
    except TimeoutError:
        return "the demonstration's own inputs do not open"
    return "; ".join(daemon.outputs.failures.values())


def _live(played: Played, track: list[str]) -> str:
    """What is to be told of the live run; `track` is the replay's."""
    same = sum(ours == theirs for ours, theirs in zip(played.rows, track, strict=False))
    return (
        f"The drive took {LENGTH_NS / 1e9 / played.speed:.0f} s: this machine managed {played.speed:.1f} times real time."
        f" {played.sent} frames were sent, {played.missing} of them lost on their way, {played.dropped} in full queues;"
        f" they were up to {played.late_ms:.0f} ms late, and held up by each other for up to {played.overtaken_ms:.0f} ms."
        f" {len(played.rows)} states were published. The recording, replayed, gives {same} of {len(track)} alike."
    )


def explanation(summary: Summary) -> Iterator[str]:
    """The result in paragraphs, for someone who has never seen one."""
    yield "WHAT WENT IN\n" + "\n".join(_inputs(summary))
    fixes = [source for name, source in summary.sources.items() if name.endswith(".position")]
    late = fixes[0].latency_ms if fixes else None
    if late:
        yield "HOW LATE IT CAME\n" + _paragraph(
            f"A GNSS fix tells of an instant {late.p50:.0f} ms (median) before it arrives, at most {late.max:.0f} ms."
            " Every one was put where it belongs in time: the filter went back to that instant and ran forward again,"
            f" over {summary.rerun} measurements in all. At 20 m/s a fix taken as new would be"
            f" {20 * late.p50 / 1e3:.1f} m off."
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
            " errors allow, as echoes from buildings make them do."
        )


def _inputs(summary: Summary) -> Iterator[str]:
    for name, source in summary.sources.items():
        others = source.events - source.fused
        rest = f", {others} not" if others else ""
        yield f"  {name:<16} {source.events:>6} measurements, {source.fused} fused{rest}"


def _quality(truth: TruthReport) -> str:
    position, heading = truth.position, truth.heading
    return (
        f"Over {truth.distance_m:.0f} m the track lies {position.rmse_m:.2f} m (root mean square) from the truth,"
        f" 95 % of it within {position.p95_m:.2f} m; the speed is right to {truth.velocity_rmse_mps:.3f} m/s,"
        f" the heading to {math.hypot(heading.rmse_deg, heading.offset_deg):.2f} deg. And it knows how good it is:"
        f" {100 * position.inside_95:.0f} % of the time the truth lies inside the 95 % ellipse that it publishes."
    )


def _outage(stretch: Stretch) -> str:
    text = (
        f"From second {stretch.start_s:.0f} to {stretch.stop_s:.0f} no usable GNSS position came in. Inertial sensor"
        f" and wheels carried the track on for {stretch.distance_m:.0f} m. At the end"
    )
    if stretch.error_m is not None:
        text += f" it was {stretch.error_m:.2f} m off, and"
    return text + f" it said of itself: {stretch.sigma_m:.2f} m, one sigma."


def _paragraph(text: str) -> str:
    return textwrap.fill(" ".join(text.split()), WIDTH, initial_indent="  ", subsequent_indent="  ")
