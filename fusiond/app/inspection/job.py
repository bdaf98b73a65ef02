"""One inspection: the logs are read without a configuration, then with one made of what was found, which is filled in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusiond.app.inspection import draft as drafts
from fusiond.app.inspection.drive import Drive, lag
from fusiond.app.inspection.facts import Inspection, LogFacts, StreamFacts, WheelFacts
from fusiond.app.inspection.speeds import speeds
from fusiond.app.mounting.windows import MountingError
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.maths.typed import Array
from fusiond.units import SECOND
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.survey import Survey, survey

LEAST_LAG_S = 0.05  # of wheels: below, it is not worth a key
ROUND = 2  # digits of a noise density


def inspect(paths: Sequence[str], dbcs: Sequence[Path], folder: Path) -> Inspection:
    """Inspect the logs of one vehicle. `folder`: where the configuration will be. DBC files beside the logs are used where
    none is given. Raises LogError, ConfigError."""
    surveys = [survey(path) for path in paths]
    if not dbcs and any(one.protocol == "can" for one in surveys):
        dbcs = sorted({dbc for path in paths for dbc in Path(path).parent.glob("*.dbc")})
    made = drafts.draft(surveys, dbcs, folder)
    drive = _drive(made, paths, folder)
    wheels = _wheels(made, surveys, drive)
    if drive is not None:
        if made.has("wheel") and not drive.config.wheel:
            drive = _drive(made, paths, folder) or drive
        _fill(made, drive)
    notes = made.notes + list(_missing(made, drive))
    return Inspection(
        logs=[_log_facts(one) for one in surveys],
        sources=drive.facts() if drive else [],
        wheels=wheels,
        clocks=drive.clocks() if drive else {},
        notes=notes,
        config=made.text(_heading(paths)) if drive else None,
        copied=[str(path) for path in made.copied],
    )


def _heading(paths: Sequence[str]) -> list[str]:
    names = ", ".join(Path(path).name for path in paths)
    return [
        f"Made by `fusiond inspect` from {names}.",
        "A configuration to start from: measure the positions on the vehicle, then `fusiond check` and `fusiond replay`.",
        "docs/configuration.md explains every key, docs/tuning.md how to find the values.",
    ]


def _config(made: drafts.Draft, folder: Path) -> Config:
    """The configuration as it is so far; DBC files of fusiond where they are now."""
    text = made.text()
    for path in made.copied:
        text = text.replace(f'"{path.name}"', f'"{path}"')
    return config.parse(text, folder / "inspected.toml")


def _drive(made: drafts.Draft, paths: Sequence[str], folder: Path) -> Drive | None:
    """What the sensors measured; None where there can be no configuration, as the inertial sensor is missing."""
    if not made.has("imu"):
        return None
    settings = _config(made, folder)
    return Drive(settings, open_logs(paths, settings))


def _wheels(made: drafts.Draft, surveys: Sequence[Survey], drive: Drive | None) -> list[WheelFacts]:
    """What looks like wheels on the buses; the best preset is put into the configuration if it has no wheels."""
    gnss = drive.gnss_speed() if drive else np.zeros((0, 2))
    origin_s = (drive.origin_ns if drive else 0) / SECOND
    by_time: Array = gnss + np.array([origin_s, 0.0])
    best_of: dict[tuple[str, str, str], WheelFacts] = {}  # each is told once, of the log that it shows in best
    for log in surveys:
        for one in speeds(log, by_time, made.described) if log.protocol == "can" else ():
            key = one.channel, one.name, one.what
            if key not in best_of or (one.correlation or 0.0) > (best_of[key].correlation or 0.0):
                best_of[key] = one
    found = list(best_of.values())
    best = next((one for one in found if one.preset), None)
    if best is not None and not made.has("wheel"):
        drafts.add_preset(made, best.preset, best.channel)
    elif not made.has("wheel") and found:
        first = found[0]
        made.notes.append(
            f"{first.name} of channel {first.channel}, {first.what}, follows the GNSS speed "
            f"(correlation {first.correlation:.3f}): write a DBC file for it, see docs/tuning.md, and inspect with it"
        )
    made.drop_empty_buses()
    return found


def _fill(made: drafts.Draft, drive: Drive) -> None:
    """Fill in what the drive tells: rotation and noise of the inertial sensor, lag of the wheels."""
    for table in made.tables:
        kind, _, receiver = table.name.partition(".")
        if kind == "gnss":
            if drive.knows_lateness(f"{receiver}.position"):
                for key in ("delay_sigma_ms", "velocity_delay_sigma_ms"):
                    table.keys.pop(key, None)
            fixes = drive.rows(f"{receiver}.position")
            if len(fixes) > 1:
                table.keys["interval_s"] = round(float(np.median(np.diff(fixes[:, 0]))), 3) or 0.001
    ((name, _),) = drive.config.imu.items()
    table = made.table("imu")
    rows = drive.rows(name)
    if len(rows) > 1:
        noise = drive.noise(name)
        why = "vibration included, by the differences of successive samples"
        table.keys.update({"accel_noise": _rounded(noise[0]), "gyro_noise": _rounded(noise[1])})
        table.why.update(accel_noise=why)
    try:
        found = drive.mounting()
    except MountingError as error:
        made.notes.append(f"rotation_deg of the inertial sensor is not known from this drive: {error}")
    else:
        table.keys["rotation_deg"] = [round(math.degrees(angle), 1) + 0.0 for angle in found.rotation]
        table.why["rotation_deg"] = f"found from the drive to {math.degrees(max(found.sigma)):.1f} deg"


def _rounded(value: float) -> float:
    """Upwards, to two digits."""
    if not value > 0:
        return 1e-6
    unit = 10.0 ** (math.floor(math.log10(value)) - ROUND + 1)
    return float(f"{math.ceil(value / unit) * unit:.6g}")


def _missing(made: drafts.Draft, drive: Drive | None) -> list[str]:
    """What a vehicle needs and the logs do not have."""
    notes = []
    if drive is None:
        notes.append("no inertial sensor that fusiond reads is in the logs: a state needs one; a CAN log needs its DBC file")
    else:
        rows = drive.rows(next(iter(drive.config.imu)))
        interval_s = float(np.median(np.diff(rows[:, 0]))) if len(rows) > 1 else math.inf
        if interval_s > drive.config.filter.imu_gap_s:
            notes.append(
                f"the inertial sensor gives a sample every {interval_s:.2f} s; the filter needs one every "
                f"{drive.config.filter.imu_gap_s:g} s at the least, and better 50 a second: such a log cannot be fused"
            )
    if not made.has("gnss"):
        notes.append("no receiver is in the logs: without a position the filter never starts")
    elif drive is not None and not len(drive.gnss_speed()):
        notes.append("no fix in the logs gives a velocity")
    if drive is not None and drive.config.wheel and drive.config.gnss:
        found = lag(drive.gnss_speed(), drive.wheel_speed())
        if found is not None and abs(found[0]) >= LEAST_LAG_S:
            notes.append(f"GNSS speed lags behind that of the wheels by {1e3 * found[0]:.0f} ms: see docs/tuning.md")
    return notes


def _log_facts(one: Survey) -> LogFacts:
    first_ns, last_ns = one.span_ns
    streams = [
        StreamFacts(
            sender=stream.sender,
            name=stream.name,
            count=stream.count,
            rate_hz=stream.rate_hz,
            jitter_ms=stream.jitter_s * 1e3,
            gap_s=stream.gap_ns / SECOND,
            gap_at_s=max(0, stream.gap_at_ns - first_ns) / SECOND,
        )
        for _, stream in sorted(one.streams.items())
    ]
    return LogFacts(
        path=str(one.file.path),
        format=one.about,
        first_ns=first_ns,
        last_ns=last_ns,
        sessions=one.sessions,
        senders=one.senders,
        streams=streams,
        counts={name: count for name, count in one.file.counts.items() if count},
        warnings=one.file.warnings,
    )
