"""The demonstration: fuses a bundled drive, and explains to a newcomer what came out."""

from __future__ import annotations

import importlib.util
import math
import textwrap
from collections.abc import Iterator
from pathlib import Path

from fusiond import config
from fusiond.replay import Options, OutputError, replay
from fusiond.report import Summary

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
A car drives through a town for two and a half minutes: bends, a hill, a stop. Its autopilot sends an inertial sensor and a
GNSS receiver over MAVLink, its wheel speeds come over CAN. The logs were made by fusiond's simulator in the true wire
formats, so what really happened is known. Fusing them now."""


def explanation(summary: Summary) -> Iterator[str]:
    """The result in paragraphs, for someone who has never seen one."""
    sources = summary.sources
    yield "WHAT WENT IN\n" + "\n".join(_inputs(summary))
    late = [source.latency_ms for name, source in sources.items() if name.endswith(".position") and source.latency_ms]
    if late:
        yield "HOW LATE IT CAME\n" + _paragraph(
            f"A GNSS fix tells of an instant {late[0].p50:.0f} ms (median) before it arrives, at most {late[0].max:.0f} ms."
            f" Every one was put where it belongs in time: the filter went back to that instant and ran forward again,"
            f" {summary.rerun} events in all. At 20 m/s a fix taken as new would be"
            f" {20 * late[0].p50 / 1e3:.1f} m wrong."
        )
    truth = summary.truth
    if truth:
        yield "HOW GOOD THE RESULT IS\n" + _paragraph(
            f"Over {truth.distance_m:.0f} m the track lies {truth.position.rmse_m:.2f} m (root mean square) from the truth,"
            f" 95 % of it within {truth.position.p95_m:.2f} m; speed is right to {truth.velocity_rmse_mps:.3f} m/s, heading"
            f" to {math.hypot(truth.heading.rmse_deg, truth.heading.offset_deg):.2f} deg. And it knows how good it is:"
            f" {100 * truth.position.inside_95:.0f} % of the time the truth lies inside the 95 % ellipse it publishes."
        )
    for stretch in summary.dead_reckoning.stretches if summary.dead_reckoning else ():
        off = f"it was {stretch.error_m:.2f} m off, " if stretch.error_m is not None else ""
        share = (
            f"{100 * stretch.error_m / stretch.distance_m:.1f} % of the way, " if stretch.error_m is not None else ""
        )
        yield "WITHOUT GNSS\n" + _paragraph(
            f"From second {stretch.start_s:.0f} to {stretch.stop_s:.0f} there was no GNSS. Inertial sensor and wheels carried"
            f" the track on for {stretch.distance_m:.0f} m; at the end {off}{share}"
            f"and said of itself: {stretch.sigma_m:.2f} m, one sigma."
        )
    rejected = sum(source.rejected for name, source in sources.items() if name.endswith(".position"))
    if rejected:
        yield "WITH BAD GNSS\n" + _paragraph(
            f"{rejected} fixes were rejected: they contradicted everything else by far more than their errors allow,"
            " as echoes from buildings make them do."
        )


def _inputs(summary: Summary) -> Iterator[str]:
    for name, source in summary.sources.items():
        kept_out = source.events - source.fused
        yield f"  {name:<16} {source.events:>6} measurements, {source.fused} fused" + (
            f", {kept_out} not" * bool(kept_out)
        )


def _paragraph(text: str) -> str:
    return textwrap.fill(" ".join(text.split()), WIDTH, initial_indent="  ", subsequent_indent="  ")
