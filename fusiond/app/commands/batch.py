"""fusiond batch: replays many drives, and tells whether a configuration is better on them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fusiond.app.batch.engines import Cluster, Engine, LocalPool, cores
from fusiond.app.batch.findings import WORST
from fusiond.app.batch.job import OWN, Limits, Options
from fusiond.app.batch.summary import compared, text
from fusiond.app.batch.tune import lines
from fusiond.app.commands import EXIT_CODES
from fusiond.app.commands.argument_types import count, positive, rate, seed
from fusiond.app.replay.files import check_outputs, delivering
from fusiond.app.replay.outages import parse_length
from fusiond.errors import UsageError

if TYPE_CHECKING:
    from fusiond.app.batch.batch import Order

WORSE = 3  # exit code

ABOUT = """\
Replay many drives, each in a process with limits of its own, and write one row for each, whatever happens to it, as
Parquet. With a baseline, tell whether the new configuration is significantly better or worse over all drives, and which
drives are worst. Rows that are there already are not made again: a batch that was killed goes on where it was."""
EXAMPLES = """\
examples:
  fusiond batch drives/ --config car.toml -o out
      every folder of logs below drives/, compared with the truth.csv beside them
  fusiond batch drives/ --config new.toml --baseline old.toml -o out
      is new.toml better? exit code 3 if it is significantly worse
  fusiond batch 's3://fleet/2026-03-*/' -o out --outage 1000m
      recordings of black boxes as they lie, each with the configuration that it was recorded with
  fusiond batch drives/ --config car.toml -o new --baseline old/rows.parquet
      compare with the rows of another version of fusiond
  fusiond batch manifest.csv --config car.toml -o out --scheduler tcp://10.0.0.5:8786
      drives listed in a table, on a Dask cluster
"""


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description = ABOUT
    parser.epilog = f"{EXAMPLES}\n{EXIT_CODES}, {WORSE} NEW is significantly worse than OLD"
    add = parser.add_argument
    add("drives", metavar="DRIVES", nargs="+", help="folders, patterns, logs, manifests (.csv, .parquet), or URLs of them")
    add("--config", metavar="NEW.toml", default=OWN, help="default: the one that lies beside each drive's logs")
    add("--baseline", metavar="OLD", help=f"a configuration, '{OWN}', or rows.parquet of another batch, to compare with")
    add("-o", "--out", metavar="DIR", type=Path, required=True, help="folder to write to; created if missing")
    add("--outage", metavar="LENGTH", default="", help="replay again with GNSS withheld again and again, for 60s or 1000m")
    add("--rate", metavar="HZ", type=rate, default=10.0, help="states a second that are compared; default: %(default)g")
    add("--smooth", action="store_true", help="where there is no truth, compare with the smoother, of OLD if it is given")
    about_reports = "reports of the worst drives (extra `report`); default: %(default)s"
    add("--reports", metavar="N", type=seed, default=WORST, help=about_reports)
    add("--tracks", action="store_true", help="write the tracks too, as Parquet")
    add("--workers", metavar="N", type=count, default=cores(), help="processes; default: the processors, here %(default)s")
    add("--engine", choices=("local", "dask"), default="local", help="dask: a Dask cluster on this machine (extra `dask`)")
    add("--scheduler", metavar="URL", help="the scheduler of a Dask cluster, such as tcp://HOST:8786 (extra `dask`)")
    add("--seconds", metavar="S", type=positive, default=600.0, help="processor time of one drive; default: %(default)g")
    add("--memory", metavar="MB", type=positive, default=2000.0, help="memory of one drive; default: %(default)g")
    add("--tune", metavar="TUNED.toml", type=Path, help="tune NEW by all drives, each judged by what others told")
    add("--dry-run", action="store_true", help="tell what would be done")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from fusiond.app.batch import batch  # noqa: PLC0415 - needs the extra `batch`

    if arguments.outage:
        parse_length(arguments.outage)
    options = Options(rate_hz=arguments.rate, outage=arguments.outage, smooth=arguments.smooth, tracks=arguments.tracks)
    limits = Limits(seconds=arguments.seconds, memory_mb=arguments.memory)
    order = batch.Order(
        arguments.drives, arguments.out, arguments.config, arguments.baseline, options, limits, reports=arguments.reports
    )
    batch.check(order)
    if arguments.dry_run:
        print(batch.dry(order))
        return 0
    if arguments.tune:
        return _tune(order, arguments)
    with _engine(arguments) as engine:
        result = batch.run(order, engine)
    print(text(result.findings))
    cost = result.cost
    print(
        f"\n{result.made} of {cost.rows} rows were made now; all cost {cost.cpu_s:.0f} s of processor time,"
        f" the largest {cost.peak_mb:.0f} MB\n{order.folder / batch.ROWS}\n{order.folder / batch.SUMMARY}"
    )
    return WORSE if result.findings.comparison is not None and result.findings.comparison.is_worse else 0


def _tune(order: Order, arguments: argparse.Namespace) -> int:
    """Tune one configuration by all drives."""
    from fusiond.app.batch import batch  # noqa: PLC0415 - needs the extra `batch`

    if order.config == OWN or order.baseline is not None:
        raise UsageError("--tune needs one configuration by --config, and no baseline: it is compared with itself")
    check_outputs([arguments.tune], [Path(order.config)])
    with _engine(arguments) as engine:
        tuned = batch.tune(order, engine)
    print(f"{tuned.asked} of {tuned.drives} drives tell something\n")
    print("\n".join(lines(tuned.findings, tuned.dropped)))
    for group, judged in tuned.dropped.items():
        print(f"\n{group}: not taken, because drives that did not tell it get worse\n{compared(judged)}")
    print(f"\nwhat is taken, on drives that did not tell it\n{compared(tuned.judged)}")
    with delivering(arguments.tune):
        arguments.tune.write_text(tuned.text, encoding="utf-8")
    print(f"\n{arguments.tune}\n{order.folder / batch.VEHICLES}: what is each vehicle's own")
    return 0


def _engine(arguments: argparse.Namespace) -> Engine:
    if arguments.scheduler or arguments.engine == "dask":
        return Cluster(arguments.scheduler, arguments.workers)
    return LocalPool(arguments.workers)
