"""Tuning: the first half of a log tells values, spells without GNSS decide which of them to take, the second half judges."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fusiond.app.replay.summary import table
from fusiond.app.tuning import methods
from fusiond.app.tuning.edit import with_keys
from fusiond.app.tuning.methods import Estimate, SlowNoise
from fusiond.app.tuning.series import LogSeries, read_series, until
from fusiond.app.tuning.spells import Score, is_better, length_for, score
from fusiond.config import load
from fusiond.config.schema import Config, Gnss
from fusiond.config.toml import read_text
from fusiond.errors import UnusableError
from fusiond.estimator.archive import Archive, Spool
from fusiond.estimator.fusion import Fusion
from fusiond.estimator.smoother import SmoothedState, Smoother
from fusiond.events import FIX_DGPS, FIX_FIXED, FIX_FLOAT
from fusiond.filter.calibration import calibrations
from fusiond.filter.state import CALIBRATIONS, FilterState
from fusiond.maths.rotation import matrix
from fusiond.maths.typed import Array, Stamps
from fusiond.maths.wgs84 import ecef
from fusiond.units import SECOND

MOVING = 1.0  # m/s, from which on the road shakes the inertial sensor
LONGEST_LAG = 40.0  # s, of structure functions
STRANGE = 4.0  # of the sigma before: a calibration further off is not that, but another error
TOLD = 0.5  # of the sigma before: an installation value whose sigma the smoother did not bring below is not told
OPENED = {"delay_sigma_ms": 100.0, "velocity_delay_sigma_ms": 100.0, "lever_arm_sigma_m": 0.5}  # of a receiver, to learn
IMU_DELAY_MS = 20.0  # the same of the inertial sensor
LEVER_ARM = ("lever_arm_forward_m", "lever_arm_right_m", "lever_arm_down_m")  # of calibrations, by axis
UNITS = {"deg_per_mps2": "deg per m/s^2", "_deg": "deg", "_ms": "ms", "_m": "m"}  # by the end of a calibration's name
VAGUE = 0.7  # of what velocities scatter, by which the smoother without them may be unsure for them to be told
VAGUE_MS = 30.0  # the same of a delay [ms]
NEXT_TO_NOTHING = 50.0  # m, sigma of fixes that are only to say where the track is
DIFFERENT = 2.0  # sigmas by which a value must differ from the configured one to be taken
ROUNDS = 2  # the smoother is better with what the first has found
SIGMA_OF_TYPE = {FIX_DGPS: "dgps_sigma_m", FIX_FLOAT: "float_sigma_m", FIX_FIXED: "fixed_sigma_m"}
INERTIAL, RECEIVER, WHEELS, INSTALLATION = "inertial noise", "GNSS noise", "wheel noise", "installation"


class Finding(Struct, kw_only=True):
    """What the log tells of one key."""

    group: str
    table: str
    key: str
    unit: str
    configured: float
    found: float
    sigma: float  # standard uncertainty of that
    untold: str = ""  # why the log cannot tell it; empty: it can
    taken: bool = False  # it is in the new configuration


class TuneReport(Struct, kw_only=True):
    """What tuning found."""

    seconds: float  # of the log
    half_s: float  # until which it told; from there on it judges
    findings: list[Finding]
    dropped: list[str]  # groups that made spells of the first half worse, which are not taken
    before: Score | None  # of the second half, as configured
    after: Score | None  # as tuned
    difference: str  # of the two configurations, unified
    text: str  # of the new one


def tune(path: Path, logs: Sequence[str]) -> TuneReport:
    """Tune a configuration by the logs of one drive. Raises ConfigError, LogError, UnusableError."""
    text, config = read_text(path), load.load(path)
    log = read_series(logs, config)
    if log.seconds < 20:
        raise UnusableError(f"the log has {log.seconds:.0f} s of measurements: too few to tell anything")
    half = log.seconds / 2
    tuned, findings = config, list[Finding]()
    for _ in range(ROUNDS):
        findings = [*_inertial(config, log, half), *_receivers(config, tuned, log, half), *_wheels(config, log, half)]
        findings += _installation(config, tuned, log, half)
        told = [one for one in findings if not one.untold and abs(one.found - one.configured) > DIFFERENT * one.sigma]
        tuned = _config(path, text, config, told)
    kept, dropped = _decided(path, text, config, findings, log, half)
    tuned = _config(path, text, config, kept)
    for one in kept:
        one.taken = True
    length = length_for(log.seconds - half)
    new = _text(text, config, kept)
    lines = difflib.unified_diff(text.splitlines(), new.splitlines(), str(path), "tuned", lineterm="", n=1)
    return TuneReport(
        seconds=log.seconds,
        half_s=half,
        findings=findings,
        dropped=dropped,
        before=score(config, log, half, log.seconds, length),
        after=score(tuned, log, half, log.seconds, length),
        difference="\n".join(lines),
        text=new,
    )


def _text(text: str, config: Config, findings: Sequence[Finding]) -> str:
    """The configuration with what was found, to three digits."""
    changes: dict[tuple[str, str], float | list[float]] = {}
    for one in findings:
        if one.key in LEVER_ARM:
            axis = LEVER_ARM.index(one.key)
            given = list(config.gnss[one.table.partition(".")[2]].lever_arm_m)
            arm = changes.setdefault((one.table, "lever_arm_m"), given)
            assert isinstance(arm, list)
            arm[axis] = _rounded(one.found)
        else:
            changes[one.table, one.key] = _rounded(one.found)
    return with_keys(text, changes)


def _config(path: Path, text: str, config: Config, findings: Sequence[Finding]) -> Config:
    return load.parse(_text(text, config, findings), path)


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def _decided(
    path: Path, text: str, config: Config, findings: Sequence[Finding], log: LogSeries, half: float
) -> tuple[list[Finding], list[str]]:
    """The findings to take: all, but for the groups without which the spells of the first half are bridged better; and none
    where they are bridged better as configured."""
    kept = [one for one in findings if not one.untold and abs(one.found - one.configured) > DIFFERENT * one.sigma]
    length, dropped = length_for(half), list[str]()
    configured = score(config, log, 0.0, half, length)
    best = score(_config(path, text, config, kept), log, 0.0, half, length)
    if configured is None or best is None:
        return kept, dropped
    for group in dict.fromkeys(one.group for one in kept):
        others = [one for one in kept if one.group != group]
        without = score(_config(path, text, config, others), log, 0.0, half, length)
        if without is not None and is_better(without, best):
            kept, best = others, without
            dropped.append(group)
    if kept and is_better(configured, best):
        return [], [*dropped, *dict.fromkeys(one.group for one in kept)]
    return kept, dropped


def _finding(group: str, where: str, key: str, unit: str, configured: float, found: Estimate) -> Finding:
    return Finding(
        group=group, table=where, key=key, unit=unit, configured=configured, found=found.value, sigma=found.sigma,
        untold=found.untold,
    )  # fmt: skip


# --- Noise


def _inertial(config: Config, log: LogSeries, half: float) -> Iterator[Finding]:
    """Noise densities on the road, vibration included."""
    ((name, unit),) = config.imu.items()
    readings = until(log.readings.get(name), half)
    if readings is None or len(readings.t) < 2:
        return
    moving = _moving(config, log, readings.t)
    interval = float(np.median(np.diff(readings.t)))
    values = readings.values[moving] if np.count_nonzero(moving) * interval > 5.0 else readings.values
    for key, axes, label in (
        ("accel_noise", slice(0, 3), "m/s^2/sqrt(Hz)"),
        ("gyro_noise", slice(3, 6), "rad/s/sqrt(Hz)"),
    ):
        found = methods.noise_density(values[:, axes], interval)
        yield _finding(INERTIAL, f"imu.{name}", key, label, getattr(unit, key), found)


def _moving(config: Config, log: LogSeries, t: Array) -> NDArray[np.bool_]:
    """Whether the vehicle moves at each instant, by GNSS velocities and wheels; everywhere where there are none."""
    for source in [*(f"{name}.velocity" for name in config.gnss), *config.wheel]:
        readings = log.readings.get(source)
        if readings is not None:
            speed = np.hypot(*readings.values[:, :2].T) if readings.values.shape[1] > 1 else np.abs(readings.values[:, 0])
            return np.interp(t, readings.t, speed) > MOVING
    return np.ones(len(t), dtype=bool)


def _receivers(config: Config, tuned: Config, log: LogSeries, half: float) -> Iterator[Finding]:
    """Noise of positions, by the structure function of fix less integrated Doppler; of velocities, against the smoother
    without them; and how late velocities are."""
    for name, gnss in config.gnss.items():
        velocity, where = until(log.readings.get(f"{name}.velocity"), half), f"gnss.{name}"
        if velocity is None or len(velocity.t) < methods.LEAST_PAIRS:
            continue
        found, noise = _velocities(where, name, gnss, tuned, log, half)
        yield from found
        yield from _positions(config, tuned, name, log, half, noise)


def _positions(
    config: Config, tuned: Config, name: str, log: LogSeries, half: float, noise: SlowNoise | None
) -> Iterator[Finding]:
    """By the structure function of fix less integrated velocity: that of the smoother, to which fixes say next to nothing.
    Without wheels it has the receiver's errors, and what they make of the path is known."""
    gnss, source = config.gnss[name], f"{name}.position"
    sigmas = dict.fromkeys(("position_sigma_m", "height_sigma_m", *SIGMA_OF_TYPE.values()), NEXT_TO_NOTHING)
    blind = _replaced(tuned, name, **sigmas, position_correlation_s=0.0)
    instants = np.array([e.t_ns for e in log.events if e.source == source and _since(log, e.t_ns) < half], dtype=np.int64)
    states = _smoothed(blind, log, half, np.unique(instants))
    if len(states) < 3 * methods.LEAST_PAIRS:
        return
    readings = log.readings[source]
    t = np.array([_since(log, state.solution.t_ns) for state in states])
    values = readings.values[np.minimum(np.searchsorted(readings.t, t - 1e-7), len(readings.t) - 1)]
    driven = np.array([_antenna(state, np.array(gnss.lever_arm_m), log) for state in states])
    interval = float(np.median(np.diff(t)))
    longest = min(LONGEST_LAG, (t[-1] - t[0]) / 4)
    found = methods.structure(t, values[:, :2] - driven, max(1.0, interval), longest)
    given = noise or SlowNoise(0.0, gnss.velocity_sigma_mps**2, gnss.velocity_correlation_s)
    alone = not any(wheel in log.readings for wheel in config.wheel)
    fit = methods.fit_slow_noise(found, methods.integrated(given, interval, found.lags) if alone else None)
    key = SIGMA_OF_TYPE.get(int(np.median(values[:, 4])), "position_sigma_m")
    sigma = fit.sigma
    if fit.time.untold and fit.noise.slow > fit.noise.white:
        sigma = sigma._replace(untold="it cannot be told from what drifts")
    if (values[:, 3] > getattr(gnss, key)).mean() > 0.5:
        sigma = sigma._replace(untold="the receiver tells its own, which is larger")
    yield _finding(RECEIVER, f"gnss.{name}", key, "m", getattr(gnss, key), sigma)
    yield _finding(RECEIVER, f"gnss.{name}", "position_correlation_s", "s", gnss.position_correlation_s, fit.time)


def _antenna(state: SmoothedState, lever_b: Array, log: LogSeries) -> list[float]:
    """The antenna's place, north and east [m] of the log's first fix."""
    found = state.solution.state
    assert found is not None and log.first is not None
    lever = matrix(np.array(found.quaternion_nb)) @ lever_b
    north, east, _ = log.first[0] @ (ecef(found.latitude, found.longitude, found.height) - log.first[1])
    return [float(north + lever[0]), float(east + lever[1])]


def _velocities(
    where: str, name: str, gnss: Gnss, tuned: Config, log: LogSeries, half: float
) -> tuple[list[Finding], SlowNoise | None]:
    """Against the smoother without them. Returns the noise as well, where the log tells it."""
    source, given = f"{name}.velocity", gnss.velocity_sigma_mps
    instants = np.array([e.t_ns for e in log.events if e.source == source and _since(log, e.t_ns) < half], dtype=np.int64)
    blind = _replaced(tuned, name, use_velocity=False)
    states = _smoothed(blind, log, half, np.unique(instants), without=source)
    if len(states) < 3 * methods.LEAST_PAIRS:
        few = Estimate(0.0, math.inf, f"without them there were {len(states)} states to compare with")
        return [_finding(RECEIVER, where, "velocity_sigma_mps", "m/s", given, few)], None
    t = np.array([_since(log, state.solution.t_ns) for state in states])
    readings = log.readings[source]
    place = np.searchsorted(readings.t, t - 1e-7)
    reading = readings.values[np.minimum(place, len(readings.t) - 1), :2]
    truth = np.array([_antenna_velocity(state, np.array(gnss.lever_arm_m)) for state in states])
    rate = np.gradient(truth, t, axis=0)
    lag = methods.lag_of(t, reading, truth, rate, max(gnss.velocity_correlation_s, 1.0))
    off = reading - truth + (0.0 if lag.untold else lag.value) * rate
    step = float(np.median(np.diff(t)))
    fit = methods.fit_slow_noise(methods.structure(t, off, step, min(20.0, (t[-1] - t[0]) / 4)))
    known = [state.solution.state.covariance for state in states if state.solution.state]
    claimed = math.sqrt(float(np.mean([covariance[3, 3] + covariance[4, 4] for covariance in known])) / 2)
    sigma, time = fit.sigma, fit.time
    if claimed > VAGUE * sigma.value:
        vague = f"without it the velocity is known to {claimed:.2g} m/s only"
        sigma, time = sigma._replace(untold=vague), time._replace(untold=vague)
    share = fit.noise.slow / (fit.noise.slow + fit.noise.white) if fit.noise.slow > 0 else 0.0
    alike = time._replace(value=time.value * share, sigma=time.sigma * share)
    moved = tuned.gnss[name].delay_ms - gnss.delay_ms  # the velocity's delay counts from the position's
    late = Estimate(gnss.velocity_delay_ms + 1e3 * lag.value - moved, 1e3 * lag.sigma, lag.untold)
    if not late.untold and late.sigma > VAGUE_MS:
        late = late._replace(untold="too few changes of speed")
    found = [
        _finding(RECEIVER, where, "velocity_sigma_mps", "m/s", given, sigma),
        _finding(RECEIVER, where, "velocity_correlation_s", "s", gnss.velocity_correlation_s, alike),
        _finding(INSTALLATION, where, "velocity_delay_ms", "ms", gnss.velocity_delay_ms, late),
    ]
    return found, None if sigma.untold else fit.noise


def _antenna_velocity(state: SmoothedState, lever_b: Array) -> list[float]:
    found = state.solution.state
    assert found is not None
    swing = matrix(np.array(found.quaternion_nb)) @ np.cross(found.angular_rate_b, lever_b)
    return [found.velocity_n[0] + float(swing[0]), found.velocity_n[1] + float(swing[1])]


def _wheels(config: Config, log: LogSeries, half: float) -> Iterator[Finding]:
    """White noise of one reading, by third differences while the wheel turns."""
    for name, wheel in config.wheel.items():
        readings = until(log.readings.get(name), half)
        if readings is None:
            continue
        speed = readings.values[:, 0]
        found = methods.white_sigma(speed[np.abs(speed) > MOVING])
        if not found.untold:
            quantised = wheel.quantum_mps / math.sqrt(12)
            value = math.sqrt(max(found.value**2 - quantised**2, 0.0))
            lasting = "its errors last (correlation_s); only the white part shows" if wheel.correlation_s else ""
            found = found._replace(value=value, untold="its steps hide it" if value < quantised / 2 else lasting)
        yield _finding(WHEELS, f"wheel.{name}", "sigma_mps", "m/s", wheel.sigma_mps, found)


# --- Installation, by the smoother


def _installation(config: Config, tuned: Config, log: LogSeries, half: float) -> Iterator[Finding]:
    """Delays, lever arm, scales, mount and slip: what the smoother learns of them, where it learns something."""
    if not tuned.gnss:
        return
    name = next(iter(tuned.gnss))
    opened = _opened(tuned, name)
    last = np.array([log.origin_ns + round(half * SECOND)], dtype=np.int64)
    fusion = Fusion(opened)
    ends = _smoothed(opened, log, half, last - np.arange(40)[::-1] * SECOND // 20)
    if not ends:
        return
    learnt = FilterState(len(fusion.params.sources), fusion.params.size)
    learnt.nominal[:], learnt.covariance[:] = ends[-1].nominal, np.diag(ends[-1].variances)
    first = FilterState(len(fusion.params.sources), fusion.params.size)
    first.covariance[CALIBRATIONS:, CALIBRATIONS:] = np.diag(fusion.params.calibration_variances)
    before = calibrations(fusion.params, first)
    found = calibrations(fusion.params, learnt)
    odd = [what for what, (value, _) in found.items() if abs(value) > STRANGE * before[what][1]]
    doubt = f"{odd[0]} would be {found[odd[0]][0]:.3g}: something else is wrong" if odd else ""
    for what, (value, sigma) in found.items():
        if what != "velocity_delay_ms":  # it is told by how late velocities are
            yield _calibration(config, tuned, name, what, Estimate(value, sigma, doubt), before[what][1])


def _calibration(config: Config, tuned: Config, name: str, what: str, learnt: Estimate, before: float) -> Finding:
    """What the smoother says of one calibration. Delay and lever arm have keys; the others are learnt in each drive."""
    same = f"the sigma only fell from {before:.2g} to {learnt.sigma:.2g}"
    untold = learnt.untold or ("" if learnt.sigma < TOLD * before else same)
    configured, now = config.gnss[name], tuned.gnss[name]
    where, given, base = f"gnss.{name}", 0.0, 0.0
    if what == "delay_ms":
        given, base = configured.delay_ms, now.delay_ms
    elif what in LEVER_ARM:
        axis = LEVER_ARM.index(what)
        given, base = configured.lever_arm_m[axis], now.lever_arm_m[axis]
    else:
        where, untold = "learnt", untold or "learnt in each drive"
    unit = next((unit for suffix, unit in UNITS.items() if what.endswith(suffix)), "")
    return _finding(INSTALLATION, where, what, unit, given, Estimate(base + learnt.value, learnt.sigma, untold))


def _opened(config: Config, name: str) -> Config:
    """A configuration that learns what it can of the installation."""
    receiver = config.gnss[name]
    wider = {key: max(getattr(receiver, key), sigma) for key, sigma in OPENED.items()}
    ((imu, unit),) = config.imu.items()
    learning = msgspec.structs.replace(unit, delay_sigma_ms=max(unit.delay_sigma_ms, IMU_DELAY_MS))
    return msgspec.structs.replace(_replaced(config, name, **wider), imu={imu: learning})


def _replaced(config: Config, name: str, **changes: float | bool) -> Config:
    gnss = config.gnss | {name: msgspec.structs.replace(config.gnss[name], **changes)}
    return msgspec.structs.replace(config, gnss=gnss)


def _since(log: LogSeries, t_ns: int) -> float:
    return (t_ns - log.origin_ns) / SECOND


def _smoothed(
    config: Config, log: LogSeries, half: float, instants: Stamps, without: str = ""
) -> list[SmoothedState]:
    """The smoothed states of the first half, without a source."""
    fusion = Fusion(config)
    archive = Archive(fusion.params, Spool.in_memory())
    fusion.history.archive = archive.add
    for event in log.under(config):
        if event.source != without and _since(log, event.t_ns) < half:
            fusion.fuse(event)
    fusion.history.finish()
    archive.finish()
    smoother = Smoother(archive, instants)
    smoother.smooth()
    return list(smoother.states())


# --- Text


def text(report: TuneReport) -> str:
    """The report for a reader at a terminal."""
    return "\n".join(_lines(report))


def _lines(report: TuneReport) -> Iterator[str]:
    yield f"seconds 0 to {report.half_s:.0f} of the log told, {report.half_s:.0f} to {report.seconds:.0f} judge"
    yield ""
    rows = [["key", "configured", "found", "+-", "unit"]]
    for one in report.findings:
        rows.append(
            [f"[{one.table}] {one.key}", f"{one.configured:.4g}", f"{one.found:.3g}", f"{one.sigma:.2g}", one.unit]
        )
    aligned = list(table(rows))
    yield aligned[0]
    for line, one in zip(aligned[1:], report.findings, strict=True):
        yield line + ("   taken" if one.taken else f"   not told: {one.untold}" if one.untold else _why_not(one))
    for group in report.dropped:
        yield f"{group}: told, but spells without GNSS in the first half are bridged better without it: not taken"
    yield ""
    yield from _scores(report)
    yield ""
    yield report.difference or "nothing to change"


def _why_not(one: Finding) -> str:
    same = abs(one.found - one.configured) <= DIFFERENT * one.sigma
    return "   as configured, within its uncertainty" if same else "   not taken"


def _scores(report: TuneReport) -> Iterator[str]:
    if report.before is None or report.after is None:
        yield "held out: the second half is too short for a spell without GNSS, so nothing judges these values"
        return
    spells, length = report.before.spells, report.before.length_s
    rows = [[f"held out: {spells} spells of {length:.0f} s without GNSS", "RMSE [m]", "NEES (2 is honest)"]]
    for name, one in (("  as configured", report.before), ("  as tuned", report.after)):
        rows.append([name, f"{one.rmse_m:.2f}", f"{one.nees:.2f}"])
    yield from table(rows)
