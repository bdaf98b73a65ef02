"""Draw the pictures of the documentation into docs/images/: python docs/make_pictures.py [NAME ...] (needs the extra `plot`)

The picture of the captured drive needs that drive in ../shared/data, beside the project; without it, it is skipped.
"""

import csv
import math
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import get_data_path
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the browser, which the tests drive too

from fusiond.app.demo import demo
from fusiond.app.replay.comparison import Window
from fusiond.app.replay.files import truth_of
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.app.replay.summary import Summary
from fusiond.app.replay.truth import Truth, displacement, parse_truth
from fusiond.app.top.view import Place, View, page
from fusiond.config import load as config
from fusiond.estimator.fusion import solution_state
from fusiond.filter.source_health import STATUSES
from fusiond.filter.state import CHOOSING, LAST_SPEED, PHASE
from fusiond.messages.drift import Drift
from fusiond.messages.local_frame import LocalFrame, OdometryFrame
from fusiond.messages.types import EventMessage, HealthMessage, Message, StateMessage
from fusiond.simulation.scenario import parse
from fusiond.units import SECOND, nanoseconds
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive
from tests.helpers.browser import browser, opened

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
CAR = ROOT / "configs" / "rav4.toml"
DRIVE = ROOT.parent / "shared" / "data" / "comma2k19-rav4"
SECONDS = Window(10, 30)
COLOURS = 96  # of a picture's palette: keeps it small
BLUE, VERMILION, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#E69F00", "#009E73", "#808080"


def figure_of(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def shrink(path: Path, colours: int = COLOURS, method: Image.Quantize = Image.Quantize.MAXCOVERAGE) -> None:
    """Write a PNG again with a palette."""
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(colours, method, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
    print(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1e3:.0f} kB")


# --- The bundled drive


def draw_demo() -> None:
    """The track of the bundled drive, and its errors."""
    path = IMAGES / "demo.png"
    settings = config.load(demo.DRIVE / "fusiond.toml")
    logs = [str(demo.DRIVE / log) for log in demo.LOGS]
    replay(Options(config=settings, config_name="", logs=logs, truth=demo.DRIVE / "truth.csv.gz", plot=path))
    shrink(path)


# --- A captured drive, each fix at its own time or at its arrival


class Errors(NamedTuple):
    """Errors of a replay against the reference, one value per publication."""

    second: list[float]
    along_m: list[float]  # in the direction of travel
    across_m: list[float]  # to the right of it


def draw_arrival() -> None:
    """What it costs to fuse each fix at its arrival."""
    if not DRIVE.is_dir():
        print("arrival.png skipped: the captured drive is not beside the project", file=sys.stderr)
        return
    text = CAR.read_text(encoding="utf-8")
    learnt = re.compile(r"^(velocity_)?delay_sigma_ms = .*\n", re.MULTILINE)
    arrival = learnt.sub("", text).replace("[gnss.gps0]", '[gnss.gps0]\nstamp = "arrival"')
    runs = (("each fix at its own time", BLUE, text), ("each fix at its arrival", VERMILION, arrival))
    figure = figure_of(9, 5)
    axes = figure.subplots(2, 1, sharex=True)
    for label, colour, settings in runs:
        summary, errors = fused(settings)
        assert summary.truth is not None
        result = f"{label}: {summary.truth.position.rmse_m:.2f} m RMSE"
        print(f"{result}, {summary.truth.velocity_rmse_mps:.3f} m/s, {100 * summary.truth.position.inside_95:.0f} % inside")
        axes[0].plot(errors.second, errors.along_m, color=colour, linewidth=1.2, label=result)
        axes[1].plot(errors.second, errors.across_m, color=colour, linewidth=1.2)
    for ax, name in zip(axes, ("along the track [m]", "across the track [m]"), strict=True):
        ax.axhline(0.0, color=GREY, linewidth=0.6)
        ax.set(ylabel=name, ylim=(-2.6, 1.2))
        ax.grid(alpha=0.25)
    axes[0].legend(loc="upper right", ncols=2, frameon=False)
    axes[0].set_title("Published position less reference, RAV4, seconds 10 to 30", loc="left", fontsize=10)
    axes[1].set_xlabel("time from the first event [s]")
    path = IMAGES / "arrival.png"
    figure.savefig(path)
    shrink(path)


def fused(settings: str) -> tuple[Summary, Errors]:
    """Replay the captured drive with the text of a configuration."""
    with tempfile.TemporaryDirectory() as folder:
        track = Path(folder) / "track.csv"
        summary = replay(
            Options(
                config=config.parse(settings, CAR),
                config_name=CAR.name,
                logs=[str(DRIVE / "drive.tlog"), str(DRIVE / "drive.candump.log")],
                csv=track,
                truth=DRIVE / "truth.csv",
                window=SECONDS,
            )
        )
        return summary, errors_of(track, summary.span.first_ns)


def errors_of(track: Path, first_ns: int) -> Errors:
    errors = Errors([], [], [])
    with (DRIVE / "truth.csv").open() as reference, track.open() as file:
        truth = Truth(parse_truth(reference, "truth.csv"))
        for row in csv.DictReader(file):
            t_ns = int(row["unix_us"]) * 1000
            true, second = truth.at(t_ns), (t_ns - first_ns) / SECOND
            if true is None or not row["lat_deg"] or not SECONDS.start_s <= second <= SECONDS.stop_s:
                continue
            origin = true.lat_deg, true.lon_deg
            north, east = displacement(float(row["lat_deg"]), float(row["lon_deg"]), origin, true.height_m)
            speed = math.hypot(true.vn_mps, true.ve_mps)
            errors.second.append(second)
            errors.along_m.append((north * true.vn_mps + east * true.ve_mps) / speed)
            errors.across_m.append((east * true.vn_mps - north * true.ve_mps) / speed)
    return errors


# --- What a late fix does

STEP_MS = 10  # between two inertial samples
FIX_MS, ARRIVAL_MS, END_MS = 34, 112, 120
SNAPSHOTS_MS = (0, 50, 100)


def draw_rewind() -> None:
    """A late fix: the events by their own time, before and after it has arrived."""
    figure = figure_of(9, 3.6)
    axes = figure.subplots(2, 1, sharex=True)
    imu = np.arange(0, END_MS, STEP_MS)
    for ax, title in zip(axes, ("1  a fix arrives at 112 ms; it was measured at 34 ms", "2  back to the snapshot"
                         " at 0 ms, forward again, fix included, up to the newest IMU sample"), strict=True):  # fmt: skip
        ax.set_title(title, loc="left", fontsize=10)
        ax.plot(imu, np.zeros(len(imu)), "o", color=GREY, markersize=5)
        ax.plot(np.arange(6, END_MS - STEP_MS, 12), np.full(9, 0.5), "s", color=GREEN, markersize=5)
        for at in SNAPSHOTS_MS:
            ax.axvline(at, color=BLUE, linewidth=5, alpha=0.25)
        ax.set(ylim=(-0.6, 1.7), yticks=(0, 0.5, 1.1), yticklabels=("IMU", "wheels", "GNSS"))
        ax.spines[["top", "right", "left"]].set_visible(False)
        ax.tick_params(left=False)
    arrow(axes[0], (ARRIVAL_MS, 1.1), (FIX_MS + 1.5, 1.1), VERMILION)
    axes[0].plot(ARRIVAL_MS, 1.1, "D", color=VERMILION, fillstyle="none")
    for ax in axes:
        ax.plot(FIX_MS, 1.1, "D", color=VERMILION)
    arrow(axes[1], (110, -0.38), (1, -0.38), BLUE, "--")
    for begin, end in ((0, FIX_MS), (FIX_MS, 110)):
        arrow(axes[1], (begin, 1.45), (end, 1.45), BLUE)
    axes[1].annotate("the interval 30 to 40 ms is split at the fix", (FIX_MS, 1.1), (FIX_MS + 4, 1.0), fontsize=8)
    axes[0].annotate("snapshot", (SNAPSHOTS_MS[1], 1.5), (SNAPSHOTS_MS[1] + 1.2, 1.4), fontsize=8, color=BLUE)
    axes[1].set_xlabel("time of measurement [ms]")
    path = IMAGES / "rewind.png"
    figure.savefig(path)
    shrink(path)


def arrow(ax: Axes, tail: tuple[float, float], head: tuple[float, float], colour: str, style: str = "-") -> None:
    look = {"arrowstyle": "->", "color": colour, "linestyle": style, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", head, tail, arrowprops=look)


# --- Simulated drives: the heading bank at work, a slip that is detected

REVERSES = """
truth_rate_hz = 20
[start]
heading_deg = 120.0
[[segment]]
duration_s = 6
[[segment]]
duration_s = 5
speed_mps = -2.5
[[segment]]
duration_s = 6
turn_deg = 40.0
[[segment]]
duration_s = 3
"""
SLIPS = """
truth_rate_hz = 20
[start]
heading_deg = 30.0
speed_mps = 10.0
[[segment]]
duration_s = 10
turn_deg = 30.0
[[segment]]
duration_s = 10
speed_mps = 13.0
[[segment]]
duration_s = 10
turn_deg = -30.0
[[wheels.slip]]
wheel = "rear_left"
start_s = 15
stop_s = 20
factor = 1.3
"""


class Seen(NamedTuple):
    """Samples of a drive, one for each publication."""

    second: list[float]
    looks: list[tuple[float, ...]]
    truth: dict[str, list[float]]  # columns by name, and `second`


def seen(scenario: str, look: Callable[[Replay, StateMessage], tuple[float, ...]]) -> Seen:
    """Simulate a drive, fuse it, and sample it at every publication."""
    second: list[float] = []
    looks: list[tuple[float, ...]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_drive(parse(scenario), folder)
        settings = config.load(folder / "fusiond.toml")

        def take(message: StateMessage, _: object) -> None:
            second.append(run.elapsed_ns / SECOND)
            looks.append(look(run, message))

        run = Replay(settings, ReplayTask(50.0, on_tick=[take]))
        run.run(open_logs([str(folder / "drive.tlog"), str(folder / "drive.log")], settings))
        with (folder / "truth.csv").open() as file:
            rows = list(csv.DictReader(file))
    truth = {column: [float(row[column]) for row in rows] for column in rows[0]}
    truth["second"] = [(t_us - truth["unix_us"][0]) / 1e6 for t_us in truth["unix_us"]]
    return Seen(second, looks, truth)


def draw_bank() -> None:
    """How the heading is found: a vehicle that reverses out of its parking place."""

    def look(run: Replay, message: StateMessage) -> tuple[float, ...]:
        """Yaw and sigma; before there is a state, NaN, and weight and yaw of each remaining hypothesis."""
        head, kernel = run.fusion.history.head, run.fusion.history.kernel
        if message.state:
            return message.state.yaw_deg % 360, message.state.sigma_yaw_deg
        left = np.flatnonzero(head.bank[:, 0]) if head.stamps[PHASE] == CHOOSING else []
        yaws = (math.degrees(solution_state(head.hypothesis(i), kernel).euler()[2]) % 360 for i in left)
        return (math.nan, *(number for i, yaw in zip(left, yaws, strict=True) for number in (float(head.bank[i, 0]), yaw)))

    second, looks, truth = seen(REVERSES, look)
    figure = figure_of(9, 4.4)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    choosing = [(t, values[1:]) for t, values in zip(second, looks, strict=True) if math.isnan(values[0])]
    for t, values in choosing[::2]:
        top.scatter([t] * (len(values) // 2), values[1::2], s=60 * np.array(values[::2]) + 1, color=BLUE, linewidths=0)
    t, yaw, sigma = np.array([(t, *values) for t, values in zip(second, looks, strict=True) if values[0] >= 0]).T
    top.fill_between(t, yaw - 3 * sigma, yaw + 3 * sigma, color=GREEN, alpha=0.25, linewidth=0)
    top.plot(t, yaw, color=GREEN, label="the filter runs (band: 3 sigma)")
    top.plot(truth["second"], np.array(truth["yaw_deg"]) % 360, "--", color=VERMILION, linewidth=1.2, label="true heading")
    top.scatter([], [], s=40, color=BLUE, label="hypotheses, size by weight")
    top.set(ylabel="heading [deg]", ylim=(0, 360), yticks=range(0, 361, 60))
    top.legend(loc="upper right", frameon=False, fontsize=8)
    top.set_title("Start without a heading, in reverse, with wheels that do not measure direction", loc="left", fontsize=10)
    bottom.plot(truth["second"], -np.hypot(truth["vn_mps"], truth["ve_mps"]), color=GREY)
    bottom.set(ylabel="speed [m/s]", xlabel="time [s]", xlim=(0, second[-1]))
    save(figure, "bank.png")


def draw_slip() -> None:
    """How a wheel that slips is detected and not fused."""

    def look(run: Replay, message: StateMessage) -> tuple[float, ...]:
        """Estimated speed, the wheel's speed, and the probabilities of the wheel's health."""
        head, history = run.fusion.history.head, run.fusion.history
        wheel = float(head.memory[history.index["rear_left"], LAST_SPEED])
        speed = math.hypot(*message.state.velocity_ned_mps[:2]) if message.state else math.nan
        return speed, wheel, *run.fusion.health(message.t_ns)["rear_left"].probabilities

    second, looks, truth = seen(SLIPS, look)
    speed, wheel, *probabilities = np.array(looks).T
    figure = figure_of(9, 4.4)
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot(second, wheel, color=VERMILION, linewidth=1.0, label="rear left wheel")
    top.plot(second, speed, color=BLUE, linewidth=1.6, label="estimate")
    top.plot(truth["second"], np.hypot(truth["vn_mps"], truth["ve_mps"]), "--", color=GREY, linewidth=1.0, label="truth")
    top.set(ylabel="speed [m/s]", ylim=(8, None))
    top.legend(loc="upper left", frameon=False, fontsize=8)
    top.set_title("A wheel spins 30 % too fast from 15 s to 20 s", loc="left", fontsize=10)
    colours = (GREEN, BLUE, VERMILION, ORANGE, GREY)
    bottom.stackplot(second, *probabilities, colors=colours, labels=STATUSES, alpha=0.8, linewidth=0)
    bottom.set(ylabel="probability", xlabel="time [s]", xlim=(12, 24), ylim=(0, 1))
    bottom.legend(loc="center left", framealpha=0.9, fontsize=8)
    save(figure, "slip.png")


def save(figure: Figure, name: str) -> None:
    figure.savefig(IMAGES / name)
    shrink(IMAGES / name)


# --- Two odometries


def draw_odometry() -> None:
    """The bundled drive in map and in odom, and the error in odom since it began."""
    settings = config.load(demo.DRIVE / "fusiond.toml")
    odometry, drift, frames = OdometryFrame(), Drift(), list[LocalFrame]()
    truth = truth_of(demo.DRIVE / "truth.csv.gz")
    rows: list[tuple[float, ...]] = []

    def take(message: Message) -> None:
        if not isinstance(message, StateMessage) or message.state is None:
            return
        frames[:] = frames or [LocalFrame.at(message.state)]
        local = frames[0].state(message.state)
        _, body = odometry.follow(message.t_ns, local, message.resets)
        drift.follow(message.t_ns, local, body, message.state.sigma_gyro_bias_rps)
        covariance = drift.covariance(local, body)
        sigma = math.sqrt(covariance[0] + covariance[7])
        true = truth.at(message.t_ns)
        if true is not None:
            place = displacement(true.lat_deg, true.lon_deg, origin_deg(frames[0]), true.height_m)
            w, x, y, z = body.quaternion
            turn = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - (math.pi / 2 - math.radians(true.yaw_deg))
            rows.append((message.t_ns / SECOND, *local.position_l[:2], *body.position[:2], sigma, *place, turn))

    logs = open_logs([str(demo.DRIVE / log) for log in demo.LOGS], settings)
    Replay(settings, ReplayTask(20.0, on_message=[take])).run(logs)
    t, x, y, x_odom, y_odom, sigma, north, east, turn = np.array(rows).T
    sine, cosine = math.sin(turn[0]), math.cos(turn[0])  # of odom against the truth, where it begins
    east, north = east - east[0], north - north[0]
    true_x, true_y = cosine * east - sine * north, sine * east + cosine * north
    error = np.hypot(x_odom - x_odom[0] - true_x, y_odom - y_odom[0] - true_y)
    figure = figure_of(9, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    left.plot(x, y, color=BLUE, label="odometry, in map")
    left.plot(x_odom, y_odom, "--", color=VERMILION, linewidth=1.2, label="odometry/local, in odom")
    left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    left.legend(loc="best", frameon=False, fontsize=8)
    right.fill_between(t - t[0], 0, 2 * sigma, color=GREEN, alpha=0.25, linewidth=0, label="2 sigma, as published")
    right.plot(t - t[0], error, color=VERMILION, label="error of odometry/local since it began")
    right.set(xlabel="time since the first state [s]", ylabel="m", xlim=(0, t[-1] - t[0]), ylim=(0, None))
    right.legend(loc="upper left", frameon=False, fontsize=8)
    right.set_title("odom drifts, and says how far", loc="left", fontsize=10)
    save(figure, "odometry.png")


def origin_deg(frame: LocalFrame) -> tuple[float, float]:
    """Latitude and longitude of a frame's origin [deg]."""
    return math.degrees(frame.origin[0]), math.degrees(frame.origin[1])


# --- What `fusiond top` shows

TOP_SECOND = 62.0  # of the bundled drive: eight seconds into the tunnel
TOP_COLUMNS, TOP_LINES = 122, 32
INKS = {"plain": "#d8d8d8", "dim": "#808080", "bold": "#ffffff", "green": "#50c878", "yellow": "#f0c040", "red": "#ff6060"}
COLUMN, ROW, MARGIN = 8, 17, 12  # pixels
PLAIN, BOLD = "DejaVuSansMono", "DejaVuSansMono-Bold"  # fonts that come with matplotlib


def draw_top() -> None:
    """The screen of `fusiond top` in the bundled drive."""
    settings = config.load(demo.DRIVE / "fusiond.toml")
    view = View()
    until_ns: list[int] = []

    def take(message: Message) -> None:
        if isinstance(message, StateMessage):
            until_ns[:] = until_ns or [message.t_ns + nanoseconds(TOP_SECOND)]
        if isinstance(message, StateMessage | HealthMessage | EventMessage) and message.t_ns <= until_ns[0]:
            view.add(message)

    logs = open_logs([str(demo.DRIVE / log) for log in demo.LOGS], settings)
    Replay(settings, ReplayTask(50.0, on_message=[take])).run(logs)
    lines = page(view, 0.0, TOP_COLUMNS, TOP_LINES, Place())
    picture = Image.new("RGB", (TOP_COLUMNS * COLUMN + 2 * MARGIN, len(lines) * ROW + 2 * MARGIN), "#101418")
    folder = Path(get_data_path(), "fonts", "ttf")
    fonts = {name: ImageFont.truetype(str(folder / f"{name}.ttf"), 13) for name in (PLAIN, BOLD)}
    pen = ImageDraw.Draw(picture)
    for row, line in enumerate(lines):
        column = 0
        for span in line:
            place = MARGIN + column * COLUMN, MARGIN + row * ROW
            pen.text(place, span.text, INKS[span.colour], fonts[BOLD if span.colour == "bold" else PLAIN])
            column += len(span.text)
    path = IMAGES / "top.png"
    picture.save(path)
    shrink(path)


# --- The report


def draw_report() -> None:
    """The head of a report of the bundled drive, and further down its health and innovations, in the dark."""
    if browser() is None:
        print("report.png skipped: needs a browser, chromium", file=sys.stderr)
        return
    settings = config.load(demo.DRIVE / "fusiond.toml")
    logs = [str(demo.DRIVE / log) for log in demo.LOGS]
    with tempfile.TemporaryDirectory() as folder, opened() as shown:
        out = Path(folder) / "drive.html"
        truth = demo.DRIVE / "truth.csv.gz"
        replay(Options(config=settings, config_name="fusiond.toml", logs=logs, truth=truth, report=out))
        for name, scheme, first, height in (("report", "light", "overview", 1400), ("report-dark", "dark", "health", 1330)):
            shown.open(out, width=1200, height=2000, scheme=scheme)
            path = IMAGES / f"{name}.png"
            shown.picture(path, f"#{first}", "main", height)
            shrink(path, 256, Image.Quantize.MEDIANCUT)


PICTURES = {
    "rewind": draw_rewind,
    "demo": draw_demo,
    "arrival": draw_arrival,
    "bank": draw_bank,
    "slip": draw_slip,
    "odometry": draw_odometry,
    "top": draw_top,
    "report": draw_report,
}

if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    for wanted in sys.argv[1:] or PICTURES:
        PICTURES[wanted]()
