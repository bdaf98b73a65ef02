"""One configuration for a fleet: each drive is tuned by itself, what they say of the noise is joined, other drives judge.

Noise is the same for vehicles of a kind, so the median over drives is taken, with the uncertainty that their scatter shows.
What is each vehicle's own (lever arms, delays, scales, mount) is told apart, by vehicle. Of the drives in FOLDS parts, each
part is measured by a configuration that the others told: so no drive judges what it has told itself. Group by group of
values is taken that makes these drives not significantly worse.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from fusiond.app.replay.summary import table
from fusiond.app.tuning.edit import with_keys
from fusiond.app.tuning.tune import INERTIAL, INSTALLATION, RECEIVER, WHEELS, Finding
from fusiond.config import load
from fusiond.config.toml import read_text

FOLDS = 4
SHARED = (INERTIAL, RECEIVER, WHEELS)
LEAST = 4  # drives that tell a value
DIFFERENT = 2.0  # sigmas by which a value must differ from the configured one to be taken
NORMAL_MAD = 1.4826  # sigma of a normal distribution in units of its median absolute deviation
MEDIAN_LOSS = math.sqrt(math.pi / 2)  # sigma of a median in units of that of a mean


class FleetFinding(Struct, frozen=True, kw_only=True):
    """What the drives tell of one key together."""

    vehicle: str  # empty: of all vehicles
    group: str
    table: str
    key: str
    unit: str
    drives: int  # that told it
    configured: float
    found: float
    sigma: float  # standard uncertainty of that

    @property
    def differs(self) -> bool:
        """Whether it is not what is configured."""
        return abs(self.found - self.configured) > DIFFERENT * self.sigma


def joined(told: Iterable[Sequence[Finding]], groups: Sequence[str] = SHARED) -> list[FleetFinding]:
    """The values of some groups, which all vehicles share, from what each drive tells."""
    by_key: dict[tuple[str, str], list[Finding]] = defaultdict(list)
    for findings in told:
        for one in findings:
            if one.group in groups and not one.untold and one.found > 0:
                by_key[one.table, one.key].append(one)
    return [_joined("", found) for found in by_key.values() if len(found) >= LEAST]


def by_vehicle(told: Iterable[tuple[str, Sequence[Finding]]]) -> list[FleetFinding]:
    """What is each vehicle's own, by its name, from what its drives tell."""
    by_key: dict[tuple[str, str, str], list[Finding]] = defaultdict(list)
    for vehicle, findings in told:
        for one in findings:
            if one.group == INSTALLATION and math.isfinite(one.sigma) and one.sigma > 0:
                by_key[vehicle, one.table, one.key].append(one)
    return [_weighed(vehicle, found) for (vehicle, _, _), found in sorted(by_key.items())]


def _joined(vehicle: str, found: Sequence[Finding]) -> FleetFinding:
    values = np.array([one.found for one in found])
    middle = float(np.median(values))
    scatter = NORMAL_MAD * float(np.median(np.abs(values - middle)))
    return _finding(vehicle, found, middle, MEDIAN_LOSS * scatter / math.sqrt(len(found)))


def _weighed(vehicle: str, found: Sequence[Finding]) -> FleetFinding:
    """By their own uncertainties."""
    weights = np.array([one.sigma**-2 for one in found])
    value = float(weights @ [one.found for one in found] / weights.sum())
    return _finding(vehicle, found, value, float(weights.sum() ** -0.5))


def _finding(vehicle: str, found: Sequence[Finding], value: float, sigma: float) -> FleetFinding:
    one = found[0]
    return FleetFinding(
        vehicle=vehicle, group=one.group, table=one.table, key=one.key, unit=one.unit, drives=len(found),
        configured=one.configured, found=value, sigma=sigma,
    )  # fmt: skip


def text_with(text: str, findings: Iterable[FleetFinding]) -> str:
    """A configuration with the values that differ, to three digits."""
    return with_keys(text, {(one.table, one.key): float(f"{one.found:.3g}") for one in findings if one.differs})


def write_fold(config: str, findings: Iterable[FleetFinding], target: Path) -> None:
    """Write a configuration with what was found into another folder; its DBC files stay where they are. Raises OSError,
    ConfigError."""
    loaded, text = load.load(config), text_with(read_text(Path(config)), findings)
    places: dict[tuple[str, str], Any] = {
        (f"can.{bus}", "dbc"): [str(loaded.path(dbc).absolute()) for dbc in section.dbc]
        for bus, section in loaded.can.items()
        if section.dbc
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(with_keys(text, places), encoding="utf-8")


def write_vehicles(path: Path, findings: Iterable[FleetFinding]) -> None:
    """Write what is each vehicle's own as Parquet. Raises OSError."""
    from fusiond.app.batch.table import ParquetFile, schema_of  # noqa: PLC0415 - needs the extra `batch`

    with ParquetFile(path, schema_of(FleetFinding)) as file:
        file.write([msgspec.to_builtins(one) for one in findings])


def lines(findings: Sequence[FleetFinding], dropped: Container[str]) -> Iterator[str]:
    """What all drives tell together, and whether it is taken, for a terminal."""
    rows = [["key", "configured", "found", "+-", "unit", "drives", ""]]
    for one in findings:
        verdict = "as configured" if not one.differs else "not taken" if one.group in dropped else "taken"
        numbers = [f"{one.configured:.4g}", f"{one.found:.3g}", f"{one.sigma:.2g}", one.unit, str(one.drives)]
        rows.append([f"[{one.table}] {one.key}", *numbers, verdict])
    yield from table(rows)
