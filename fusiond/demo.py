"""The demonstration: fuses a bundled drive, and explains to a newcomer what came out."""

from __future__ import annotations

import importlib.util
import math
import textwrap
from collections.abc import Iterator
from pathlib import Path

from fusiond import config
from fusiond.comparison import TruthReport
from fusiond.replay import Options, OutputError, replay
from fusiond.report import Stretch, Summary

DRIVE = Path(__file__).parent / "data" / "demo"  # made by `make demo-data` from configs/simulate-demo.toml
LOGS = ("drive.tlog.gz", "drive.log.gz")
LENGTH_NS = 150_000_000_000  # of the drive, for the progress bar: its logs are too small to tell by their bytes
WIDTH = 96  # characters of the explanation


def run(out: Path) -> None:
    """Fuse the bundled drive, write track.csv, summary.json and track.png to a folder, and explain them on stdout.

    Raises OutputError.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be made: {error.strerror}") from error
    drawing = importlib.util.find_spec("matplotlib") is not None
    print(_paragraph(INTRODUCTION), flush=True)
    summary = replay(
        Options(
            config=config.load(DRIVE / "fusiond.toml"),
            config_name="fusiond.toml",
            logs=[str(DRIVE / log) for log in LOGS],
            csv=out / "track.csv",
            json=out / "summary.json",
            truth=DRIVE / "truth.csv.gz",
            plot=out / "track.png" if drawing else None,
            share=lambda elapsed_ns: elapsed_ns / LENGTH_NS,
        )
    )
    for paragraph in explanation(summary):
        print(f"\n{paragraph}")
    print(f"\nWritten to {out}: track.csv (the track), summary.json (every figure), ", end="")
    print("track.png (look at it)" if drawing else "no picture: pip install 'fusiond[plot]' for that")
    print("With your own drive: fusiond replay --help")


INTRODUCTION = """\
A car drives through a town for two and a half minutes: bends, a hill, a stop. Its autopilot sends an inertial sensor
and a GNSS receiver over MAVLink, its wheel speeds come over CAN. The logs were made by fusiond's simulator in the true
wire formats, so what really happened is known. Fusing them now."""


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
