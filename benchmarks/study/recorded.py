"""Drives of the simulator as a list of events, and the estimator fed with them: what it publishes against the truth.

The configuration is the one that the simulator writes for the drive: an installer's measurements, else the defaults.
"""

from __future__ import annotations

import functools
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusiond.config.load import load
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.estimator.solution import Mode
from fusiond.events import Received
from fusiond.filter.rows import Outcome
from fusiond.maths.statistics import chi_square
from fusiond.maths.typed import Array
from fusiond.simulation.drive import simulate
from fusiond.simulation.matching import configuration, dbc
from fusiond.simulation.scenario import Scenario
from fusiond.simulation.truth import Truth
from fusiond.simulation.wgs84 import radii
from fusiond.units import SECOND, nanoseconds

LOOK_NS = SECOND // 10
LOOK_S = LOOK_NS / SECOND
SIGMAS_95 = math.sqrt(chi_square(0.95, 2))  # of the ellipse that holds 95 % of horizontal errors
DISHONEST_M, DISHONEST_SIGMAS = 2.0, 3.0  # an error is dishonest that exceeds both
PAUSE_S = 1.0  # between two fused fixes, of a receiver that is fused
DBC_NAME = "drive.dbc"
WHEEL_HZ = 20.0
Segment = dict[str, float]


def road(random: np.random.Generator, seconds: float) -> list[Segment]:
    """A drive through town and over land, at 8 to 20 m/s: bends, straight roads, slopes and stops, from standstill on."""
    segments: list[Segment] = [{"duration_s": 5.0}, {"duration_s": 6.0, "speed_mps": 10.0}]
    speed, until_stop = 10.0, 3
    while sum(segment["duration_s"] for segment in segments) < seconds:
        if until_stop == 0:
            segments += [
                {"duration_s": speed / 2 + 2, "speed_mps": 0.0, "grade_deg": 0.0},
                {"duration_s": float(random.uniform(3, 8))},
                {"duration_s": 6.0, "speed_mps": 10.0},
            ]
            speed, until_stop = 10.0, int(random.integers(4, 8))
            continue
        until_stop -= 1
        town = random.random() < 0.6
        side = float(random.choice((-1.0, 1.0)))
        turn = side * (random.uniform(30, 100) if town else random.uniform(0, 40))
        speed = float(random.uniform(8, 12) if town else random.uniform(13, 20))
        grade = float(random.uniform(-2, 2))
        duration = float(random.uniform(9, 13))
        segments.append({"duration_s": duration, "speed_mps": speed, "turn_deg": turn, "grade_deg": grade})
    return segments


def scenario(
    random: np.random.Generator, seconds: float, segments: list[Segment] | None = None, **tables: dict[str, Any]
) -> Scenario:
    """The road, or another course, with the installation's errors drawn at random, and some keys of the scenario's tables
    changed."""
    raw: dict[str, Any] = {
        "segment": road(random, seconds) if segments is None else segments,
        "start": {"heading_deg": float(random.uniform(-180, 180))},
        "imu": {"mount_deg": [0.0, *(float(angle) for angle in random.normal(0, 0.5, 2))]},
        "wheels": {"rate_hz": WHEEL_HZ, "scale_error": float(random.normal(0, 0.005)), "chatter": False},
    }
    for name, keys in tables.items():
        raw[name] = raw.get(name, {}) | keys
    return msgspec.convert(raw, Scenario)


def installed(config: Config) -> Config:
    """The configuration with nothing said of the receiver's noise: as the defaults have it."""
    receivers = {
        name: type(gnss)(**{key: getattr(gnss, key) for key in ("link", "message", "lever_arm_m", "delay_ms", "interval_s")})
        for name, gnss in config.gnss.items()
    }
    return msgspec.structs.replace(config, gnss=receivers)


def changed(config: Config, table: str, **keys: Any) -> Config:
    """The configuration with keys of a table, or of every sensor of a kind, changed: to a value, or by a function."""

    def rewritten(section: Any) -> Any:
        values = {key: new(getattr(section, key)) if callable(new) else new for key, new in keys.items()}
        return msgspec.structs.replace(section, **values)

    old = getattr(config, table)
    new = {name: rewritten(section) for name, section in old.items()} if isinstance(old, dict) else rewritten(old)
    return msgspec.structs.replace(config, **{table: new})


def written(drive: Scenario) -> Config:
    """The configuration that the simulator writes for a drive."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / DBC_NAME).write_text(dbc(drive))
        (file := Path(folder) / "config.toml").write_text(configuration(drive, DBC_NAME))
        return load(file)


@dataclass(frozen=True)
class Recorded:
    """A drive: the events in the order of receipt, the truth, and the configuration."""

    events: list[Received]
    truth: Truth
    config: Config

    @property
    def start_ns(self) -> int:
        return int(self.truth.t_ns[0])


def recorded(drive: Scenario, seed: int) -> Recorded:
    """Simulate a drive."""
    made = simulate(drive, seed)
    return Recorded(list(made.events()), made.truth, written(drive))


@functools.lru_cache(maxsize=2)
def town(seed: int, run: int, seconds: float) -> Recorded:
    """The drive of one run, kept while it is used."""
    random = np.random.default_rng([seed, run])
    return recorded(scenario(random, seconds), int(random.integers(1 << 31)))


@dataclass
class Watched:
    """What was published, at 10 Hz: times [s] from the start of the drive, horizontal error (N, 2) [m], its covariance
    (N, 2, 2), speed [m/s], mode; NaN before the first state. The status of each source, and how many of its events had
    been fused and rejected by then."""

    t: list[float] = field(default_factory=list)
    errors: list[tuple[float, float]] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    modes: list[Mode] = field(default_factory=list)
    scales: list[tuple[float, float]] = field(default_factory=list)  # of the wheels, and its sigma
    statuses: dict[str, list[str]] = field(default_factory=dict)
    fused: dict[str, list[int]] = field(default_factory=dict)
    rejected: dict[str, list[int]] = field(default_factory=dict)
    ratios: dict[str, list[float]] = field(default_factory=dict)  # newest test ratio, where asked for
    resets: int = 0

    @property
    def started_s(self) -> float:
        """When the first state was published [s] (inf: never)."""
        known = np.flatnonzero(np.isfinite(self.distance()))
        return self.t[known[0]] if len(known) else math.inf

    def distance(self) -> Array:
        """Horizontal error (N,) [m]."""
        return np.asarray(np.hypot(*np.array(self.errors).T))

    def sigmas(self) -> Array:
        """Horizontal error (N,) in published sigmas: the Mahalanobis distance."""
        off, claimed = np.array(self.errors), np.array(self.covariances)
        return np.asarray(np.sqrt(np.einsum("ti,ti->t", off, np.linalg.solve(claimed, off[..., None])[..., 0])))


    def claimed(self) -> Array:
        """Published sigma (N,) [m] of the horizontal error."""
        return np.asarray(np.sqrt(np.trace(np.array(self.covariances), axis1=1, axis2=2)))

    def dishonest(self) -> NDArray[np.bool_]:
        """Whether the error (N,) exceeds both what matters and what is claimed."""
        return np.asarray((self.distance() > DISHONEST_M) & (self.sigmas() > DISHONEST_SIGMAS))

    def returned(self, source: str, begin: float) -> float:
        """How long after an instant [s] its events are fused for good, without a pause of more than a second; inf: not by
        the end."""
        k = min(int(np.searchsorted(self.t, begin)), len(self.t) - 1)
        t, fused = np.array(self.t[k:]), self.fused[source][k:]
        taken = t[1:][np.diff(fused) > 0]
        ends = np.append(taken, t[-1])
        pauses = np.flatnonzero(np.diff(ends, prepend=t[0]) > PAUSE_S)
        if len(pauses) == 0:
            return float(ends[0]) - begin
        return float(ends[pauses[-1]]) - begin if pauses[-1] < len(taken) else math.inf

    def between(self, start: float, stop: float) -> NDArray[np.bool_]:
        """Which looks (N,) lie in [start, stop) s and have a state."""
        t = np.array(self.t)
        return np.asarray((t >= start) & (t < stop) & np.isfinite(self.distance()))

    def bad(self, rows: NDArray[np.bool_]) -> dict[str, float]:
        """By source the share of these looks at which it was not nominal."""
        return {source: float((np.array(status)[rows] != "nominal").mean()) for source, status in self.statuses.items()}


UNKNOWN = np.full((2, 2), np.nan)


def watch(
    drive: Recorded, events: Sequence[Received], until_s: float = math.inf, config: Config | None = None,
    from_s: float = 0.0, ratios: bool = False,
) -> Watched:  # fmt: skip
    """Feed a drive's events, or what has become of them, and look at what would be published from a time [s] on."""
    fusion, found, truth = Fusion(config or drive.config), Watched(), drive.truth
    last = min(drive.start_ns + nanoseconds(min(until_s, 1e6)), int(truth.t_ns[-1]))
    looks = np.arange(drive.start_ns + nanoseconds(from_s) + LOOK_NS, last, LOOK_NS)
    place = _places(truth, looks)
    for source in fusion.params.sources:
        found.statuses[source], found.fused[source], found.rejected[source], found.ratios[source] = [], [], [], []
    feed, number, due = fusion.feed, 0, looks.tolist()
    for event in events:
        while number < len(due) and due[number] < event.t_receive_ns:
            _look(fusion, found, due[number], place[number], ratios)
            number += 1
        if number == len(due):
            break
        feed(event)
    found.t = [(t - drive.start_ns) / SECOND for t in due[: len(found.modes)]]
    found.resets = fusion.solution_at(last).resets
    return found


def _places(truth: Truth, t_ns: NDArray[np.int64]) -> Array:
    """True latitude, longitude [rad], and the metres that one radian of each is long (N, 4)."""
    latitude, longitude, height = (np.interp(t_ns, truth.t_ns, x) for x in (truth.latitude, truth.longitude, truth.height))
    meridian, transverse = radii(latitude)
    return np.stack([latitude, longitude, meridian + height, (transverse + height) * np.cos(latitude)], -1)


def _look(fusion: Fusion, found: Watched, t_ns: int, place: Array, ratios: bool) -> None:
    solution = fusion.solution_at(t_ns)
    state = solution.state
    found.modes.append(solution.mode)
    if state is None:
        found.errors.append((math.nan, math.nan))
        found.covariances.append(UNKNOWN)
        found.speeds.append(math.nan)
        found.scales.append((math.nan, math.nan))
    else:
        latitude, longitude, north, east = place.tolist()
        found.errors.append(((state.latitude - latitude) * north, (state.longitude - longitude) * east))
        found.covariances.append(state.covariance[:2, :2])
        found.speeds.append(math.hypot(*state.velocity_n))
        found.scales.append((state.wheel_scale, state.sigma_wheel_scale))
    counts = fusion.history.counts
    for source, belief in fusion.health(t_ns).items():
        index = fusion.history.index[source]
        found.statuses[source].append(belief.status)
        found.fused[source].append(int(counts[index, Outcome.FUSED]))
        found.rejected[source].append(int(counts[index, Outcome.REJECTED]))
        if ratios:
            rows = fusion.history.rows
            mine = rows[(rows["source"] == index) & (rows["ratio"] > 0)]
            found.ratios[source].append(float(mine["ratio"][-1]) if len(mine) else math.nan)


def write_trace(found: Watched, file: Path) -> None:
    """A CSV with a row for each look."""
    head = ["t_s", "error_north_m", "error_east_m", "sigma_north_m", "sigma_east_m", "sigmas", "speed_mps", "mode"]
    sources = list(found.statuses)
    columns = [f"{source} {what}" for source in sources for what in ("status", "ratio", "fused", "rejected")]
    lines = [",".join([*head, *columns])]
    sigmas = found.sigmas()
    for k, t in enumerate(found.t):
        claimed = np.sqrt(np.diag(found.covariances[k]))
        numbers = (*found.errors[k], *claimed, sigmas[k], found.speeds[k])
        row = [f"{t:.3f}", *(f"{value:.4g}" for value in numbers), found.modes[k].value]
        for source in sources:
            ratio = f"{found.ratios[source][k]:.4g}" if found.ratios[source] else ""
            row += [found.statuses[source][k], ratio, str(found.fused[source][k]), str(found.rejected[source][k])]
        lines.append(",".join(row))
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
